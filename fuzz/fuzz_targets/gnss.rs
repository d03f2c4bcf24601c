//! Arbitrary bytes of a GPS line, cut anywhere: no panic, bounded output, values in range.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover_base::time::{MonoTime, Span};
use windhover_decode::GnssDecoder;

// The first byte sets the length of reads and their intervals, so that the paths with time-outs run as well. The rest is read
// as it is, and as bodies of sentences.
fuzz_target!(|data: &[u8]| {
    let Some((&pace, stream)) = data.split_first() else {
        return;
    };
    read(pace, stream);
    read(pace, &windhover_fuzz::sentences(stream));
});

fn read(pace: u8, stream: &[u8]) {
    let (mut decoder, mut out) = (GnssDecoder::new(), Vec::new());
    let mut now = MonoTime::from_ns(1_795_014_245_000_000_000);
    for read in stream.chunks(usize::from(pace % 61) + 1) {
        now += Span::from_ms(f64::from(pace));
        decoder.push(read, now, &mut out);
        decoder.tick(now, &mut out);
    }
    decoder.flush(&mut out);
    // The shortest epoch is one sentence of fifteen bytes.
    assert!(out.len() <= stream.len() / 15 + 1);
    for received in out {
        assert!(received.epoch.lat_deg.is_none_or(|lat| (-90.0..=90.0).contains(&lat)));
        assert!(received.epoch.lon_deg.is_none_or(|lon| (-180.0..=180.0).contains(&lon)));
        assert!(received.t_last_byte >= received.t_first_byte);
    }
}
