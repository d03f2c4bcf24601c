//! Any bytes as a bag of ROS 1 or ROS 2 (SQLite, MCAP): no panic, no endless loop; frames of it are decoded.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover::io::import::read_bag;
use windhover::pixels;

fuzz_target!(|data: &[u8]| {
    windhover_fuzz::with_file("bag", &[data], |path| {
        let Ok(bag) = read_bag(path, &[]) else { return };
        let Ok(Some(frames)) = bag.frames() else { return };
        for frame in frames.take(16).flatten() {
            let _ = pixels::decode(&frame, true);
        }
    });
});
