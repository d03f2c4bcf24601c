//! Arbitrary bytes as MAVLink: no panic in the decoder of the autopilot, and no datagram is accepted without the key.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover::io::mavlink::packet::{SigningKey, verify};
use windhover_base::time::MonoTime;
use windhover_decode::AutopilotDecoder;

fuzz_target!(|data: &[u8]| {
    assert!(verify(data, &SigningKey([7; 32])).is_err());
    let _ = std::str::from_utf8(data).map(SigningKey::from_hex);
    let (mut decoder, mut received) = (AutopilotDecoder::new(Some(1)), Vec::new());
    for (k, part) in data.chunks(64).enumerate() {
        decoder.push(part, MonoTime::from_ns(k as i64 * 10_000_000), &mut received);
    }
});
