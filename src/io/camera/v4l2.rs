//! A V4L2 camera: negotiate a format, stream mapped buffers, and survive whatever the driver does.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

use v4l::buffer::{Flags, Metadata, Type};
use v4l::capability::Flags as Capability;
use v4l::io::mmap::Stream;
use v4l::io::traits::CaptureStream;
use v4l::video::Capture;
use v4l::video::capture::Parameters;
use v4l::{Device, Format, FourCC, Fraction};

use super::CameraSettings;
use super::format::{self, FourCc};
use crate::io::clock::HostClock;
use crate::io::device::{Fault, FaultKind, NAP, NoteKind, Report, Stop};
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::{MonoTime, Span};

/// Mapped buffers. One is being copied while the others fill: at 30 frames a second the driver can
/// run on for a third of a second while this thread waits for a processor. A driver that has less memory gives
/// fewer.
const BUFFERS: u32 = 12;

/// A camera that gives no frame for this long, or for [`FROZEN_FRAMES`] frame times, is frozen.
const FROZEN: Duration = Duration::from_secs(2);
const FROZEN_FRAMES: f64 = 5.0;

/// A stamp this far before its arrival, or at all after it, is not the time of exposure.
const OLDEST_STAMP: Span = Span::from_ns(2_000_000_000);

/// Streams until the device is lost (the fault) or the end is asked for (`None`). Any panic of the
/// V4L2 library (its stream's `Drop` panics where a vanished device refuses STREAMOFF) means that the
/// device is lost.
pub(super) fn stream(
    settings: &CameraSettings,
    clock: HostClock,
    stop: &Stop,
    tell: &dyn Fn(Report),
    delivered: &mut dyn FnMut(),
) -> Option<Fault> {
    let device = settings.device.as_str();
    let run = AssertUnwindSafe(|| match open(settings, tell) {
        Ok(camera) => camera.stream(clock, stop, tell, delivered),
        Err(fault) => Some(fault),
    });
    catch_unwind(run).unwrap_or_else(|_| {
        Some(Fault::new(FaultKind::Unplugged, device, "the driver gave up; the camera is opened again"))
    })
}

/// What the driver agreed to.
struct Camera<'a> {
    settings: &'a CameraSettings,
    device: Device,
    encoding: FrameEncoding,
    width: u32,
    height: u32,
    stride: u32,
}

fn open<'a>(settings: &'a CameraSettings, tell: &dyn Fn(Report)) -> Result<Camera<'a>, Fault> {
    let path = settings.device.as_str();
    let device = Device::with_path(path).map_err(|e| Fault::from_io(path, &e))?;
    let unsuitable = |text: String| Fault::new(FaultKind::Unsuitable, path, text);
    let caps = device.query_caps().map_err(|_| unsuitable("is no camera (V4L2)".into()))?;
    if !caps.capabilities.contains(Capability::VIDEO_CAPTURE | Capability::STREAMING) {
        return Err(unsuitable(format!("{} delivers no video stream; is it the right node?", caps.card)));
    }
    let offered: Vec<FourCc> =
        device.enum_formats().unwrap_or_default().iter().map(|d| d.fourcc.repr).collect();
    let asked = format::fourcc(settings.pixel_format);
    let offer = || offered.iter().map(|&code| format::name(code)).collect::<Vec<_>>().join(", ");
    let wanted = format::choose(asked, &offered)
        .ok_or_else(|| unsuitable(format!("offers {} and none of them is understood", offer())))?;
    let given = device
        .set_format(&Format::new(settings.width, settings.height, FourCC::new(&wanted)))
        .map_err(|e| Fault::from_io(path, &e))?;
    if (given.width, given.height) != (settings.width, settings.height) {
        return Err(unsuitable(format!(
            "gives {}x{} where camera.width and camera.height ask for {}x{}; it offers {}",
            given.width,
            given.height,
            settings.width,
            settings.height,
            offer()
        )));
    }
    let encoding = format::encoding(given.fourcc.repr).ok_or_else(|| {
        unsuitable(format!("gives {}, which is not understood; it offers {}", given.fourcc, offer()))
    })?;
    if given.fourcc.repr != asked {
        let text = format!("asked for {}, the driver gives {}", format::name(asked), given.fourcc);
        tell(Report::Note(NoteKind::FormatDiffers, 1, text));
    }
    let fps = set_rate(&device, settings.fps);
    let rate = fps.map_or_else(|| "its own rate".into(), |fps| format!("{fps:.1} frames/s"));
    tell(Report::Up(format!(
        "{path}: {} ({}), {} {}x{}, {rate}",
        caps.card, caps.driver, given.fourcc, given.width, given.height
    )));
    let stride = if given.stride == 0 { format::packed_stride(encoding, given.width) } else { given.stride };
    Ok(Camera { settings, device, encoding, width: given.width, height: given.height, stride })
}

/// Asks for a frame rate; what the driver then gives, frames a second. Drivers without this call run
/// at a rate of their own.
fn set_rate(device: &Device, fps: f64) -> Option<f64> {
    let interval = Fraction::new(1000, (fps * 1000.0).round() as u32);
    let given = device.set_params(&Parameters::new(interval)).ok()?.interval;
    (given.numerator > 0).then(|| f64::from(given.denominator) / f64::from(given.numerator))
}

/// What is kept from one frame to the next.
#[derive(Default)]
struct Following {
    sequence: Option<u32>,
    newest: Option<MonoTime>,
    bad_stamps_told: bool,
}

impl Camera<'_> {
    fn stream(
        &self,
        clock: HostClock,
        stop: &Stop,
        tell: &dyn Fn(Report),
        delivered: &mut dyn FnMut(),
    ) -> Option<Fault> {
        let path = self.settings.device.as_str();
        let mut stream = match Stream::with_buffers(&self.device, Type::VideoCapture, BUFFERS) {
            Ok(stream) => stream,
            Err(error) => return Some(Fault::from_io(path, &error)),
        };
        stream.set_timeout(self.patience());
        let mut following = Following::default();
        let mut started = false;
        while !stop.asked() {
            tell(Report::Beat);
            if started && let Err(fault) = self.wait(&stream, stop, tell) {
                return fault;
            }
            let taken = stream.next().map(|(bytes, meta)| {
                let t_recv = clock.now();
                self.take(bytes, meta, t_recv, &mut following, clock, tell)
            });
            started = true;
            match taken {
                Ok(Some((t_recv, frame))) => {
                    delivered();
                    tell(Report::Frame(t_recv, frame));
                }
                Ok(None) => {}
                Err(error) => {
                    if let Err(fault) = self.recover(&mut stream, &error) {
                        return Some(fault);
                    }
                }
            }
        }
        None
    }

    /// How long a frame may take.
    fn patience(&self) -> Duration {
        FROZEN.max(Duration::from_secs_f64(FROZEN_FRAMES / self.settings.fps))
    }

    /// Waits for a frame, answering meanwhile. `Err(None)` where the end was asked for.
    fn wait(&self, stream: &Stream<'_>, stop: &Stop, tell: &dyn Fn(Report)) -> Result<(), Option<Fault>> {
        /// `POLLIN` of poll(2), the same on every Linux.
        const POLLIN: i16 = 1;
        let mut waited = Duration::ZERO;
        while waited < self.patience() {
            match stream.handle().poll(POLLIN, NAP.as_millis() as i32) {
                Ok(0) => waited += NAP,
                Ok(_) => return Ok(()),
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                Err(error) => return Err(Some(Fault::from_io(&self.settings.device, &error))),
            }
            tell(Report::Beat);
            if stop.asked() {
                return Err(None);
            }
        }
        Err(Some(self.frozen()))
    }

    fn frozen(&self) -> Fault {
        let text = format!("no frame for {:.1} s; the camera is opened again", self.patience().as_secs_f64());
        Fault::new(FaultKind::Frozen, &self.settings.device, text)
    }

    /// After a failed dequeue: nothing to do where the device is gone; else one buffer is given up so
    /// that the stream's own bookkeeping is right again.
    fn recover(&self, stream: &mut Stream<'_>, error: &std::io::Error) -> Result<(), Fault> {
        use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
        match error.kind() {
            TimedOut => return Err(self.frozen()),
            Interrupted | WouldBlock => {}
            _ => {
                let mut fault = Fault::from_io(&self.settings.device, error);
                if fault.kind == FaultKind::Missing {
                    fault.kind = FaultKind::Unplugged;
                    fault.detail = "went away; waiting for it to come back".into();
                }
                return Err(fault);
            }
        }
        loop {
            match CaptureStream::dequeue(stream) {
                Ok(_) => return Ok(()),
                Err(error) if matches!(error.kind(), Interrupted | WouldBlock) => {}
                Err(error) if error.kind() == TimedOut => return Err(self.frozen()),
                Err(error) => return Err(Fault::from_io(&self.settings.device, &error)),
            }
        }
    }

    /// Copies one frame out of its buffer; `None` where it is damaged.
    fn take(
        &self,
        bytes: &[u8],
        meta: &Metadata,
        t_recv: MonoTime,
        following: &mut Following,
        clock: HostClock,
        tell: &dyn Fn(Report),
    ) -> Option<(MonoTime, FramePayload)> {
        let missed = following
            .sequence
            .replace(meta.sequence)
            .map_or(0, |last| meta.sequence.wrapping_sub(last).saturating_sub(1));
        // A driver that starts its count again has not lost four thousand million frames.
        if (1..100_000).contains(&missed) {
            tell(Report::Note(NoteKind::FramesMissed, missed, format!("{missed} frames never came")));
        }
        if meta.flags.contains(Flags::ERROR) {
            tell(Report::Note(
                NoteKind::FrameDamaged,
                1,
                format!("frame {} is flagged damaged", meta.sequence),
            ));
            return None;
        }
        let used = if meta.bytesused == 0 { bytes.len() } else { (meta.bytesused as usize).min(bytes.len()) };
        let needed = format::frame_bytes(self.encoding, self.stride as usize, self.height as usize);
        if needed.is_some_and(|needed| used < needed) || used == 0 {
            tell(Report::Note(NoteKind::FrameDamaged, 1, format!("frame {} is cut short", meta.sequence)));
            return None;
        }
        let t_exposure = self.exposure(meta, t_recv, following, clock, tell);
        let data: Arc<[u8]> = Arc::from(&bytes[..needed.unwrap_or(used)]);
        let frame = FramePayload {
            index: 0,
            t_exposure,
            encoding: self.encoding,
            width: self.width,
            height: self.height,
            stride: self.stride,
            data,
        };
        Some((t_recv, frame))
    }

    /// The driver's stamp where it is of the monotonic clock, recent, and later than the last; else
    /// the arrival.
    fn exposure(
        &self,
        meta: &Metadata,
        t_recv: MonoTime,
        following: &mut Following,
        clock: HostClock,
        tell: &dyn Fn(Report),
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
