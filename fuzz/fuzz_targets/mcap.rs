//! Arbitrary bytes as a recording: read as messages and as events, its frames decoded; no panic, no endless loop.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover::io::capture::{CaptureReader, attached_config};
use windhover::pixels;
use windhover_base::msg::EventBody;

/// The magic at the start of every recording.
const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";

fuzz_target!(|data: &[u8]| {
    windhover_fuzz::with_file("mcap", &[&MAGIC, data], |path| {
        let _ = attached_config(path);
        let Ok(reader) = CaptureReader::open(path) else { return };
        for item in reader {
            if let Some(EventBody::Frame(frame)) = item.event.map(|event| event.body) {
                let _ = pixels::decode(&frame, true);
            }
        }
    });
});
