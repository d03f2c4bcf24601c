//! Feeds a capture into the bench's lines at its own pace: serial bytes and grey frames, each into a
//! Unix socket of the emulator. At its end it begins again, as if the receiver had been restarted.
//!
//! `hil_feed CAPTURE GPS_SOCKET COMPASS_SOCKET FRAMES_SOCKET`
//!
//! Each frame carries its number as 24 squares of 8 pixels in its top-left corner, so that the far end
//! can tell which frame it saw. One line `start NS` on standard output tells when it began, and
//! `frame N` each frame that was handed over.

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::ExitCode;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use windhover::io::capture::CaptureReader;
use windhover::io::clock::HostClock;
use windhover::msg::{EventBody, FramePayload, GrayImage};
use windhover::pipeline::Pipeline;
use windhover::time::Span;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [capture, gps, compass, frames] = args.as_slice() else {
        eprintln!("usage: hil_feed CAPTURE GPS_SOCKET COMPASS_SOCKET FRAMES_SOCKET");
        return ExitCode::from(2);
    };
    match feed(capture, gps, compass, frames) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("hil_feed: {error}");
            ExitCode::FAILURE
        }
    }
}

fn feed(capture: &str, gps: &str, compass: &str, frames: &str) -> Result<(), Box<dyn std::error::Error>> {
    let clock = HostClock::start();
    let mut gps = UnixStream::connect(gps)?;
    let mut compass = UnixStream::connect(compass)?;
    // The newest frame wins: what the far end has no time for is left out, as a camera does.
    let (sender, receiver) = sync_channel::<(u32, GrayImage)>(1);
    let camera = UnixStream::connect(frames)?;
    let writer = std::thread::spawn(move || write_frames(&receiver, camera));
    loop {
        play(capture, clock, &mut gps, &mut compass, &sender)?;
        if writer.is_finished() {
            return Err("the camera's line went away".into());
        }
    }
}

/// Plays the capture once.
fn play(
    capture: &str,
    clock: HostClock,
    gps: &mut UnixStream,
    compass: &mut UnixStream,
    frames: &SyncSender<(u32, GrayImage)>,
) -> Result<(), Box<dyn std::error::Error>> {
    let began = clock.now();
    println!("start {}", began.ns());
    let mut first = None;
    for item in CaptureReader::open(Path::new(capture))? {
        let Some(event) = item.event else { continue };
        let due = began + (event.t_recv - *first.get_or_insert(event.t_recv));
        let left = due - clock.now();
        if left > Span::ZERO {
            std::thread::sleep(Duration::from_nanos(left.ns().unsigned_abs()));
        }
        match event.body {
            EventBody::GnssBytes(bytes) => gps.write_all(&bytes)?,
            EventBody::CompassBytes(bytes) => compass.write_all(&bytes)?,
            EventBody::Frame(frame) => {
                if let Some(image) = numbered(&frame) {
                    let _ = frames.try_send((frame.index, image));
                }
            }
            _ => {}
        }
    }
    Ok(())
}

fn write_frames(frames: &Receiver<(u32, GrayImage)>, mut camera: UnixStream) {
    while let Ok((number, image)) = frames.recv() {
        if camera.write_all(&image.data).is_err() {
            return;
        }
        println!("frame {number}");
    }
}

/// The frame as packed grey with its number in the corner.
fn numbered(frame: &FramePayload) -> Option<GrayImage> {
    let decoded = Pipeline::prepare(frame, false).ok()?;
    let view = decoded.gray.view();
    let mut data = Vec::with_capacity(view.width * view.height);
    for v in 0..view.height {
        data.extend_from_slice(view.row(v));
    }
    for bit in 0..24 {
        let level = if frame.index >> bit & 1 == 1 { 235 } else { 20 };
        for v in 0..8 {
            let start = v * view.width + bit * 8;
            data[start..start + 8].fill(level);
        }
    }
    GrayImage::from_vec(view.width, view.height, data)
}
