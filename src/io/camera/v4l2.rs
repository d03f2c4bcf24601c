//! A V4L2 camera: negotiates a format, streams mapped buffers, and tolerates errors of the driver.

use std::convert::Infallible;
use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
use std::os::fd::{AsRawFd, RawFd};
use std::sync::Arc;
use std::time::Duration;

use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use v4l::buffer::{Flags, Metadata, Type};
use v4l::capability::Flags as Capability;
use v4l::device::Handle;
use v4l::io::mmap::Stream;
use v4l::io::traits::CaptureStream;
use v4l::video::Capture;
use v4l::video::capture::Parameters;
use v4l::{Device, Format, FourCC, Fraction};

use super::CameraSettings;
use super::format::{self, FourCc};
use crate::io::clock::HostClock;
use crate::io::device::{
    Fault, FaultKind, NoteKind, Opened, OwnsDescriptor, Report, Reports, blocking, catch_panics, register,
    wait_for,
};
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::{MonoTime, Span};

/// Mapped buffers. One is being copied while the others fill: at 30 frames a second the driver can continue for a third
/// of a second while this task waits for a processor. A driver with less memory gives fewer.
const BUFFERS: u32 = 12;

/// A camera that delivers no frame for this long, or for [`FROZEN_FRAMES`] frame times, is frozen.
const FROZEN: Duration = Duration::from_secs(2);
const FROZEN_FRAMES: f64 = 5.0;

/// A stamp this far before its arrival, or after it, is not the time of exposure.
const OLDEST_STAMP: Span = Span::from_ns(2_000_000_000);

/// `POLLIN` of poll(2), the same on every Linux.
const POLLIN: i16 = 1;

/// Streams until the device is lost. Any panic of the V4L2 library (its stream's `Drop` panics where a vanished
/// device refuses STREAMOFF) means that the device is lost.
pub(super) async fn stream(
    settings: &CameraSettings,
    clock: HostClock,
    reports: Reports<'_>,
    delivered: &mut (dyn FnMut() + Send),
) -> Fault {
    match try_stream(settings, clock, reports, delivered).await {
        Ok(never) => match never {},
        Err(fault) => fault,
    }
}

async fn try_stream(
    settings: &CameraSettings,
    clock: HostClock,
    reports: Reports<'_>,
    delivered: &mut (dyn FnMut() + Send),
) -> Result<Infallible, Fault> {
    let lost = || {
        let what = "the driver failed; the camera is opened again";
        Fault::new(FaultKind::Unplugged, &settings.device, what)
    };
    // Opening talks to the device, which takes time over USB; so does the first frame.
    let asked = settings.clone();
    let opened = blocking(move || catch_panics(|| open(asked)));
    let (camera, found) = opened.await.ok_or_else(lost)??;
    found.into_iter().for_each(reports);
    let started = blocking(move || catch_panics(|| camera.start(clock)));
    let (running, first) = started.await.ok_or_else(lost)??;
    let mut running = Opened::new(running);
    let mut taken = first;
    let fault = loop {
        for report in taken {
            if matches!(report, Report::Frame(..)) {
                delivered();
            }
            reports(report);
        }
        let next = match running.readable(reports).await {
            Ok(()) => catch_panics(|| running.take_next(clock)).unwrap_or_else(|| Err(lost())),
            Err(fault) => Err(fault),
        };
        match next {
            Ok(reports) => taken = reports,
            Err(fault) => break fault,
        }
    };
    running.close().await;
    Err(fault)
}

/// The negotiated camera.
struct Camera {
    settings: CameraSettings,
    device: Device,
    encoding: FrameEncoding,
    width: u32,
    height: u32,
    stride: u32,
}

/// Opens the camera and agrees on a format; also returns the notes to report.
fn open(settings: CameraSettings) -> Result<(Camera, Vec<Report>), Fault> {
    let path = settings.device.as_str();
    let mut reports = Vec::new();
    let device = Device::with_path(path).map_err(|e| Fault::from_io(path, &e))?;
    let unsuitable = |text: String| Fault::new(FaultKind::Unsuitable, path, text);
    let caps = device.query_caps().map_err(|_| unsuitable("is not a camera (V4L2)".into()))?;
    if !caps.capabilities.contains(Capability::VIDEO_CAPTURE | Capability::STREAMING) {
        return Err(unsuitable(format!("{} delivers no video stream; is it the right node?", caps.card)));
    }
    let offered: Vec<FourCc> =
        device.enum_formats().unwrap_or_default().iter().map(|d| d.fourcc.repr).collect();
    let asked = format::fourcc(settings.pixel_format);
    let offer = || offered.iter().map(|&code| format::name(code)).collect::<Vec<_>>().join(", ");
    let wanted = format::choose(asked, &offered)
        .ok_or_else(|| unsuitable(format!("offers {} and none of them is supported", offer())))?;
    let given = device
        .set_format(&Format::new(settings.width, settings.height, FourCC::new(&wanted)))
        .map_err(|e| Fault::from_io(path, &e))?;
    if (given.width, given.height) != (settings.width, settings.height) {
        return Err(unsuitable(format!(
            "delivers {}x{} where camera.width and camera.height request {}x{}; it offers {}",
            given.width,
            given.height,
            settings.width,
            settings.height,
            offer()
        )));
    }
    let encoding = format::encoding(given.fourcc.repr).ok_or_else(|| {
        unsuitable(format!("delivers {}, which is not supported; it offers {}", given.fourcc, offer()))
    })?;
    if given.fourcc.repr != asked {
        let text = format!("requested {}, the driver delivers {}", format::name(asked), given.fourcc);
        reports.push(Report::Note(NoteKind::FormatDiffers, 1, text));
    }
    let fps = set_rate(&device, settings.fps);
    let rate = fps.map_or_else(|| "its own rate".into(), |fps| format!("{fps:.1} frames/s"));
    reports.push(Report::Up(format!(
        "{path}: {} ({}), {} {}x{}, {rate}",
        caps.card, caps.driver, given.fourcc, given.width, given.height
    )));
    let stride = if given.stride == 0 { format::packed_stride(encoding, given.width) } else { given.stride };
    let camera = Camera { settings, device, encoding, width: given.width, height: given.height, stride };
    Ok((camera, reports))
}

/// Requests a frame rate; returns the rate that the driver sets, frames a second. Drivers without this call have a
/// fixed rate.
fn set_rate(device: &Device, fps: f64) -> Option<f64> {
    let interval = Fraction::new(1000, (fps * 1000.0).round() as u32);
    let given = device.set_params(&Parameters::new(interval)).ok()?.interval;
    (given.numerator > 0).then(|| f64::from(given.denominator) / f64::from(given.numerator))
}

/// The descriptor of an open device, on which the runtime waits.
struct Descriptor(Arc<Handle>);

impl AsRawFd for Descriptor {
    fn as_raw_fd(&self) -> RawFd {
        self.0.fd()
    }
}

// SAFETY: the handle closes its descriptor when the last of its holders is dropped, and this value is one of them.
unsafe impl OwnsDescriptor for Descriptor {}

/// A running stream.
struct Running {
    camera: Camera,
    ready: AsyncFd<Descriptor>,
    stream: Stream<'static>,
    following: Following,
    /// Whether a dequeue failed: the stream's own count of buffers is correct again after one is returned.
    owes_buffer: bool,
}

/// State from one frame to the next.
#[derive(Default)]
struct Following {
    sequence: Option<u32>,
    newest: Option<MonoTime>,
    bad_stamps_told: bool,
}

impl Camera {
    /// Starts the stream and waits for the first frame.
    fn start(self, clock: HostClock) -> Result<(Running, Vec<Report>), Fault> {
        let fault = |error: &std::io::Error| Fault::from_io(&self.settings.device, error);
        let mut stream =
            Stream::with_buffers(&self.device, Type::VideoCapture, BUFFERS).map_err(|e| fault(&e))?;
        stream.set_timeout(self.patience());
        // An error state of the driver is not readiness to read, but it must be noticed.
        let interest = Interest::READABLE | Interest::ERROR;
        let ready = register(Descriptor(stream.handle()), interest).map_err(|e| fault(&e))?;
        let following = Following::default();
        let mut running = Running { camera: self, ready, stream, following, owes_buffer: false };
        let first = running.take_next(clock)?;
        // From here on, nothing is dequeued before readiness.
        running.stream.set_timeout(Duration::ZERO);
        Ok((running, first))
    }

    /// How long a frame may take.
    fn patience(&self) -> Duration {
        FROZEN.max(Duration::from_secs_f64(FROZEN_FRAMES / self.settings.fps))
    }

    fn frozen(&self) -> Fault {
        let text = format!("no frame for {:.1} s; the camera is opened again", self.patience().as_secs_f64());
        Fault::new(FaultKind::Frozen, &self.settings.device, text)
    }

    /// The fault of a failed system call.
    fn lost(&self, error: &std::io::Error) -> Fault {
        let mut fault = Fault::from_io(&self.settings.device, error);
        if fault.kind == FaultKind::Missing {
            fault.kind = FaultKind::Unplugged;
            fault.detail = "disappeared; waiting for it to return".into();
        }
        fault
    }
}

impl Running {
    /// Waits until a frame can be dequeued.
    async fn readable(&self, reports: Reports<'_>) -> Result<(), Fault> {
        let readable = async {
            loop {
                let mut ready = self.ready.ready(Interest::READABLE | Interest::ERROR).await?;
                match self.ready.get_ref().0.poll(POLLIN, 0) {
                    Ok(0) => ready.clear_ready(),
                    Ok(_) => return Ok(()),
                    Err(error) if error.kind() == Interrupted => {}
                    Err(error) => return Err(error),
                }
            }
        };
        match tokio::time::timeout(self.camera.patience(), wait_for(readable, reports)).await {
            Ok(result) => result.map_err(|error| Fault::from_io(&self.camera.settings.device, &error)),
            Err(_) => Err(self.camera.frozen()),
        }
    }

    /// Dequeues a frame; also returns the notes to report.
    fn take_next(&mut self, clock: HostClock) -> Result<Vec<Report>, Fault> {
        if self.owes_buffer {
            return match CaptureStream::dequeue(&mut self.stream) {
                Err(error) if matches!(error.kind(), Interrupted | WouldBlock) => Ok(Vec::new()),
                Err(error) if error.kind() == TimedOut => Err(self.camera.frozen()),
                Err(error) => Err(Fault::from_io(&self.camera.settings.device, &error)),
                Ok(_) => {
                    self.owes_buffer = false;
                    Ok(Vec::new())
                }
            };
        }
        match self.stream.next() {
            Ok((bytes, meta)) => {
                let mut reports = Vec::new();
                let mut tell = |report| reports.push(report);
                let t_recv = clock.now();
                let frame = self.camera.take(bytes, meta, t_recv, &mut self.following, clock, &mut tell);
                reports.extend(frame.map(|frame| Report::Frame(t_recv, frame)));
                Ok(reports)
            }
            Err(error) if matches!(error.kind(), Interrupted | WouldBlock) => {
                self.owes_buffer = true;
                Ok(Vec::new())
            }
            Err(error) if error.kind() == TimedOut => Err(self.camera.frozen()),
            Err(error) => Err(self.camera.lost(&error)),
        }
    }
}

impl Camera {
    /// Copies one frame out of its buffer; `None` where it is damaged.
    fn take(
        &self,
        bytes: &[u8],
        meta: &Metadata,
        t_recv: MonoTime,
        following: &mut Following,
        clock: HostClock,
        tell: &mut dyn FnMut(Report),
    ) -> Option<FramePayload> {
        let missed = following
            .sequence
            .replace(meta.sequence)
            .map_or(0, |last| meta.sequence.wrapping_sub(last).saturating_sub(1));
        // A driver that restarts its count has not lost four thousand million frames.
        if (1..100_000).contains(&missed) {
            tell(Report::Note(NoteKind::FramesMissed, missed, format!("{missed} frames were not delivered")));
        }
        if meta.flags.contains(Flags::ERROR) {
            tell(Report::Note(
                NoteKind::FrameDamaged,
                1,
                format!("frame {} is flagged as damaged", meta.sequence),
            ));
            return None;
        }
        let used = if meta.bytesused == 0 { bytes.len() } else { (meta.bytesused as usize).min(bytes.len()) };
        let needed = format::frame_bytes(self.encoding, self.stride as usize, self.height as usize);
        if needed.is_some_and(|needed| used < needed) || used == 0 {
            tell(Report::Note(NoteKind::FrameDamaged, 1, format!("frame {} is incomplete", meta.sequence)));
            return None;
        }
        let t_exposure = self.exposure(meta, t_recv, following, clock, tell);
        let data: Arc<[u8]> = Arc::from(&bytes[..needed.unwrap_or(used)]);
        Some(FramePayload {
            index: 0,
            t_exposure,
            encoding: self.encoding,
            width: self.width,
            height: self.height,
            stride: self.stride,
            data,
        })
    }

    /// The driver's stamp where it is of the monotonic clock, recent, and later than the last; else the arrival.
    fn exposure(
        &self,
        meta: &Metadata,
        t_recv: MonoTime,
        following: &mut Following,
        clock: HostClock,
        tell: &mut dyn FnMut(Report),
    ) -> MonoTime {
        let clock_of_stamp = meta.flags & Flags::TIMESTAMP_MASK;
        let micros = meta.timestamp.sec.saturating_mul(1_000_000).saturating_add(meta.timestamp.usec);
        let stamp = clock.from_monotonic(Duration::from_micros(u64::try_from(micros).unwrap_or(0)));
        let why = if clock_of_stamp != Flags::TIMESTAMP_MONOTONIC {
            "are not of the monotonic clock"
        } else if stamp > t_recv || t_recv - stamp > OLDEST_STAMP {
            "are not near the arrival"
        } else if following.newest.is_some_and(|newest| stamp <= newest) {
            "do not go forward"
        } else {
            following.newest = Some(stamp);
            following.bad_stamps_told = false;
            return stamp;
        };
        if !std::mem::replace(&mut following.bad_stamps_told, true) {
            let text = format!("the driver's stamps {why}; arrival times are used");
            tell(Report::Note(NoteKind::StampsUnusable, 1, text));
        }
        t_recv
    }
}
