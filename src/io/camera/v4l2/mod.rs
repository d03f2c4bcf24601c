//! A V4L2 camera: negotiates a format, streams mapped buffers, and tolerates errors of the driver.

mod buffers;
mod controls;
mod exposure;
mod frame;
mod metering;
mod node;

use std::convert::Infallible;
use std::io::ErrorKind::{Interrupted, WouldBlock};
use std::os::fd::{AsRawFd, RawFd};
use std::sync::Arc;
use std::time::Duration;

use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::sync::watch;
use v4l::device::Handle;

use super::format;
use super::{CameraSettings, ExposureSettings};
use crate::io::clock::HostClock;
use crate::io::device::{
    Fault, FaultKind, NoteKind, Opened, OwnsDescriptor, Report, Reports, blocking, catch_panics, register,
    wait_for,
};
use buffers::Buffers;
use exposure::Exposure;
use frame::{Following, Frames};
use node::{Api, Given, Node, NotOpen};
use windhover_base::msg::FrameEncoding;

/// Mapped buffers. One is being copied while the others fill: at 30 frames a second the driver can continue for a third
/// of a second while this task waits for a processor. A driver with less memory gives fewer.
const BUFFERS: u32 = 12;

/// A camera that delivers no frame for this long, or for [`FROZEN_FRAMES`] frame times, is frozen.
const FROZEN: Duration = Duration::from_secs(2);
const FROZEN_FRAMES: f64 = 5.0;

/// `POLLIN` of poll(2), the same on every Linux.
const POLLIN: i16 = 1;

/// Streams until the device is lost. Any panic of the V4L2 library (its handle's `Drop` panics where a descriptor does not
/// close) means that the device is lost.
pub(super) async fn stream(
    settings: &CameraSettings,
    exposure: &watch::Receiver<ExposureSettings>,
    clock: HostClock,
    reports: Reports<'_>,
    delivered: &mut (dyn FnMut() + Send),
) -> Fault {
    match try_stream(settings, exposure, clock, reports, delivered).await {
        Ok(never) => match never {},
        Err(fault) => fault,
    }
}

async fn try_stream(
    settings: &CameraSettings,
    exposure: &watch::Receiver<ExposureSettings>,
    clock: HostClock,
    reports: Reports<'_>,
    delivered: &mut (dyn FnMut() + Send),
) -> Result<Infallible, Fault> {
    let lost = || {
        let what = "the driver failed; the camera is opened again";
        Fault::new(FaultKind::Unplugged, &settings.device, what)
    };
    // Opening talks to the device, which takes time over USB.
    let (asked, wanted) = (settings.clone(), exposure.clone());
    let opened = blocking(move || catch_panics(|| open(asked, wanted))).await;
    let (camera, found) = opened.ok_or_else(lost)??;
    found.into_iter().for_each(reports);
    let started = blocking(move || catch_panics(|| camera.start())).await;
    let mut running = Opened::new(started.ok_or_else(lost)??);
    let fault = loop {
        let next = match running.readable(reports).await {
            Ok(()) => catch_panics(|| running.take_next(clock)).unwrap_or_else(|| Err(lost())),
            Err(fault) => Err(fault),
        };
        match next {
            Ok(taken) => {
                for report in taken {
                    let notes = running.exposure_notes(&report);
                    if matches!(report, Report::Frame(..)) {
                        delivered();
                    }
                    reports(report);
                    notes.into_iter().for_each(reports);
                }
            }
            Err(fault) => break fault,
        }
    };
    running.close().await;
    Err(fault)
}

/// The negotiated camera.
struct Camera {
    settings: CameraSettings,
    node: Node,
    exposure: Exposure,
    frames: Frames,
}

/// Opens the camera, agrees on a format and sets the exposure; also returns the notes to report.
fn open(
    settings: CameraSettings,
    wanted: watch::Receiver<ExposureSettings>,
) -> Result<(Camera, Vec<Report>), Fault> {
    let path = settings.device.as_str();
    let unsuitable = |text: String| Fault::new(FaultKind::Unsuitable, path, text);
    let node = Node::open(path).map_err(|error| match error {
        NotOpen::Io(error) => Fault::from_io(path, &error),
        NotOpen::NoCamera => unsuitable("is not a camera (V4L2)".into()),
        NotOpen::NoStream(card) => {
            unsuitable(format!("{card} delivers no video stream; is it the right node?"))
        }
    })?;
    let (given, encoding) = negotiate(&node, &settings)?;
    let mut reports = Vec::new();
    let asked = format::fourcc(settings.pixel_format);
    if given.code != asked {
        let text =
            format!("requested {}, the driver delivers {}", format::name(asked), format::name(given.code));
        reports.push(Report::Note(NoteKind::FormatDiffers, 1, text));
    }
    let fps = node.set_rate(settings.fps);
    let rate = fps.map_or_else(|| "its own rate".into(), |fps| format!("{fps:.1} frames/s"));
    let api = if node.api == Api::Planes { ", multi-planar" } else { "" };
    reports.push(Report::Up(format!(
        "{path}: {} ({}{api}), {} {}x{}, {rate}",
        node.card,
        node.driver,
        format::name(given.code),
        given.width,
        given.height
    )));
    let (exposure, notes) = Exposure::set(node.clone(), wanted);
    reports.extend(notes);
    let frames =
        Frames { encoding, width: given.width, height: given.height, stride: stride(&given, encoding) };
    Ok((Camera { settings, node, exposure, frames }, reports))
}

/// Agrees with the driver on a format.
fn negotiate(node: &Node, settings: &CameraSettings) -> Result<(Given, FrameEncoding), Fault> {
    let path = settings.device.as_str();
    let unsuitable = |text: String| Fault::new(FaultKind::Unsuitable, path, text);
    let offered = node.formats();
    let offer = || offered.iter().map(|&code| format::name(code)).collect::<Vec<_>>().join(", ");
    let wanted = format::choose(format::fourcc(settings.pixel_format), &offered)
        .ok_or_else(|| unsuitable(format!("offers {} and none of them is supported", offer())))?;
    let given =
        node.set_format(wanted, settings.width, settings.height).map_err(|e| Fault::from_io(path, &e))?;
    let encoding = usable(&given, (settings.width, settings.height))
        .map_err(|why| unsuitable(format!("{why}; it offers {}", offer())))?;
    Ok((given, encoding))
}

/// How frames of the format that the driver set are read, or why they cannot be.
fn usable(given: &Given, (width, height): (u32, u32)) -> Result<FrameEncoding, String> {
    if (given.width, given.height) != (width, height) {
        return Err(format!(
            "delivers {}x{} where camera.width and camera.height request {width}x{height}",
            given.width, given.height
        ));
    }
    if given.planes != 1 {
        return Err(format!(
            "delivers {} in {} separate memory planes, which is not supported (formats of one plane are)",
            format::name(given.code),
            given.planes
        ));
    }
    format::encoding(given.code)
        .ok_or_else(|| format!("delivers {}, which is not supported", format::name(given.code)))
}

/// Bytes from row to row.
const fn stride(given: &Given, encoding: FrameEncoding) -> u32 {
    if given.stride == 0 { format::packed_stride(encoding, given.width) } else { given.stride }
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
    stream: Buffers,
    following: Following,
}

impl Camera {
    /// Starts the stream.
    fn start(self) -> Result<Running, Fault> {
        let fault = |error: &std::io::Error| Fault::from_io(&self.settings.device, error);
        let stream = Buffers::start(self.node.clone(), BUFFERS).map_err(|e| fault(&e))?;
        // An error state of the driver is not readiness to read, but it must be noticed.
        let interest = Interest::READABLE | Interest::ERROR;
        let ready = register(Descriptor(self.node.handle()), interest).map_err(|e| fault(&e))?;
        Ok(Running { camera: self, ready, stream, following: Following::default() })
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
        let (frames, following) = (&self.camera.frames, &mut self.following);
        let taken = self.stream.next(|filled| {
            let mut reports = Vec::new();
            let t_recv = clock.now();
            let frame = frames.take(filled, t_recv, following, clock, &mut |report| reports.push(report));
            reports.extend(frame.map(|frame| Report::Frame(t_recv, frame)));
            reports
        });
        match taken {
            Ok(reports) => Ok(reports),
            Err(error) if matches!(error.kind(), Interrupted | WouldBlock) => Ok(Vec::new()),
            Err(error) => Err(self.camera.lost(&error)),
        }
    }

    /// Follows the light and the requests for exposure; returns the notes to report.
    fn exposure_notes(&mut self, report: &Report) -> Vec<Report> {
        match report {
            Report::Frame(_, frame) => self.camera.exposure.follow(frame),
            _ => Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_of_several_memory_planes_are_refused_in_words() {
        let given = Given { code: *b"NV12", width: 640, height: 480, stride: 704, planes: 1 };
        assert_eq!(usable(&given, (640, 480)), Ok(FrameEncoding::Nv12));
        assert_eq!(stride(&given, FrameEncoding::Nv12), 704);
        assert_eq!(stride(&Given { stride: 0, ..given }, FrameEncoding::Nv12), 640);
        let two = usable(&Given { code: *b"NM12", planes: 2, ..given }, (640, 480)).unwrap_err();
        assert!(two.contains("NM12 in 2 separate memory planes"), "{two}");
        let other = usable(&Given { code: *b"H264", ..given }, (640, 480)).unwrap_err();
        assert!(other.contains("H264"), "{other}");
        let size = usable(&given, (1280, 1024)).unwrap_err();
        assert!(size.contains("640x480") && size.contains("1280x1024"), "{size}");
    }
}
