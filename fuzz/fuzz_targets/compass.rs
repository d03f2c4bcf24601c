//! Arbitrary bytes of a compass line, in every format: no panic, values in range.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover_base::settings::CompassFormat;
use windhover_base::time::MonoTime;
use windhover_decode::CompassDecoder;

const FORMATS: [CompassFormat; CompassFormat::ALL.len()] = CompassFormat::ALL;

// The first byte selects the format and the length of reads. The rest is read as it is, and as bodies of sentences.
fuzz_target!(|data: &[u8]| {
    let Some((&choice, stream)) = data.split_first() else {
        return;
    };
    read(choice, stream);
    read(choice, &windhover_fuzz::sentences(stream));
});

fn read(choice: u8, stream: &[u8]) {
    let format = FORMATS[usize::from(choice) % FORMATS.len()];
    let (mut decoder, mut out) = (CompassDecoder::new(format), Vec::new());
    for read in stream.chunks(usize::from(choice) / FORMATS.len() + 1) {
        decoder.push(read, MonoTime::default(), &mut out);
    }
    decoder.flush(&mut out);
    for received in out {
        assert!(received.reading.heading_deg.is_none_or(|deg| (0.0..=360.0).contains(&deg)));
        assert!(received.bytes > 0);
    }
}
