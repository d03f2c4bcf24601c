//! The single path from events to outputs, live and in replay.
//!
//! [`Pipeline::handle`] takes received events in the order of their reception and appends the outputs that follow. It
//! reads no clock: time comes from the events, and so do the ticks at which time-outs are checked. A replay of the same
//! events therefore gives the same outputs to the last bit.

mod frame_pace;
mod lines;
mod misfit_words;
mod misfits;
mod monitor;
mod seen;
mod settings;
mod site;
mod ticks;

pub use settings::PipelineSettings;
pub use site::site_of;

use std::sync::Arc;

use nalgebra::Vector2;

use crate::pixels::{self, DecodedFrame, FrameFault};
use frame_pace::FramePace;
use lines::{Sample, SourceLines};
use misfit_words::felt_words;
use monitor::{Monitor, notice};
use seen::SeenMarkers;
use site::SiteFinder;
use ticks::{Due, Schedule};
use windhover_base::geo::{Geodetic, Tile};
use windhover_base::msg::{
    AttitudeSample, EstimatorOutput, Event, EventBody, FrameObservations, FramePayload, FramePrediction,
    GnssEpoch, NoticeKind, Output, SensorReading, Source, Stamped, TargetEstimate, TimedOutput, TrackStatus,
    WarmFilter, WarmSite, WarmState,
};
use windhover_base::settings::{MarkerKind, TargetConfig};
use windhover_base::time::{FrameClock, MonoTime, Span};
use windhover_detect::tracking::FrameDetector;
use windhover_estimate::{Estimator, PaperEstimator};

/// What is seen nearer than this to a lost part of a frame is not used: the size of the neighbourhood by which a
/// feature is recognised.
const LOST_MARGIN_PX: f64 = 12.0;

/// Most readings held until the datum is settled: some seconds of both lines.
const HELD_MAX: usize = 512;

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
            want_rgb: wants_rgb(&rig.target),
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
        let told = self.estimators.as_mut().and_then(|estimators| estimators.joint.ownship(t));
        out.extend(told.map(|own| Output::Estimator(EstimatorOutput::Ownship(own))));
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
        self.heard_or_refused(source, event.t_recv, stamped.is_some(), refused, out);
        if let (Some(sample), Some(estimators)) = (stamped, &mut self.estimators) {
            fuse(&mut estimators.joint, &sample, &mut self.estimated);
        }
        self.take_estimated(event.t_recv, out);
    }

    fn heard_or_refused(
        &mut self,
        source: Source,
        t: MonoTime,
        heard: bool,
        refused: u64,
        out: &mut Vec<Output>,
    ) {
        match heard {
            true => self.monitor.heard(source, t, out),
            false => self.monitor.refused(source, t, refused, "values that cannot be", out),
        }
    }

    fn take_readings(&mut self, source: Source, t: MonoTime, out: &mut Vec<Output>) {
        for reading in std::mem::take(&mut self.readings) {
            self.monitor.heard(source, t, out);
            match reading {
                SensorReading::Gnss(epoch) => self.gnss(&epoch, t, out),
                SensorReading::Attitude(sample) => self.attitude(&sample, out),
                SensorReading::SecondAttitude(sample) => {
                    self.tell_joint(|joint, out| joint.second_attitude(&sample, out));
                }
                SensorReading::Inertial(sample) => {
                    self.tell_joint(|joint, out| joint.inertial(&sample, out));
                }
                SensorReading::Autopilot(_) => out.push(Output::Reading(reading)),
            }
        }
        self.take_estimated(t, out);
    }

    fn gnss(&mut self, epoch: &Stamped<GnssEpoch>, t: MonoTime, out: &mut Vec<Output>) {
        self.monitor.fix(t, epoch, self.lines.gps.clock_sigma(), out);
        self.monitor.pulses(t, self.lines.gps.pulse_trouble(), out);
        out.push(Output::Reading(SensorReading::Gnss(*epoch)));
        let agreed = self.finder.agreeing();
        self.settle(&epoch.value, t, out);
        if self.estimators.is_none() {
            self.hold_fix(epoch, agreed);
        }
        if let Some(estimators) = &mut self.estimators {
            estimators.joint.gnss(epoch, &mut self.estimated);
            estimators.paper.gnss(epoch, &mut self.papered);
        }
    }

    fn attitude(&mut self, sample: &Stamped<AttitudeSample>, out: &mut Vec<Output>) {
        out.push(Output::Reading(SensorReading::Attitude(*sample)));
        if let Some(estimators) = &mut self.estimators {
            estimators.joint.attitude(sample, &mut self.estimated);
            estimators.paper.attitude(sample, &mut self.papered);
        } else if !self.held.is_empty() && self.held.len() < HELD_MAX {
            self.held.push(SensorReading::Attitude(*sample));
        }
    }

    fn tell_joint(&mut self, take: impl FnOnce(&mut Estimator, &mut Vec<EstimatorOutput>)) {
        if let Some(estimators) = &mut self.estimators {
            take(&mut estimators.joint, &mut self.estimated);
        }
    }

    /// Holds a fix that agrees with `agreed` fixes before it; a fix that does not agree starts the count again.
    fn hold_fix(&mut self, epoch: &Stamped<GnssEpoch>, agreed: usize) {
        let agreeing = self.finder.agreeing();
        if agreeing == 1 {
            self.held.clear();
        }
        if (agreeing == 1 || agreeing > agreed) && self.held.len() < HELD_MAX {
            self.held.push(SensorReading::Gnss(*epoch));
        }
    }

    fn settle(&mut self, epoch: &GnssEpoch, t: MonoTime, out: &mut Vec<Output>) {
        let settled = match &self.estimators {
            None => self.finder.offer(epoch),
            Some(estimators) => {
                let [lat_deg, lon_deg, height_m] = estimators.site.datum;
                let datum = Geodetic { lat_deg, lon_deg, height_m };
                self.finder.offer_again(epoch, datum, self.monitor.has_tracked())
            }
        };
        if let Some(why) = self.finder.unused_word() {
            let words = format!("the receiver's positions are not used: {why}");
            out.push(notice(t, NoticeKind::PositionsUnused, Some(Source::Gps), words));
        }
        let Some(settled) = settled else { return };
        if let Some(words) = settled.declination_notice {
            out.push(notice(t, NoticeKind::Declination, Some(Source::Compass), words));
        }
        if let Some(words) = settled.ground_notice {
            out.push(notice(t, NoticeKind::TerrainMissing, None, words));
        }
        let datum: Geodetic = settled.site.frame.datum();
        let words = format!(
            "datum {:.7} {:.7}, {:.1} m above the ellipsoid",
            datum.lat_deg, datum.lon_deg, datum.height_m
        );
        out.push(notice(t, NoticeKind::DatumSet, Some(Source::Gps), words));
        out.push(Output::Datum(t, datum));
        let (rig, filter) = (&self.settings.rig, &self.settings.filter);
        let mut joint = Estimator::new(rig, filter, &settled.site);
        if let Some(warm) = self.warm.take().filter(|_| settled.continued) {
            joint.resume(warm);
        }
        let mut paper = PaperEstimator::new(rig, filter, &settled.site);
        for reading in self.held.drain(..) {
            match reading {
                SensorReading::Gnss(epoch) => {
                    joint.gnss(&epoch, &mut self.estimated);
                    paper.gnss(&epoch, &mut self.papered);
                }
                SensorReading::Attitude(sample) => {
                    joint.attitude(&sample, &mut self.estimated);
                    paper.attitude(&sample, &mut self.papered);
                }
                _ => {}
            }
        }
        self.estimators = Some(Estimators { joint, paper, site: settled.warm });
    }

    fn frame(
        &mut self,
        payload: &FramePayload,
        decoded: Result<DecodedFrame, FrameFault>,
        event: &Event,
        out: &mut Vec<Output>,
    ) {
        let t = event.t_recv;
        self.pace.frame(t, payload.index);
        let offset = Span::from_ms(self.settings.rig.camera.exposure_offset_ms);
        let t_valid = self.exposures.exposed(payload.t_exposure, t) + offset;
        if self.last_exposure.is_some_and(|last| payload.t_exposure <= last) {
            let words = format!("frame {} is stamped no later than the one before", payload.index);
            out.push(notice(t, NoticeKind::ClockJump, Some(Source::Camera), words));
        }
        self.last_exposure = Some(payload.t_exposure);
        self.observations.frame = payload.index;
        self.observations.markers.clear();
        self.observations.features.clear();
        let (width, height) = (self.settings.rig.camera.width, self.settings.rig.camera.height);
        match decoded.and_then(|d| pixels::check_size(&d, width, height).map(|()| d)) {
            Ok(decoded) => {
                self.monitor.heard(Source::Camera, t, out);
                let prediction = self.estimators.as_mut().map(|e| {
                    e.joint.predict(t_valid, &mut self.prediction);
                    &self.prediction
                });
                let rgb = decoded.rgb.as_ref();
                self.detector.process(decoded.gray.view(), rgb, prediction, &mut self.observations);
                if !decoded.missing.is_empty() {
                    self.keep_whole(&decoded);
                    let lost = decoded.missing.len();
                    let words =
                        format!("frame {}: {lost} parts of it are lost, the rest is used", payload.index);
                    out.push(notice(t, NoticeKind::FrameDamaged, Some(Source::Camera), words));
                }
                self.note_seen(t, out);
                out.push(Output::Detections {
                    frame: payload.index,
                    t_valid,
                    markers: self.observations.markers.clone(),
                    features: self.observations.features.clone(),
                });
            }
            Err(fault) => {
                let words = format!("frame {} cannot be used: {fault}", payload.index);
                self.monitor.frame_unusable(t, words, out);
            }
        }
        self.estimate(t_valid, event, out);
    }

    /// Removes what was seen where parts of the frame are lost.
    fn keep_whole(&mut self, frame: &DecodedFrame) {
        self.observations
            .features
            .retain(|f| frame.is_whole((f.px.x, f.px.y), (f.px.x, f.px.y), LOST_MARGIN_PX));
        self.observations.markers.retain(|marker| {
            let radius = 0.5 * marker.size_px;
            let center = marker.center_px;
            let around = [(-radius, -radius), (radius, radius)].map(|(u, v)| center + Vector2::new(u, v));
            let corners = marker.corners_px.unwrap_or([around[0], around[0], around[1], around[1]]);
            let from = corners.iter().fold(center, |low, c| low.inf(c));
            let to = corners.iter().fold(center, |high, c| high.sup(c));
            frame.is_whole((from.x, from.y), (to.x, to.y), LOST_MARGIN_PX)
        });
    }

    fn note_seen(&mut self, t: MonoTime, out: &mut Vec<Output>) {
        for target in 0..self.settings.rig.target.len() {
            if self.observations.markers.iter().any(|seen| self.seen.target_of(seen) == Some(target)) {
                self.monitor.seen(target);
            }
        }
        for words in self.seen.twice(&self.observations, t) {
            out.push(notice(t, NoticeKind::MarkerSeenTwice, Some(Source::Camera), words));
        }
    }

    /// One estimate for each frame and target, whatever was seen.
    fn estimate(&mut self, t_valid: MonoTime, event: &Event, out: &mut Vec<Output>) {
        let Some(estimators) = &mut self.estimators else {
            for target in 0..self.settings.rig.target.len() {
                let frame = self.observations.frame;
                let status = TrackStatus::Lost;
                let lost = TargetEstimate { t_valid, frame, target, status, state: None };
                out.push(Output::Estimator(EstimatorOutput::Estimate(lost)));
            }
            return;
        };
        let observations = std::mem::take(&mut self.observations);
        let stamped = Stamped { t_valid, t_recv: event.t_recv, seq: event.seq, value: observations };
        estimators.joint.frame(&stamped, &mut self.estimated);
        estimators.paper.frame(&stamped, &mut self.papered);
        out.extend(self.papered.drain(..).map(Output::Paper));
        self.observations = stamped.value;
        self.take_estimated(event.t_recv, out);
    }

    fn take_estimated(&mut self, t: MonoTime, out: &mut Vec<Output>) {
        for estimated in self.estimated.drain(..) {
            match &estimated {
                EstimatorOutput::Estimate(estimate) | EstimatorOutput::Coasted(estimate) => {
                    self.monitor.estimate(estimate, t, out);
                }
                EstimatorOutput::Fusion(result) => self.monitor.disposition(result.disposition),
                EstimatorOutput::Anchored { moved_m: d } => {
                    let detail = format!(
                        "the receiver jumped for good: everything moved by {:.1} m north, {:.1} m east, {:.1} m down",
                        d.x, d.y, d.z
                    );
                    out.push(notice(t, NoticeKind::FilterReset, None, detail));
                }
                EstimatorOutput::Reset { reason } => {
                    out.push(notice(t, NoticeKind::FilterReset, None, (*reason).to_owned()));
                }
                EstimatorOutput::TiltFelt { felt, slope } => {
                    let detail =
                        format!("the compass's tilt sensor {} (slope {slope:.2})", felt_words(*felt));
                    out.push(notice(t, NoticeKind::TiltFelt, Some(Source::Compass), detail));
                }
                EstimatorOutput::Misfit(misfit) => self.monitor.misfit(misfit, t, out),
                EstimatorOutput::Smoothed(_) | EstimatorOutput::Ownship(_) => {}
            }
            out.push(Output::Estimator(estimated));
        }
    }
}

/// Colours are needed only where a disc is identified by its colour.
fn wants_rgb(targets: &[TargetConfig]) -> bool {
    let mut markers = targets.iter().flat_map(|t| &t.marker);
    markers.any(|m| m.kind == MarkerKind::Disc && m.color.is_some())
}
