//! The one path from events to outputs, live and in replay.
//!
//! [`Pipeline::handle`] takes what was heard, in the order it was heard, and appends what follows
//! from it. It reads no clock: time is what the events say, so a replay of the same events gives the
//! same outputs to the last bit.

mod lines;
mod monitor;
mod site;
mod ticks;

pub use ticks::{TICK, Ticks};

use std::sync::Arc;

use crate::config::Config;
use crate::pixels::{self, DecodedFrame, FrameFault};
use lines::{CompassLine, GpsLine};
use monitor::{Monitor, notice};
use site::SiteFinder;
use windhover_base::geo::{Geodetic, Tile};
use windhover_base::msg::{
    AttitudeSample, Event, EventBody, FrameObservations, FramePayload, FramePrediction, GnssEpoch,
    MarkerDetection, MarkerId, NoticeKind, Output, Source, Stamped, TargetEstimate, TrackStatus, WarmFilter,
    WarmSite, WarmState,
};
use windhover_base::settings::MarkerKind;
use windhover_base::time::{MonoTime, Span};
use windhover_detect::tracking::FrameDetector;
use windhover_estimate::{Estimator, EstimatorOutput, PaperEstimator};

/// Events in, outputs out.
pub struct Pipeline {
    config: Config,
    want_rgb: bool,
    gps: GpsLine,
    compass: CompassLine,
    detector: FrameDetector,
    observations: FrameObservations,
    prediction: FramePrediction,
    finder: SiteFinder,
    estimators: Option<Estimators>,
    /// An earlier run's filter, until there is one to continue it.
    warm: Option<WarmFilter>,
    monitor: Monitor,
    last_exposure: Option<MonoTime>,
    epochs: Vec<Stamped<GnssEpoch>>,
    samples: Vec<Stamped<AttitudeSample>>,
    estimated: Vec<EstimatorOutput>,
    papered: Vec<TargetEstimate>,
}

/// What needs to know where the flight is.
struct Estimators {
    joint: Estimator,
    paper: PaperEstimator,
    site: WarmSite,
}

impl Pipeline {
    /// A pipeline with this configuration, before its first event.
    pub fn new(config: &Config) -> Self {
        Self::with_terrain(config, None)
    }

    /// The same over the terrain tile that `ground.terrain` of the configuration names.
    pub fn with_terrain(config: &Config, terrain: Option<Arc<Tile>>) -> Self {
        Self {
            config: config.clone(),
            want_rgb: wants_rgb(config),
            gps: GpsLine::new(config),
            compass: CompassLine::new(config),
            detector: FrameDetector::new(&config.detector, &config.target, &config.camera.intrinsics),
            observations: FrameObservations::default(),
            prediction: FramePrediction::default(),
            finder: SiteFinder::new(terrain),
            estimators: None,
            warm: None,
            monitor: Monitor::new(config),
            last_exposure: None,
            epochs: Vec::new(),
            samples: Vec::new(),
            estimated: Vec::new(),
            papered: Vec::new(),
        }
    }

    /// What a restarted program should continue from; `None` while the site is not settled.
    pub fn warm_state(&self) -> Option<WarmState> {
        let estimators = self.estimators.as_ref()?;
        Some(WarmState {
            site: estimators.site,
            arrivals: self.gps.arrivals(),
            filter: estimators.joint.warm_state(),
        })
    }

    /// Takes an event; appends what follows from it.
    pub fn handle(&mut self, event: &Event, out: &mut Vec<Output>) {
        self.handle_prepared(event, None, out);
    }

    /// As [`Self::handle`], with the event's frame already decoded elsewhere.
    pub fn handle_prepared(
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
            EventBody::Dropped { source, count } => self.monitor.dropped(*source, t, *count, out),
            EventBody::Tick => {
                self.gps.tick(t, event.seq, &mut self.epochs);
                self.take_epochs(t, out);
                if let Some(estimators) = &mut self.estimators {
                    estimators.joint.tick(t, &mut self.estimated);
                }
                self.take_estimated(t, out);
            }
            EventBody::Pulse => self.gps.pulse(t),
            EventBody::Warm(state) => self.resume(state),
            EventBody::SourceUp(_) | EventBody::SourceDown(_) => {}
        }
    }

    /// Whether frames are wanted with their colours.
    pub fn wants_rgb(&self) -> bool {
        self.want_rgb
    }

    /// The recording ends here: what was still held back follows.
    pub fn finish(&mut self, out: &mut Vec<Output>) {
        self.gps.finish(&mut self.epochs);
        let t = self.epochs.last().map_or(self.last_exposure.unwrap_or_default(), |e| e.t_recv);
        self.take_epochs(t, out);
        if let Some(estimators) = &mut self.estimators {
            estimators.joint.finish(&mut self.estimated);
        }
        self.take_estimated(t, out);
    }

    /// Continues from what an earlier run of the same flight had learnt: site, clock fit, sensors' slow
    /// errors. A state of another place or configuration is not used, nor one that comes too late.
    fn resume(&mut self, warm: &WarmState) {
        if self.estimators.is_some() {
            return;
        }
        self.gps.resume(&warm.arrivals);
        self.finder.resume(warm.site);
        self.warm = warm.filter.clone().filter(WarmFilter::is_sound);
    }

    fn bytes(&mut self, source: Source, bytes: &[u8], event: &Event, out: &mut Vec<Output>) {
        match source {
            Source::Gps => self.gnss_bytes(bytes, event, out),
            Source::Compass => self.compass_bytes(bytes, event, out),
            Source::Camera => {}
        }
    }

    fn gnss_bytes(&mut self, bytes: &[u8], event: &Event, out: &mut Vec<Output>) {
        self.gps.push(bytes, event.t_recv, event.seq, &mut self.epochs);
        let (refused, why) = self.gps.refused();
        self.monitor.refused(Source::Gps, event.t_recv, refused, &why, out);
        self.take_epochs(event.t_recv, out);
    }

    fn take_epochs(&mut self, t: MonoTime, out: &mut Vec<Output>) {
        for epoch in std::mem::take(&mut self.epochs) {
            self.monitor.heard(Source::Gps, t, out);
            self.monitor.fix(t, epoch.value.fix, epoch.value.sats, self.gps.clock_sigma(), out);
            out.push(Output::Fix(epoch));
            if self.estimators.is_none() {
                self.settle(&epoch.value, t, out);
            }
            if let Some(estimators) = &mut self.estimators {
                estimators.joint.gnss(&epoch, &mut self.estimated);
                estimators.paper.gnss(&epoch, &mut self.papered);
            }
        }
        self.take_estimated(t, out);
    }

    fn settle(&mut self, epoch: &GnssEpoch, t: MonoTime, out: &mut Vec<Output>) {
        let Some(settled) = self.finder.offer(epoch, &self.config) else { return };
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
        let (rig, filter) = (self.config.rig(), self.config.filter());
        let mut joint = Estimator::new(&rig, &filter, &settled.site);
        if let Some(warm) = self.warm.take().filter(|_| settled.continued) {
            joint.resume(warm);
        }
        let paper = PaperEstimator::new(&rig, &filter, &settled.site);
        self.estimators = Some(Estimators { joint, paper, site: settled.warm });
    }

    fn compass_bytes(&mut self, bytes: &[u8], event: &Event, out: &mut Vec<Output>) {
        self.compass.push(bytes, event.t_recv, event.seq, &mut self.samples);
        let (refused, why) = self.compass.refused();
        self.monitor.refused(Source::Compass, event.t_recv, refused, &why, out);
        for sample in std::mem::take(&mut self.samples) {
            self.monitor.heard(Source::Compass, event.t_recv, out);
            out.push(Output::Attitude(sample));
            if let Some(estimators) = &mut self.estimators {
                estimators.joint.attitude(&sample, &mut self.estimated);
                estimators.paper.attitude(&sample, &mut self.papered);
            }
        }
        self.take_estimated(event.t_recv, out);
    }

    fn frame(
        &mut self,
        payload: &FramePayload,
        decoded: Result<DecodedFrame, FrameFault>,
        event: &Event,
        out: &mut Vec<Output>,
    ) {
        let t = event.t_recv;
        let t_valid = payload.t_exposure + Span::from_ms(self.config.camera.exposure_offset_ms);
        if self.last_exposure.is_some_and(|last| payload.t_exposure <= last) {
            let words = format!("frame {} is stamped no later than the one before", payload.index);
            out.push(notice(t, NoticeKind::ClockJump, Some(Source::Camera), words));
        }
        self.last_exposure = Some(payload.t_exposure);
        self.observations.frame = payload.index;
        self.observations.markers.clear();
        self.observations.features.clear();
        let (width, height) = (self.config.camera.width, self.config.camera.height);
        match decoded.and_then(|d| pixels::check_size(&d, width, height).map(|()| d)) {
            Ok(decoded) => {
                self.monitor.heard(Source::Camera, t, out);
                let prediction = self.estimators.as_mut().map(|e| {
                    e.joint.predict(t_valid, &mut self.prediction);
                    &self.prediction
                });
                let rgb = decoded.rgb.as_ref();
                self.detector.process(decoded.gray.view(), rgb, prediction, &mut self.observations);
                self.note_seen();
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

    fn note_seen(&mut self) {
        for (index, target) in self.config.target.iter().enumerate() {
            let of_target = |seen: &MarkerDetection| match seen.marker {
                MarkerId::Disc { target, .. } => target == index,
                MarkerId::Tag { family, id } => {
                    target.marker.iter().any(|m| m.family == Some(family) && m.id == Some(id))
                }
            };
            if self.observations.markers.iter().any(of_target) {
                self.monitor.seen(index);
            }
        }
    }

    /// One estimate a frame and target, whatever was seen.
    fn estimate(&mut self, t_valid: MonoTime, event: &Event, out: &mut Vec<Output>) {
        let Some(estimators) = &mut self.estimators else {
            for target in 0..self.config.target.len() {
                let frame = self.observations.frame;
                let status = TrackStatus::Lost;
                out.push(Output::Estimate(TargetEstimate { t_valid, frame, target, status, state: None }));
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
            match estimated {
                EstimatorOutput::Estimate(estimate) => {
                    self.monitor.estimate(&estimate, t, out);
                    out.push(Output::Estimate(estimate));
                }
                EstimatorOutput::Smoothed(estimate) => out.push(Output::Smoothed(estimate)),
                EstimatorOutput::Ownship(own) => out.push(Output::Ownship(own)),
                EstimatorOutput::Fusion(result) => {
                    self.monitor.disposition(result.disposition);
                    out.push(Output::Fusion(result));
                }
                EstimatorOutput::Anchored { moved_m: d } => {
                    let detail = format!(
                        "the receiver jumped for good: everything moved by {:.1} m north, {:.1} m east, {:.1} m down",
                        d.x, d.y, d.z
                    );
                    out.push(notice(t, NoticeKind::FilterReset, None, detail));
                }
                EstimatorOutput::Reset { reason } => {
                    out.push(notice(t, NoticeKind::FilterReset, None, reason.to_string()));
                }
            }
        }
    }
}

/// Colours matter only where a disc is told by its colour.
fn wants_rgb(config: &Config) -> bool {
    let mut markers = config.target.iter().flat_map(|t| &t.marker);
    markers.any(|m| m.kind == MarkerKind::Disc && m.color.is_some())
}
