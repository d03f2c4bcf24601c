//! Any datagram at the MAVLink port: no panic, and none is believed without the key.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover::io::mavlink::packet::{SigningKey, verify};

fuzz_target!(|data: &[u8]| {
    assert!(verify(data, &SigningKey([7; 32])).is_err());
    let _ = std::str::from_utf8(data).map(SigningKey::from_hex);
});
