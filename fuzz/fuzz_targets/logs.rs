//! Any bytes as a log of an autopilot or a camera (ULog, DataFlash, tlog, SRT): no panic, no endless loop, memory in
//! proportion.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover::io::import::read_log;
use windhover_base::time::MonoTime;

fuzz_target!(|data: &[u8]| {
    windhover_fuzz::with_file("log", &[data], |path| {
        for start in [None, Some(MonoTime::from_ns(1_795_014_245_000_000_000))] {
            let Ok(log) = read_log(path, start) else { continue };
            assert!(
                log.packets.len() <= 8 * data.len() + 8,
                "{} packets of {} bytes",
                log.packets.len(),
                data.len()
            );
        }
    });
});
