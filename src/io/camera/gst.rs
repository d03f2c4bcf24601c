//! Frames out of GStreamer: a camera on the network (`rtsp://…`), or any pipeline (`gst:PIPELINE`).
//!
//! The pipeline runs on GStreamer's threads by CLOCK_MONOTONIC and ends in an `appsink` of ours. A frame is stamped with
//! its buffer's own time on that clock: when a live source captured it, or when a file's frame is due. Of planar YUV the
//! first plane, luma, is taken.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;
use tokio::sync::mpsc;

use super::CameraSettings;
use crate::io::clock::HostClock;
use crate::io::device::{Fault, FaultKind, NoteKind, Report, Reports, blocking, wait_for};
use windhover_base::msg::{Bayer, FrameEncoding, FramePayload};
use windhover_base::time::{MonoTime, Span};

/// Frames that wait for the task, as in a driver's buffers; beyond this number they are lost, and counted.
const WAITING: usize = 12;
/// Largest frame, bytes and pixels of a side.
const LARGEST: usize = 64 << 20;
const LONGEST_SIDE: i32 = 16_384;
/// A source that delivers nothing for this long, or for [`FROZEN_FRAMES`] frame times, is frozen. A network camera may
/// take seconds to begin.
const FROZEN: Duration = Duration::from_secs(5);
const FROZEN_FRAMES: f64 = 5.0;
const FIRST_FRAME: Duration = Duration::from_secs(15);
/// A stamp that is farther than this from its frame's arrival is invalid: the arrival replaces it.
const ODD: Span = Span::from_ns(5_000_000_000);
/// Names of our elements.
const SINK: &str = "windhover_frames";
const SOURCE: &str = "windhover_source";
/// What is taken: uncompressed frames in the computer's own memory, mosaics, JPEG.
const CAPS: &str = "video/x-raw,format=(string){GRAY8,NV12,I420,YV12,NV21,Y42B,NV16,Y444,YUY2,UYVY,RGB,BGR,\
                    GRAY16_LE};video/x-bayer,format=(string){rggb,bggr,gbrg,grbg};image/jpeg";

/// Where frames come from.
#[derive(Clone, PartialEq, Eq, Debug)]
enum GstSource {
    /// The address of a network camera.
    Rtsp(String),
    /// A pipeline as `gst-launch-1.0` takes it, without its sink.
    Pipeline(String),
}

impl GstSource {
    /// The source that a device's name stands for.
    fn of(device: &str) -> Self {
        match device.strip_prefix("gst:") {
            Some(pipeline) => Self::Pipeline(pipeline.to_owned()),
            None => Self::Rtsp(device.to_owned()),
        }
    }

    /// Its name in reports: without a password.
    fn name(&self) -> String {
        match self {
            Self::Pipeline(pipeline) => format!("gst:{pipeline}"),
            Self::Rtsp(url) => {
                match url.split_once("://").map(|(scheme, rest)| (scheme, rest.rsplit_once('@'))) {
                    Some((scheme, Some((_, host)))) => format!("{scheme}://…@{host}"),
                    _ => url.clone(),
                }
            }
        }
    }

    fn launch(&self) -> String {
        match self {
            Self::Rtsp(_) => format!(
                "rtspsrc name={SOURCE} latency=200 drop-on-latency=true ! application/x-rtp,media=video ! decodebin \
                 ! appsink name={SINK}"
            ),
            Self::Pipeline(pipeline) => format!("{pipeline} ! appsink name={SINK}"),
        }
    }
}

/// A frame with its stamp, ns of CLOCK_MONOTONIC.
struct Taken {
    stamp_ns: Option<i64>,
    payload: FramePayload,
}

/// A running pipeline. Stopping one may wait for its devices, so a thread does it.
struct Running(gst::Pipeline);

impl Drop for Running {
    fn drop(&mut self) {
        let pipeline = self.0.clone();
        let stop = move || {
            let _ = pipeline.set_state(gst::State::Null);
        };
        // Without a thread there is no memory for one either: the pipeline stops with its last reference.
        let _ = std::thread::Builder::new().name("gst-stop".into()).spawn(stop);
    }
}

/// What GStreamer's threads and the task share.
#[derive(Clone)]
struct Outlet {
    name: Arc<str>,
    frames: mpsc::Sender<Taken>,
    ends: mpsc::UnboundedSender<Fault>,
    ended: Arc<AtomicBool>,
    lost: Arc<AtomicU32>,
    damaged: Arc<AtomicU32>,
}

impl Outlet {
    /// Ends the stream; only the first reason counts.
    fn end(&self, kind: FaultKind, why: impl Into<String>) {
        if !self.ended.swap(true, Ordering::Relaxed) {
            let _ = self.ends.send(Fault::new(kind, &self.name, why));
        }
    }
}

/// Delivers frames until the stream ends, fails or stalls.
pub(super) async fn stream(
    settings: &CameraSettings,
    clock: HostClock,
    reports: Reports<'_>,
    delivered: &mut (dyn FnMut() + Send),
) -> Fault {
    let source = GstSource::of(&settings.device);
    let name = source.name();
    let (frames, mut taken) = mpsc::channel(WAITING);
    let (ends, mut ended) = mpsc::unbounded_channel();
    let outlet = Outlet {
        name: name.as_str().into(),
        frames,
        ends,
        ended: Arc::default(),
        lost: Arc::default(),
        damaged: Arc::default(),
    };
    let (opening, shared) = (source.clone(), outlet.clone());
    let _running = match wait_for(blocking(move || open(&opening, &shared)), reports).await {
        Ok(running) => running,
        // Where an element gave a reason, that is the fault.
        Err(fault) => return ended.try_recv().unwrap_or(fault),
    };
    let frozen = FROZEN.max(Duration::from_secs_f64(FROZEN_FRAMES / settings.fps));
    let mut patience = FIRST_FRAME.max(frozen);
    let mut opened = false;
    loop {
        let next = async {
            tokio::select! {
                biased;
                frame = taken.recv() => frame.ok_or(None),
                fault = ended.recv() => Err(fault),
            }
        };
        let frame = match wait_for(tokio::time::timeout(patience, next), reports).await {
            Ok(Ok(frame)) => frame,
            Ok(Err(fault)) => {
                return fault.unwrap_or_else(|| Fault::new(FaultKind::Failed, &name, "GStreamer stopped"));
            }
            Err(_) => {
                let why = format!("no frame for {:.0} s", patience.as_secs_f64());
                return Fault::new(FaultKind::Frozen, &name, why);
            }
        };
        if !std::mem::replace(&mut opened, true) {
            let FramePayload { width, height, encoding, .. } = &frame.payload;
            let size = if *width > 0 { format!(", {width} × {height}") } else { String::new() };
            reports(Report::Up(format!("GStreamer: {name}{size}, {encoding:?}")));
            patience = frozen;
        }
        notes(&outlet, reports);
        deliver(frame, &name, clock, reports);
        delivered();
    }
}

fn notes(outlet: &Outlet, reports: Reports<'_>) {
    let lost = outlet.lost.swap(0, Ordering::Relaxed);
    if lost > 0 {
        let text = format!("{}: {lost} frames came faster than they could be taken", outlet.name);
        reports(Report::Note(NoteKind::FramesMissed, lost, text));
    }
    let damaged = outlet.damaged.swap(0, Ordering::Relaxed);
    if damaged > 0 {
        let text = format!("{}: {damaged} frames were damaged on their way", outlet.name);
        reports(Report::Note(NoteKind::FrameDamaged, damaged, text));
    }
}

fn deliver(frame: Taken, name: &str, clock: HostClock, reports: Reports<'_>) {
    let now = clock.now();
    let stamp = frame.stamp_ns.map(|ns| MonoTime::from_ns(ns.saturating_add(clock.less_monotonic().ns())));
    let usable = stamp.filter(|stamp| (now - *stamp).abs() <= ODD);
    if usable.is_none() {
        let words = match stamp {
            Some(stamp) => format!("{name}: a frame is stamped {:.1} s from its arrival", (now - stamp).s()),
            None => format!("{name}: a frame has no stamp"),
        };
        reports(Report::Note(NoteKind::StampsUnusable, 1, words));
    }
    let payload = FramePayload { t_exposure: usable.unwrap_or(now), ..frame.payload };
    reports(Report::Frame(now, payload));
}

/// Builds and starts a pipeline; its frames and its end go to `outlet`.
fn open(source: &GstSource, outlet: &Outlet) -> Result<Running, Fault> {
    let fault = |kind, why: String| Fault::new(kind, &outlet.name, why);
    gst::init().map_err(|error| fault(FaultKind::Failed, format!("GStreamer does not start: {error}")))?;
    let words = |error: gst::glib::Error| {
        let kind = if error.matches(gst::ParseError::NoSuchElement) {
            FaultKind::Missing
        } else {
            FaultKind::Unsuitable
        };
        fault(kind, error.message().to_owned())
    };
    let built = gst::parse::launch(&source.launch()).map_err(words)?;
    let no_pipeline = || fault(FaultKind::Unsuitable, "this is no pipeline".into());
    let pipeline = built.downcast::<gst::Pipeline>().map_err(|_| no_pipeline())?;
    let running = Running(pipeline);
    let pipeline = &running.0;
    if let (GstSource::Rtsp(url), Some(element)) = (source, pipeline.by_name(SOURCE)) {
        element.set_property("location", url.as_str());
    }
    let sink = pipeline.by_name(SINK).and_then(|sink| sink.downcast::<gst_app::AppSink>().ok());
    let sink = sink.ok_or_else(no_pipeline)?;
    let monotonic = gst::SystemClock::obtain();
    monotonic.set_property_from_str("clock-type", "monotonic");
    pipeline.use_clock(Some(&monotonic));
    let caps: gst::Caps =
        CAPS.parse().map_err(|_| fault(FaultKind::Failed, "GStreamer knows no video".into()))?;
    sink.set_caps(Some(&caps));
    sink.set_max_buffers(1);
    sink.set_drop(true);
    let frames = outlet.clone();
    let taken = move |sink: &gst_app::AppSink| take(sink, &frames);
    sink.set_callbacks(gst_app::AppSinkCallbacks::builder().new_sample(taken).build());
    listen(pipeline, outlet);
    let refused = |_| fault(FaultKind::Failed, "the pipeline does not start".into());
    // A live source has nothing to show before it plays, and its frames are taken as they come; others wait until due.
    let live = pipeline.set_state(gst::State::Paused).map_err(refused)? == gst::StateChangeSuccess::NoPreroll;
    sink.set_sync(!live);
    pipeline.set_state(gst::State::Playing).map_err(refused)?;
    Ok(running)
}

/// Hands the pipeline's end and its errors to the task.
fn listen(pipeline: &gst::Pipeline, outlet: &Outlet) {
    let Some(bus) = pipeline.bus() else { return };
    let outlet = outlet.clone();
    bus.set_sync_handler(move |_, message| {
        match message.view() {
            gst::MessageView::Eos(_) => outlet.end(FaultKind::Unplugged, "the stream ended"),
            gst::MessageView::Error(error) => {
                let (error, element) = (error.error(), error.src().map(|source| source.name()));
                let element = element.map_or_else(String::new, |name| format!("{name}: "));
                outlet.end(kind_of(&error), format!("{element}{}", error.message()));
            }
            _ => {}
        }
        gst::BusSyncReply::Drop
    });
}

fn kind_of(error: &gst::glib::Error) -> FaultKind {
    use gst::ResourceError::{Busy, NotAuthorized, NotFound, OpenRead, OpenReadWrite};
    match error.kind::<gst::ResourceError>() {
        Some(NotFound | OpenRead | OpenReadWrite) => return FaultKind::Missing,
        Some(Busy) => return FaultKind::Busy,
        Some(NotAuthorized) => return FaultKind::Denied,
        Some(_) => return FaultKind::Unplugged,
        None => {}
    }
    if error.is::<gst::StreamError>() || error.is::<gst::CoreError>() {
        return FaultKind::Unsuitable;
    }
    FaultKind::Failed
}

/// Takes the sink's frame, on a thread of GStreamer: never waits.
fn take(sink: &gst_app::AppSink, outlet: &Outlet) -> Result<gst::FlowSuccess, gst::FlowError> {
    let sample = sink.pull_sample().map_err(|_| gst::FlowError::Eos)?;
    let (Some(buffer), Some(caps)) = (sample.buffer(), sample.caps()) else {
        return Ok(gst::FlowSuccess::Ok);
    };
    let shape = shape(caps).map_err(|why| {
        outlet.end(FaultKind::Unsuitable, why);
        gst::FlowError::NotNegotiated
    })?;
    let running = buffer.pts().zip(sample.segment()).and_then(|(pts, segment)| {
        segment.downcast_ref::<gst::ClockTime>().and_then(|segment| segment.to_running_time(pts))
    });
    let stamp = running.zip(sink.base_time()).and_then(|(running, base)| base.checked_add(running));
    let Some(data) = pixels(buffer, &shape) else {
        outlet.damaged.fetch_add(1, Ordering::Relaxed);
        return Ok(gst::FlowSuccess::Ok);
    };
    let payload = FramePayload {
        index: 0,
        t_exposure: MonoTime::default(),
        encoding: shape.encoding,
        width: shape.width,
        height: shape.height,
        stride: shape.stride,
        data,
    };
    let stamp_ns = stamp.and_then(|stamp| i64::try_from(stamp.nseconds()).ok());
    match outlet.frames.try_send(Taken { stamp_ns, payload }) {
        Ok(()) => Ok(gst::FlowSuccess::Ok),
        Err(mpsc::error::TrySendError::Full(_)) => {
            outlet.lost.fetch_add(1, Ordering::Relaxed);
            Ok(gst::FlowSuccess::Ok)
        }
        Err(mpsc::error::TrySendError::Closed(_)) => Err(gst::FlowError::Eos),
    }
}

/// The form of a stream's frames; sizes are 0 for compressed ones.
struct Shape {
    encoding: FrameEncoding,
    width: u32,
    height: u32,
    stride: u32,
}

/// The form that caps state. Rows are padded to four bytes, as GStreamer lays frames out where nothing else is agreed.
fn shape(caps: &gst::CapsRef) -> Result<Shape, String> {
    let structure = caps.structure(0).ok_or("the stream has no format")?;
    if structure.name() == "image/jpeg" {
        return Ok(Shape { encoding: FrameEncoding::Jpeg, width: 0, height: 0, stride: 0 });
    }
    let format: &str = structure.get("format").map_err(|_| "the stream has no format")?;
    let (encoding, pixel) = match format {
        "GRAY8" | "NV12" | "I420" | "YV12" | "NV21" | "Y42B" | "NV16" | "Y444" => (FrameEncoding::Grey, 1),
        "YUY2" => (FrameEncoding::Yuyv, 2),
        "UYVY" => (FrameEncoding::Uyvy, 2),
        "RGB" => (FrameEncoding::Rgb24, 3),
        "BGR" => (FrameEncoding::Bgr24, 3),
        "GRAY16_LE" => (FrameEncoding::Y16, 2),
        "rggb" => (FrameEncoding::Bayer(Bayer::Rggb), 1),
        "bggr" => (FrameEncoding::Bayer(Bayer::Bggr), 1),
        "gbrg" => (FrameEncoding::Bayer(Bayer::Gbrg), 1),
        "grbg" => (FrameEncoding::Bayer(Bayer::Grbg), 1),
        _ => return Err(format!("frames of format {format} are not supported")),
    };
    let side = |name: &str| {
        let length: i32 = structure.get(name).map_err(|_| format!("the stream has no {name}"))?;
        u32::try_from(length)
            .ok()
            .filter(|_| (1..=LONGEST_SIDE).contains(&length))
            .ok_or_else(|| format!("frames of {name} {length} are not supported; 1 to {LONGEST_SIDE} are"))
    };
    let (width, height) = (side("width")?, side("height")?);
    Ok(Shape { encoding, width, height, stride: (width * pixel).next_multiple_of(4) })
}

/// A buffer's pixels; `None` where it was damaged, or has another number than its form.
fn pixels(buffer: &gst::BufferRef, shape: &Shape) -> Option<Arc<[u8]>> {
    let length = match shape.encoding {
        FrameEncoding::Jpeg => buffer.size(),
        _ => shape.stride as usize * shape.height as usize,
    };
    let damaged = buffer.flags().intersects(gst::BufferFlags::CORRUPTED);
    if damaged || length == 0 || length > LARGEST || buffer.size() < length {
        return None;
    }
    let map = buffer.map_readable().ok()?;
    Some(Arc::from(map.as_slice().get(..length)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_told_apart_and_a_password_is_not_shown() {
        let url = "rtsp://user:p@ss@10.0.0.9:554/main";
        let camera = GstSource::of(url);
        assert_eq!(camera, GstSource::Rtsp(url.into()));
        assert_eq!(camera.name(), "rtsp://…@10.0.0.9:554/main");
        assert_eq!(GstSource::of("gst:videotestsrc"), GstSource::Pipeline("videotestsrc".into()));
    }

    #[test]
    fn a_form_is_within_limits() {
        gst::init().expect("GStreamer");
        let of = |text: &str| shape(&text.parse::<gst::Caps>().expect("caps"));
        let odd = of("video/x-raw,format=GRAY8,width=641,height=7").expect("a form");
        assert_eq!((odd.encoding, odd.width, odd.height, odd.stride), (FrameEncoding::Grey, 641, 7, 644));
        assert_eq!(of("video/x-raw,format=BGR,width=3,height=3").expect("a form").stride, 12);
        assert_eq!(of("image/jpeg").expect("a form").encoding, FrameEncoding::Jpeg);
        for text in [
            "video/x-raw,format=GRAY8,width=0,height=7",
            "video/x-raw,format=GRAY8,width=7,height=70000",
            "video/x-raw,format=GRAY8,height=7",
            "video/x-raw,format=BGRx,width=4,height=4",
            "audio/x-raw",
        ] {
            assert!(of(text).is_err(), "{text}");
        }
    }
}
