//! Keeps a camera's exposure and gain as requested while it streams.

use tokio::sync::{oneshot, watch};
use tokio::task::spawn_blocking;

use super::controls::{self, Control, EXPOSURE_UNIT_US, Plan};
use super::metering::{Light, Metering, Setting};
use super::node::Node;
use crate::io::camera::ExposureSettings;
use crate::io::device::{NoteKind, Report};
use crate::pixels;
use windhover_base::msg::FramePayload;
use windhover_base::time::{MonoTime, Span};

/// Time and frames from one measurement of the light to the next: a setting takes effect some frames later.
const PERIOD: Span = Span::from_ns(250_000_000);
const FRAMES: u32 = 4;

/// Exposure and gain of one open camera. Its calls to the camera wait for USB, so they run on threads for blocking work.
pub(super) struct Exposure {
    node: Node,
    wanted: watch::Receiver<ExposureSettings>,
    metering: Option<Metering>,
    work: Option<oneshot::Receiver<Done>>,
    measured: Option<MonoTime>,
    frames: u32,
}

/// What a piece of work leaves.
struct Done {
    metering: Option<Metering>,
    reports: Vec<Report>,
}

impl Exposure {
    /// Sets what is requested now, on this thread; also returns the notes to report.
    pub(super) fn set(node: Node, mut wanted: watch::Receiver<ExposureSettings>) -> (Self, Vec<Report>) {
        let settings = *wanted.borrow_and_update();
        let Done { metering, reports } = apply(&node, &settings);
        (Self { node, wanted, metering, work: None, measured: None, frames: 0 }, reports)
    }

    /// Follows a changed request and, where the light decides, the light of this frame; returns the notes to report.
    pub(super) fn follow(&mut self, frame: &FramePayload) -> Vec<Report> {
        self.frames += 1;
        let mut reports = Vec::new();
        if let Some(work) = &mut self.work {
            match work.try_recv() {
                Ok(done) => {
                    self.metering = done.metering;
                    reports = done.reports;
                }
                Err(oneshot::error::TryRecvError::Empty) => return reports,
                // The work ended without a result: as it was.
                Err(oneshot::error::TryRecvError::Closed) => {}
            }
            self.work = None;
        }
        let due = self.frames >= FRAMES && self.measured.is_none_or(|t| frame.t_exposure - t >= PERIOD);
        if self.wanted.has_changed().unwrap_or(false) {
            let settings = *self.wanted.borrow_and_update();
            let node = self.node.clone();
            self.begin(frame.t_exposure, move || apply(&node, &settings));
        } else if let Some(metering) = self.metering.clone().filter(|_| due) {
            let (node, frame) = (self.node.clone(), frame.clone());
            self.begin(frame.t_exposure, move || measure(&node, metering, &frame));
        }
        reports
    }

    fn begin(&mut self, t: MonoTime, work: impl FnOnce() -> Done + Send + 'static) {
        (self.measured, self.frames) = (Some(t), 0);
        let (sender, done) = oneshot::channel();
        // The camera may be closed meanwhile: then nobody takes the result.
        spawn_blocking(move || drop(sender.send(work())));
        self.work = Some(done);
    }
}

/// Sets what is requested.
fn apply(node: &Node, settings: &ExposureSettings) -> Done {
    let has = |control: Control| node.limits(control.id());
    let plan = Plan::new(settings, &has);
    let lacks: Vec<String> = plan.lacks.iter().cloned().chain(plan.apply(node)).collect();
    let mut reports: Vec<Report> =
        lacks.into_iter().map(|text| Report::Note(NoteKind::ExposureNotSet, 1, text)).collect();
    let metering = settings.auto_max_us.and_then(|us| metering(node, us, settings.gain.is_some()));
    if !plan.sets.is_empty() {
        let text = shown(node, metering.is_some());
        reports.push(Report::Note(NoteKind::ExposureSet, 1, text));
    }
    Done { metering, reports }
}

/// The automatic exposure up to a limit; `None` where the camera has no control for it.
fn metering(node: &Node, max_us: f64, gain_is_fixed: bool) -> Option<Metering> {
    let has = |control: Control| node.limits(control.id());
    let exposure = controls::longest(has(Control::Exposure)?, max_us);
    let gain = controls::gain_of(&has).filter(|_| !gain_is_fixed);
    let gain = gain.and_then(|(control, limits)| Some((limits, node.control(control.id())?)));
    let now = Setting {
        exposure: exposure.most,
        gain: gain.map(|(limits, now)| now.clamp(limits.least, limits.most)),
    };
    Some(Metering::new(exposure, gain.map(|(limits, _)| limits), now))
}

/// Measures the light of a frame and sets exposure and gain by it.
fn measure(node: &Node, mut metering: Metering, frame: &FramePayload) -> Done {
    let light = pixels::decode(frame, false).ok().and_then(|decoded| Light::of(&decoded.gray));
    let Some(setting) = light.and_then(|light| metering.step(light)) else {
        return Done { metering: Some(metering), reports: Vec::new() };
    };
    let has = |control: Control| node.limits(control.id());
    let gain = setting.gain.zip(controls::gain_of(&has)).map(|(value, (control, _))| (control, value));
    let sets = std::iter::once((Control::Exposure, setting.exposure)).chain(gain);
    let refused: Vec<String> =
        sets.filter_map(|(control, value)| controls::set(node, control, value).err()).collect();
    // A camera that refuses once is left alone until it is opened again.
    let metering = refused.is_empty().then_some(metering);
    let note = |text| Report::Note(NoteKind::ExposureNotSet, 1, text);
    Done { metering, reports: refused.into_iter().map(note).collect() }
}

/// Exposure and gain as the camera has them now, in words.
fn shown(node: &Node, automatic: bool) -> String {
    let exposure = node.control(Control::Exposure.id()).map_or_else(
        || "exposure unknown".into(),
        |value| format!("exposure {:.0} µs", f64::from(value) * EXPOSURE_UNIT_US),
    );
    let has = |control: Control| node.limits(control.id());
    let gain = controls::gain_of(&has).and_then(|(control, _)| node.control(control.id()));
    let gain = gain.map_or_else(String::new, |value| format!(", gain {value}"));
    let follows = if automatic { "; both follow the light from here on" } else { "" };
    format!("{exposure}{gain}{follows}")
}
