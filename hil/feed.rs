//! Feeds a capture into the bench's lines at its own pace: serial bytes, frames, and the receiver's pulse, each into a
//! Unix socket of the emulator. At its end it starts again, as if the receiver had been restarted.
//!
//! `hil_feed CAPTURE GPS_SOCKET COMPASS_SOCKET FRAMES_SOCKET PULSE_SOCKET [GREY|YUYV|UYVY|NV12|RGB3]`
//!
//! Each frame carries its number as 24 squares of 8 pixels in its top-left corner, so that the far end can identify the
//! frame. Serial bytes that are not read are lost after two seconds, as on a real line, and do not wait in the emulator
//! until the port is opened. The line `start NS` on standard output gives the start, and `frame N` each frame that was
//! sent.

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::ExitCode;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use windhover::config::Config;
use windhover::io::capture::{CaptureReader, attached_config};
use windhover::io::clock::HostClock;
use windhover::pixels;
use windhover_base::msg::{EventBody, FramePayload, GrayImage, Source};
use windhover_base::time::{MonoTime, Span};

type Trouble = Box<dyn std::error::Error>;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let (paths, format) = match args.as_slice() {
        [paths @ .., format] if paths.len() == 5 => (paths, format.as_str()),
        paths => (paths, "GREY"),
    };
    let [capture, gps, compass, frames, pulse] = paths else {
        eprintln!("usage: hil_feed CAPTURE GPS_SOCKET COMPASS_SOCKET FRAMES_SOCKET PULSE_SOCKET [FORMAT]");
        return ExitCode::from(2);
    };
    let feed = Lines::open(gps, compass, frames, pulse, format).and_then(|lines| lines.feed(capture));
    match feed {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("hil_feed: {error}");
            ExitCode::FAILURE
        }
    }
}

/// The emulator's lines.
struct Lines {
    clock: HostClock,
    gps: UnixStream,
    compass: UnixStream,
    pulse: UnixStream,
    frames: SyncSender<(u32, GrayImage)>,
    writer: std::thread::JoinHandle<()>,
}

impl Lines {
    fn open(gps: &str, compass: &str, frames: &str, pulse: &str, format: &str) -> Result<Self, Trouble> {
        let pack = packing(format).ok_or_else(|| format!("{format} is not a format of the bench"))?;
        // The newest frame replaces a waiting one: frames for which the far end has no time are left out, as by a
        // camera.
        let (sender, receiver) = sync_channel::<(u32, GrayImage)>(1);
        let camera = UnixStream::connect(frames)?;
        Ok(Self {
            clock: HostClock::start(),
            gps: line(gps)?,
            compass: line(compass)?,
            pulse: UnixStream::connect(pulse)?,
            frames: sender,
            writer: std::thread::spawn(move || write_frames(&receiver, camera, pack)),
        })
    }

    fn feed(mut self, capture: &str) -> Result<(), Trouble> {
        let pulses = first_pulse(capture)?;
        loop {
            self.play(capture, pulses)?;
            if self.writer.is_finished() {
                return Err("the camera's line went away".into());
            }
        }
    }

    /// Plays the capture once; `pulse` is the start of a second of the receiver.
    fn play(&mut self, capture: &str, pulse: Option<MonoTime>) -> Result<(), Trouble> {
        let began = self.clock.now();
        println!("start {}", began.ns());
        let (mut first, mut pulse) = (None, pulse);
        for item in CaptureReader::open(Path::new(capture))? {
            let Some(event) = item.event else { continue };
            let shift = began - *first.get_or_insert(event.t_recv);
            while let Some(second) = pulse.filter(|second| *second <= event.t_recv) {
                self.sleep_until(second + shift);
                self.pulse.write_all(b".")?;
                pulse = Some(second + Span::from_s(1.0));
            }
            self.sleep_until(event.t_recv + shift);
            match event.body {
                EventBody::Bytes { source: Source::Gps, data: bytes } => say(&mut self.gps, &bytes)?,
                EventBody::Bytes { source: Source::Compass, data: bytes } => say(&mut self.compass, &bytes)?,
                EventBody::Frame(frame) => {
                    if let Some(image) = numbered(&frame) {
                        let _ = self.frames.try_send((frame.index, image));
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn sleep_until(&self, due: MonoTime) {
        let left = due - self.clock.now();
        if left > Span::ZERO {
            std::thread::sleep(Duration::from_nanos(left.ns().unsigned_abs()));
        }
    }
}

/// Size of a line's buffer: some 70 writes, two seconds of either device. A shorter stall of the emulator loses
/// nothing.
const LINE_BYTES: usize = 32 << 10;

/// A serial line.
fn line(path: &str) -> Result<UnixStream, Trouble> {
    let stream = UnixStream::connect(path)?;
    rustix::net::sockopt::set_socket_send_buffer_size(&stream, LINE_BYTES)?;
    stream.set_nonblocking(true)?;
    Ok(stream)
}

/// Writes to a line; bytes that do not fit are lost.
fn say(line: &mut UnixStream, bytes: &[u8]) -> std::io::Result<()> {
    match line.write(bytes) {
        Err(error) if error.kind() != std::io::ErrorKind::WouldBlock => Err(error),
        _ => Ok(()),
    }
}

/// When the first pulse of the capture's receiver is due: the start of its second, whose sentences arrive
/// `gps.latency_ms` later. The earliest of the first ones has the least jitter. `None` without RMC.
fn first_pulse(capture: &str) -> Result<Option<MonoTime>, Trouble> {
    /// Sentences that are examined: ten seconds of them.
    const SENTENCES: usize = 50;
    let path = Path::new(capture);
    let config = attached_config(path)?.ok_or("the capture has no configuration")?;
    let latency = Span::from_ms(Config::parse(&config)?.gps.latency_ms);
    let arrivals = CaptureReader::open(path)?.filter_map(|item| item.event).filter_map(|event| {
        let EventBody::Bytes { source: Source::Gps, data: bytes } = &event.body else { return None };
        let text = String::from_utf8_lossy(bytes);
        let seconds: f64 = text.split_once("RMC,")?.1.split(',').next()?.get(4..)?.parse().ok()?;
        Some(event.t_recv - Span::from_s(seconds.fract()))
    });
    let second = |t: &MonoTime| t.ns().rem_euclid(1_000_000_000);
    let arrivals: Vec<MonoTime> = arrivals.take(SENTENCES).collect();
    let Some(begin) = arrivals.first().copied() else { return Ok(None) };
    let late =
        |t: &MonoTime| (second(t) - second(&begin) + 1_500_000_000).rem_euclid(1_000_000_000) - 500_000_000;
    let earliest = arrivals.iter().map(late).min().unwrap_or(0);
    Ok(Some(begin + Span::from_ns(earliest) - latency))
}

fn write_frames(frames: &Receiver<(u32, GrayImage)>, mut camera: UnixStream, pack: Packing) {
    while let Ok((number, image)) = frames.recv() {
        if camera.write_all(&pack(&image.data)).is_err() {
            return;
        }
        println!("frame {number}");
    }
}

/// Grey pixels in a pixel format of V4L2.
type Packing = fn(&[u8]) -> Vec<u8>;

/// The packing of a format by its four-character code; colour formats contain grey.
fn packing(format: &str) -> Option<Packing> {
    const NO_COLOUR: u8 = 128;
    Some(match format {
        "GREY" => |grey| grey.to_vec(),
        "YUYV" => |grey| grey.iter().flat_map(|&y| [y, NO_COLOUR]).collect(),
        "UYVY" => |grey| grey.iter().flat_map(|&y| [NO_COLOUR, y]).collect(),
        "NV12" => |grey| [grey, vec![NO_COLOUR; grey.len() / 2].as_slice()].concat(),
        "RGB3" => |grey| grey.iter().flat_map(|&y| [y; 3]).collect(),
        _ => return None,
    })
}

/// The frame as packed grey with its number in the corner.
fn numbered(frame: &FramePayload) -> Option<GrayImage> {
    let decoded = pixels::decode(frame, false).ok()?;
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
