//! The camera as a task: a V4L2 device, a recording played at its own pace, frames of another program, or GStreamer.

mod format;
#[cfg(feature = "gstreamer")]
mod gst;
mod recorded;
mod socket;
mod trigger;
mod v4l2;

pub use socket::grey_header;
pub use trigger::TriggerCount;

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::watch;

use windhover_base::settings::PixelFormat;

use super::clock::HostClock;
use super::device::{Backoff, Fault, NoteKind, Report, Reports};
use trigger::Counted;

/// The requested settings of the camera.
#[derive(Clone, PartialEq, Debug)]
pub struct CameraSettings {
    /// Path of a V4L2 device; `capture:PATH` for a recording (`capture-loop:PATH` plays it repeatedly); `socket:PATH`
    /// for frames of another program (`socket.rs`); `rtsp://…` or `gst:PIPELINE` for GStreamer (`gst.rs`, built with
    /// the feature `gstreamer`).
    pub device: String,
    /// Frame width, pixels.
    pub width: u32,
    /// Frame height, pixels.
    pub height: u32,
    /// Requested frame rate, frames a second.
    pub fps: f64,
    /// Requested format; another supported format is used where the driver delivers that.
    pub pixel_format: PixelFormat,
}

/// What is requested of exposure and gain. Where nothing is, the camera keeps its own.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct ExposureSettings {
    /// Fixed exposure, µs.
    pub exposure_us: Option<f64>,
    /// Longest automatic exposure, µs.
    pub auto_max_us: Option<f64>,
    /// Fixed gain, in the driver's units.
    pub gain: Option<i32>,
}

/// What a camera follows while it runs.
#[derive(Clone, Debug)]
pub struct CameraInputs {
    /// Exposure and gain; a change takes effect at once.
    pub exposure: watch::Receiver<ExposureSettings>,
    /// The pulses that trigger the camera, where they are counted.
    pub trigger: Option<Arc<Mutex<TriggerCount>>>,
}

/// Delivers frames without end; dropping the future closes the camera.
pub async fn run(
    settings: &CameraSettings,
    inputs: &CameraInputs,
    clock: HostClock,
    reports: Reports<'_>,
) -> Infallible {
    let recording = |prefix| settings.device.strip_prefix(prefix).map(str::to_owned);
    let mut backoff = Backoff::new();
    let counted = |report| counted(report, inputs.trigger.as_deref(), reports);
    let reports: Reports<'_> = &counted;
    loop {
        let fault = if let Some(path) = recording("capture:") {
            without_controls(inputs, reports);
            recorded::play(&path, settings, false, clock, reports).await
        } else if let Some(path) = recording("capture-loop:") {
            without_controls(inputs, reports);
            recorded::play(&path, settings, true, clock, reports).await
        } else if let Some(path) = recording("socket:") {
            without_controls(inputs, reports);
            socket::stream(&path, clock, reports, &mut || backoff.reset()).await
        } else if is_gstreamer(&settings.device) {
            without_controls(inputs, reports);
            gstreamer(settings, clock, reports, &mut || backoff.reset()).await
        } else {
            v4l2::stream(settings, &inputs.exposure, clock, reports, &mut || backoff.reset()).await
        };
        reports(Report::Down(fault));
        backoff.wait(reports).await;
    }
}

/// Whether a device is opened by GStreamer.
fn is_gstreamer(device: &str) -> bool {
    ["rtsp://", "rtsps://", "gst:"].iter().any(|prefix| device.starts_with(prefix))
}

#[cfg(feature = "gstreamer")]
async fn gstreamer(
    settings: &CameraSettings,
    clock: HostClock,
    reports: Reports<'_>,
    delivered: &mut (dyn FnMut() + Send),
) -> Fault {
    gst::stream(settings, clock, reports, delivered).await
}

#[cfg(not(feature = "gstreamer"))]
async fn gstreamer(
    settings: &CameraSettings,
    _clock: HostClock,
    _reports: Reports<'_>,
    _delivered: &mut (dyn FnMut() + Send),
) -> Fault {
    let advice = "this windhover was built without GStreamer: build it with `cargo build --release --features gstreamer`";
    Fault::new(super::device::FaultKind::Unsuitable, &settings.device, advice)
}

/// Reports that a source of frames without controls cannot do what is requested.
fn without_controls(inputs: &CameraInputs, reports: Reports<'_>) {
    if *inputs.exposure.borrow() != ExposureSettings::default() {
        let text = "only a V4L2 camera has controls of exposure and gain; those configured have no effect";
        reports(Report::Note(NoteKind::ExposureNotSet, 1, text.into()));
    }
}

/// Passes a report on; counts frames against the pulses of the trigger, where there are any. The driver's own count of
/// missed frames is then left out, since it counts a part of the same frames.
fn counted(report: Report, trigger: Option<&Mutex<TriggerCount>>, reports: Reports<'_>) {
    let Some(trigger) = trigger else { return reports(report) };
    let mut count = trigger.lock().unwrap_or_else(PoisonError::into_inner);
    let note = match &report {
        Report::Up(_) => {
            count.restart();
            None
        }
        Report::Frame(_, frame) => match count.frame(frame.t_exposure) {
            Counted::Complete => None,
            Counted::Silent => {
                let text =
                    "frames arrive but no pulses on camera.trigger_line: lost frames are not counted by it";
                Some(Report::Note(NoteKind::TriggerSilent, 1, text.into()))
            }
            Counted::Lost(lost, first) => {
                let before_ms = (frame.t_exposure - first).ms();
                let text = format!(
                    "{lost} pulses of the trigger without a frame, the first {before_ms:.0} ms before this one"
                );
                Some(Report::Note(NoteKind::FramesMissed, lost, text))
            }
        },
        Report::Note(NoteKind::FramesMissed, ..) if count.counts() => return,
        _ => None,
    };
    drop(count);
    note.into_iter().for_each(reports);
    reports(report);
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::msg::{FrameEncoding, FramePayload};
    use windhover_base::time::{MonoTime, Span};

    #[test]
    fn a_lost_frame_is_reported_once_whoever_counts_it() {
        let trigger = Mutex::new(TriggerCount::default());
        let missed = Mutex::new(0);
        let reports = |report: Report| {
            if let Report::Note(NoteKind::FramesMissed, count, _) = report {
                *missed.lock().expect("one thread") += count;
            }
        };
        let at = |ms: u32| MonoTime::default() + Span::from_ms(f64::from(ms));
        for index in 0..40 {
            trigger.lock().expect("one thread").pulse(at(index * 50));
            if index == 17 {
                continue;
            }
            if index == 18 {
                let driver = Report::Note(NoteKind::FramesMissed, 1, "1 frames were not delivered".into());
                counted(driver, Some(&trigger), &reports);
            }
            let frame = FramePayload {
                index,
                t_exposure: at(index * 50 + 20),
                encoding: FrameEncoding::Grey,
                width: 0,
                height: 0,
                stride: 0,
                data: Arc::from([]),
            };
            counted(Report::Frame(at(index * 50 + 25), frame), Some(&trigger), &reports);
        }
        assert_eq!(*missed.lock().expect("one thread"), 1);
    }
}
