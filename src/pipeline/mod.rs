//! The single path from events to outputs, live and in replay.
//!
//! [`Pipeline::handle`] takes received events in the order of their reception and appends the outputs that follow. It
//! reads no clock: time comes from the events, and so do the ticks at which time-outs are checked. A replay of the same
//! events therefore gives the same outputs to the last bit.

mod frame_pace;
mod frames;
mod lines;
mod misfit_words;
mod misfits;
mod monitor;
mod readings;
mod seen;
mod settings;
mod site;
mod ticks;

pub use settings::PipelineSettings;
pub use site::site_of;

use std::sync::Arc;

use crate::pixels::{self, DecodedFrame, FrameFault};
use frame_pace::FramePace;
use lines::{Sample, SourceLines};
use monitor::Monitor;
use seen::SeenMarkers;
use site::SiteFinder;
use ticks::{Due, Schedule};
use windhover_base::geo::Tile;
use windhover_base::msg::{
    EstimatorOutput, Event, EventBody, FrameObservations, FramePrediction, Output, SensorReading, Source,
    Stamped, TargetEstimate, TimedOutput, WarmFilter, WarmSite, WarmState,
};
use windhover_base::time::{FrameClock, MonoTime};
use windhover_detect::tracking::FrameDetector;
use windhover_estimate::{Estimator, PaperEstimator};

/// Events in, outputs out.
pub struct Pipeline {
    settings: PipelineSettings,
    want_rgb: bool,
    lines: SourceLines,
    detector: FrameDetector,
    observations: FrameObservations,
    prediction: FramePrediction,
    finder: SiteFinder,
    estimators: Option<Estimators>,
    /// Measurements since the first of the fixes that agree: the filter begins with them.
    held: Vec<SensorReading>,
    /// The filter state of an earlier run, until there is a filter to continue it.
    warm: Option<WarmFilter>,
    monitor: Monitor,
    seen: SeenMarkers,
    schedule: Schedule,
    /// Time of the last event or tick.
    now: MonoTime,
    last_exposure: Option<MonoTime>,
    pace: FramePace,
    exposures: FrameClock,
    outputs: Vec<Output>,
    readings: Vec<SensorReading>,
    estimated: Vec<EstimatorOutput>,
    papered: Vec<TargetEstimate>,
}

/// The parts that need the site of the flight.
struct Estimators {
    joint: Estimator,
    paper: PaperEstimator,
    site: WarmSite,
}

impl Pipeline {
    /// A pipeline with these settings, before its first event.
    pub fn new(settings: PipelineSettings) -> Self {
        Self::with_terrain(settings, None)
    }

    /// The same, over the terrain tile that `ground.terrain` of the configuration names.
    pub fn with_terrain(settings: PipelineSettings, terrain: Option<Arc<Tile>>) -> Self {
        let rig = &settings.rig;
        let mut lines = SourceLines::new(rig);
        let watched = Source::ALL.iter().copied().filter(|source| lines.awaits(*source)).collect();
        Self {
            want_rgb: frames::wants_rgb(&rig.target),
            lines,
            detector: FrameDetector::new(&settings.detector, &rig.target, &rig.camera.intrinsics),
            observations: FrameObservations::default(),
            prediction: FramePrediction::default(),
            finder: SiteFinder::new(&settings, terrain),
            estimators: None,
            held: Vec::new(),
            warm: None,
            monitor: Monitor::new(watched, rig),
            seen: SeenMarkers::new(rig),
            schedule: Schedule::new(settings.filter.ownship_hz),
            now: MonoTime::default(),
            last_exposure: None,
            pace: FramePace::new(rig.camera.fps),
            exposures: FrameClock::default(),
            outputs: Vec::new(),
            readings: Vec::new(),
            estimated: Vec::new(),
            papered: Vec::new(),
            settings,
        }
    }

    /// The state from which a restarted program continues; `None` while the site is not settled.
    pub fn warm_state(&self) -> Option<WarmState> {
        let estimators = self.estimators.as_ref()?;
        Some(WarmState {
            site: estimators.site,
            arrivals: self.lines.gps.arrivals(),
            filter: estimators.joint.warm_state(),
        })
    }

    /// Takes an event; appends the outputs that follow from it and from the time that passed before it.
    pub fn handle(&mut self, event: &Event, out: &mut Vec<TimedOutput>) {
        self.handle_prepared(event, None, out);
    }

    /// The latest tick that is due at `now`; `None` if it was already made. Where no events arrive, an
    /// [`EventBody::Tick`] with this time lets time pass.
    pub fn tick_due(&mut self, now: MonoTime) -> Option<MonoTime> {
        self.schedule.due(now)
    }

    /// The first tick after `now`: the caller may wait for an event until then.
    pub fn next_tick(&self, now: MonoTime) -> MonoTime {
        self.schedule.next(now)
    }

    /// As [`Self::handle`], with the event's frame already decoded elsewhere.
    pub fn handle_prepared(
        &mut self,
        event: &Event,
        prepared: Option<Result<DecodedFrame, FrameFault>>,
        out: &mut Vec<TimedOutput>,
    ) {
        let mut outputs = std::mem::take(&mut self.outputs);
        for (t, due) in self.schedule.until(event.t_recv) {
            match due {
                Due::TimeOuts => self.time_outs(t, event.seq, &mut outputs),
                Due::Ownship => self.ownship(t, &mut outputs),
            }
            self.pass_on(t, &mut outputs, out);
        }
        if !matches!(event.body, EventBody::Tick) {
            self.event(event, prepared, &mut outputs);
            self.pass_on(event.t_recv, &mut outputs, out);
        }
        self.outputs = outputs;
    }

    /// Passes on the outputs of what happened at `t`.
    fn pass_on(&mut self, t: MonoTime, outputs: &mut Vec<Output>, out: &mut Vec<TimedOutput>) {
        self.now = t;
        out.extend(outputs.drain(..).map(|output| TimedOutput { t_cause: t, output }));
    }

    fn time_outs(&mut self, t: MonoTime, seq: u64, out: &mut Vec<Output>) {
        self.monitor.advance(t, out);
        for &source in Source::ALL {
            if let Some(line) = self.lines.of(source) {
                line.tick(t, seq, &mut self.readings);
                self.take_readings(source, t, out);
            }
        }
        if let Some(estimators) = &mut self.estimators {
            estimators.joint.tick(t, &mut self.estimated);
            // Also while no frame arrives, targets coast and are lost; a target that is already lost is not reported
            // again.
            if let Some(frame) = self.pace.missing_after(t)
                && self.monitor.is_any_known()
            {
                estimators.joint.coast(t, frame, &mut self.estimated);
                let monitor = &self.monitor;
                self.estimated
                    .retain(|said| !matches!(said, EstimatorOutput::Coasted(e) if monitor.is_lost(e.target)));
            }
        }
        self.take_estimated(t, out);
    }

    /// Outputs the helicopter's own state, with or without frames.
    fn ownship(&mut self, t: MonoTime, out: &mut Vec<Output>) {
        let ownship = self.estimators.as_mut().and_then(|estimators| estimators.joint.ownship(t));
        out.extend(ownship.map(|own| Output::Estimator(EstimatorOutput::Ownship(own))));
    }

    fn event(
        &mut self,
        event: &Event,
        prepared: Option<Result<DecodedFrame, FrameFault>>,
        out: &mut Vec<Output>,
    ) {
        let t = event.t_recv;
        self.monitor.advance(t, out);
        match &event.body {
            EventBody::Bytes { source, data } => self.bytes(*source, data, event, out),
            EventBody::Frame(frame) => {
                let decoded = prepared.unwrap_or_else(|| pixels::decode(frame, self.want_rgb));
                self.frame(frame, decoded, event, out);
            }
            EventBody::Inertial { source, sample } => {
                self.sample(*source, sample, event, Estimator::inertial, out);
            }
            EventBody::Attitude { source, sample } => {
                self.sample(*source, sample, event, Estimator::second_attitude, out);
            }
            EventBody::Dropped { source, count } => self.monitor.dropped(*source, t, *count, out),
            EventBody::Pulse => self.lines.gps.pulse(t),
            EventBody::Warm(state) => self.resume(state),
            EventBody::Tick | EventBody::SourceUp(_) | EventBody::SourceDown(_) => {}
        }
    }

    /// Whether frames are needed in colour.
    pub fn wants_rgb(&self) -> bool {
        self.want_rgb
    }

    /// The recording ends here: outputs that were still held back follow.
    pub fn finish(&mut self, out: &mut Vec<TimedOutput>) {
        let mut outputs = std::mem::take(&mut self.outputs);
        for &source in Source::ALL {
            if let Some(line) = self.lines.of(source) {
                line.finish(&mut self.readings);
                self.take_readings(source, self.now, &mut outputs);
            }
        }
        if let Some(estimators) = &mut self.estimators {
            estimators.joint.finish(&mut self.estimated);
        }
        self.take_estimated(self.now, &mut outputs);
        self.pass_on(self.now, &mut outputs, out);
    }

    /// Continues from what an earlier run of the same flight had estimated: site, clock fit, the sensors' slow errors.
    /// A state of another place or configuration is not used, nor one that is too old.
    fn resume(&mut self, warm: &WarmState) {
        if self.estimators.is_some() {
            return;
        }
        self.lines.gps.resume(&warm.arrivals);
        self.finder.resume(warm.site);
        self.warm = warm.filter.clone().filter(WarmFilter::is_sound);
    }

    fn bytes(&mut self, source: Source, bytes: &[u8], event: &Event, out: &mut Vec<Output>) {
        let t = event.t_recv;
        let Some(line) = self.lines.of(source) else { return };
        line.push(bytes, t, event.seq, &mut self.readings);
        let (refused, why) = lines::refused(line.counts());
        self.monitor.refused(source, t, refused, &why, out);
        self.take_readings(source, t, out);
        // Refused bytes of a line that two sources share are reported once.
        let beside = self.lines.beside(source);
        if let Some((source, line)) = beside.and_then(|source| Some((source, self.lines.of(source)?))) {
            line.push(bytes, t, event.seq, &mut self.readings);
            self.take_readings(source, t, out);
        }
    }

    /// Passes a sample to the filter; the flight has samples as they were received.
    fn sample<T: Sample>(
        &mut self,
        source: Source,
        sample: &T,
        event: &Event,
        fuse: fn(&mut Estimator, &Stamped<T>, &mut Vec<EstimatorOutput>),
        out: &mut Vec<Output>,
    ) {
        let Some(line) = self.lines.samples(source) else { return };
        let stamped = line.stamp(sample, event.t_recv, event.seq);
        let refused = line.refused();
        self.delivered_or_refused(source, event.t_recv, stamped.is_some(), refused, out);
        if let (Some(sample), Some(estimators)) = (stamped, &mut self.estimators) {
            fuse(&mut estimators.joint, &sample, &mut self.estimated);
        }
        self.take_estimated(event.t_recv, out);
    }
}
