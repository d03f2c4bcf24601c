//! Arbitrary bytes as a video (Y4M, AVI of Motion JPEG) and as one frame; no panic, no endless loop.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover::io::import::open_video;
use windhover::pixels;
use windhover_base::time::MonoTime;

/// Starts of the supported formats; any other input would be given to an installed ffmpeg.
const BEGINS: [&[u8]; 2] = [b"YUV4MPEG2 ", b"RIFF"];

fuzz_target!(init: without_programs(), |data: &[u8]| {
    for begin in BEGINS {
        windhover_fuzz::with_file("video", &[begin, data], |path| {
            let Ok((_, frames)) = open_video(path, MonoTime::default()) else { return };
            for frame in frames.take(64).flatten() {
                let _ = pixels::decode(&frame, true);
            }
        });
    }
    let _ = pixels::picture(data);
});

/// Hides ffmpeg, which is called for what is not Motion JPEG: a process for each input, and its parsers are not ours.
fn without_programs() {
    // SAFETY: called once, before any other thread begins.
    unsafe { std::env::set_var("PATH", "") };
}
