//! The estimator as the pipeline sees it: measurements in whatever order they come, estimates out.

use std::collections::VecDeque;

use crate::align::{History, Stamp};
use windhover_base::geo::wrap_angle;
use windhover_base::msg::{
    AttitudeSample, Disposition, EstimatorOutput, FrameObservations, FramePrediction, FusionResult,
    FusionSource, GnssEpoch, InertialSample, Misfit, Ownship, Stamped, WarmFilter,
};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::{MonoTime, Span};

use super::Site;
use super::core::Core;
use super::inertial::Blocks;
use super::shake::Shake;
use super::sources::{AnyMeasurement, Kind};
use super::start::start;
use super::state::State;

/// The joint filter with its history of measurements.
#[derive(Clone, Debug)]
pub struct Estimator {
    pub(crate) core: Core,
    history: History<AnyMeasurement, State>,
    /// Compass readings that came before there was a state.
    compass: VecDeque<Stamped<AttitudeSample>>,
    /// Whether there are gyros and accelerometers, a second source of attitude; samples since the last block.
    has_imu: bool,
    has_second: bool,
    blocks: Blocks,
    /// Room to look ahead in.
    pub(crate) ahead: State,
    /// The state as it was last reported between frames.
    carried: State,
    /// Time of the state in the history from which it was carried on; `None` where a measurement came since.
    carried_from: Option<MonoTime>,
    lag: Span,
    /// What the next start continues from.
    warm: Option<WarmFilter>,
    /// Exposure time of the last frame whose smoothed estimate is out.
    smoothed_to: Option<MonoTime>,
    /// Time of the last anchoring that was reported.
    anchored: Option<MonoTime>,
    /// Time of the last decision about the tilt sensor that was reported.
    decided: Option<MonoTime>,
    /// When it was last looked at whether sources fit.
    looked: Option<MonoTime>,
}

/// Without any measurement for so long the state is given up.
const SILENCE: Span = Span::from_ns(60_000_000_000);
/// A source that does not fit is reported so often.
const MISFIT_INTERVAL: Span = Span::from_ns(1_000_000_000);
/// Farther ahead than this a frame is not foreseen, s.
const FORESIGHT_S: f64 = 2.0;
/// Without any measurement for longer the helicopter's own state is not reported, s.
const GUESS_S: f64 = 10.0;
/// Compass readings this old still start the filter, if there are enough of them.
const COMPASS_AGE: Span = Span::from_ns(3_000_000_000);
/// Readings kept to start from, and the fewest that outvote a wrong one.
const READINGS: usize = 15;
const FEWEST_READINGS: usize = 3;
/// Most measurements in the history: three devices at 100 Hz over ten seconds.
const CAPACITY: usize = 3_000;
/// Means beyond these are no flight: metres from the datum, metres a second.
const ABSURD: (f64, f64) = (1e6, 500.0);

impl Estimator {
    /// An estimator that knows nothing yet.
    pub fn new(rig: &Rig, estimator: &EstimatorConfig, site: &Site) -> Self {
        let core = Core::new(rig, estimator, site);
        let span = Span::from_ms(estimator.history_ms);
        Self {
            has_imu: rig.imu.is_some(),
            has_second: rig.attitude.is_some(),
            blocks: Blocks::default(),
            ahead: State::default(),
            carried: State::default(),
            carried_from: None,
            history: History::new(span, CAPACITY, core.state.clone(), MonoTime::default()),
            core,
            compass: VecDeque::with_capacity(READINGS + 1),
            lag: Span::from_ms(estimator.smoother_lag_ms),
            warm: None,
            smoothed_to: None,
            anchored: None,
            decided: None,
            looked: None,
        }
    }

    /// Continues, at the first start, from the sensors' errors as an earlier run had learnt them.
    pub fn resume(&mut self, warm: WarmFilter) {
        self.warm = Some(warm);
    }

    /// What [`Self::resume`] takes; `None` while nothing is known.
    pub fn warm_state(&self) -> Option<WarmFilter> {
        self.core.state.alive.then(|| self.core.state.warm())
    }

    /// Whether the helicopter's own state is known.
    pub fn is_started(&self) -> bool {
        self.core.state.alive
    }

    /// Takes a GPS epoch; `t_valid` has the configured latency taken off.
    pub fn gnss(&mut self, epoch: &Stamped<GnssEpoch>, out: &mut Vec<EstimatorOutput>) {
        if !self.core.state.alive && !self.start(epoch, out) {
            self.refused(FusionSource::GpsPosition, epoch.t_valid, Disposition::NoOwnship, out);
            return;
        }
        let value = epoch.value;
        self.take(stamp_of(epoch), FusionSource::GpsPosition, out, |m| {
            m.kind = Kind::Gnss;
            m.gnss = value;
        });
        self.emit_smoothed(out);
    }

    /// Takes a compass reading; `t_valid` has the configured latency taken off.
    pub fn attitude(&mut self, sample: &Stamped<AttitudeSample>, out: &mut Vec<EstimatorOutput>) {
        if !self.core.state.alive {
            if sample.value.heading.is_some() {
                self.compass.push_back(*sample);
                if self.compass.len() > READINGS {
                    self.compass.pop_front();
                }
            }
            self.refused(FusionSource::CompassHeading, sample.t_valid, Disposition::NoOwnship, out);
            return;
        }
        self.take_attitude(sample, Kind::Attitude, FusionSource::CompassHeading, out);
    }

    /// Takes a reading of the second source of attitude, in body axes. Nothing becomes of it where the rig has no
    /// `[attitude]`.
    pub fn second_attitude(&mut self, sample: &Stamped<AttitudeSample>, out: &mut Vec<EstimatorOutput>) {
        if !self.has_second {
            return;
        }
        if !self.core.state.alive {
            self.refused(FusionSource::AttitudeHeading, sample.t_valid, Disposition::NoOwnship, out);
            return;
        }
        self.take_attitude(sample, Kind::SecondAttitude, FusionSource::AttitudeHeading, out);
    }

    fn take_attitude(
        &mut self,
        sample: &Stamped<AttitudeSample>,
        kind: Kind,
        source: FusionSource,
        out: &mut Vec<EstimatorOutput>,
    ) {
        let value = sample.value;
        self.take(stamp_of(sample), source, out, |m| {
            m.kind = kind;
            m.attitude = value;
        });
        self.emit_smoothed(out);
    }

    /// Takes rates and forces, in sensor axes; they are fused in blocks of a tenth of a second. Nothing becomes of them
    /// where the rig has no `[imu]`, or before the filter has started.
    pub fn inertial(&mut self, sample: &Stamped<InertialSample>, out: &mut Vec<EstimatorOutput>) {
        if !self.has_imu {
            return;
        }
        let block = self.blocks.take(sample, &self.core.models.body_from_imu);
        let Some(block) = block.filter(|_| self.core.state.alive) else { return };
        self.take(stamp_of(&block), FusionSource::ImuRate, out, |m| {
            m.kind = Kind::Inertial;
            m.inertial = block.value;
        });
        self.emit_smoothed(out);
    }

    /// Takes what a frame showed, and gives one estimate a target and the helicopter's own state at
    /// the frame's exposure.
    pub fn frame(&mut self, frame: &Stamped<FrameObservations>, out: &mut Vec<EstimatorOutput>) {
        let (t, number) = (self.exposed(frame.t_valid), frame.value.frame);
        let taken = if self.core.state.alive {
            self.take(Stamp { t_valid: t, ..stamp_of(frame) }, FusionSource::Marker, out, |m| {
                m.kind = Kind::Frame;
                m.frame.frame = number;
                m.frame.markers.clone_from(&frame.value.markers);
                m.frame.features.clone_from(&frame.value.features);
            })
        } else {
            self.refused(FusionSource::Marker, t, Disposition::NoOwnship, out);
            None
        };
        // The state after this frame; where it was not taken, what all else shows of that time, and nothing beyond the
        // newest measurement.
        let (state, t) = match taken {
            Some(index) => (self.history.before(index + 1), t),
            None => {
                let t = t.min(self.core.state.t);
                self.ahead.copy_present(self.history.at(t));
                self.ahead.propagate(t, &self.core.models);
                (&self.ahead, self.ahead.t)
            }
        };
        for target in 0..state.targets.len() {
            out.push(EstimatorOutput::Estimate(state.estimate(&self.core.models, target, number, t)));
        }
        if state.alive {
            out.push(EstimatorOutput::Ownship(state.ownship(&self.core.models, Some(number), t)));
        }
        self.emit_smoothed(out);
    }

    /// When a frame with this stamp was exposed, by what was found out of the camera's clock.
    fn exposed(&self, stamp: MonoTime) -> MonoTime {
        stamp - Span::from_s(self.core.state.camera_late_s)
    }

    /// Lets time pass: gives smoothed estimates that are due, and starts again after a long silence.
    pub fn tick(&mut self, now: MonoTime, out: &mut Vec<EstimatorOutput>) {
        if self.core.state.alive && now - self.core.state.t > SILENCE {
            self.emit_smoothed_until(None, out);
            self.reset("no measurement for a minute", out);
        } else {
            self.emit_smoothed_until(Some(now - self.lag), out);
        }
    }

    /// Gives every smoothed estimate still owed: the flight is over.
    pub fn finish(&mut self, out: &mut Vec<EstimatorOutput>) {
        self.emit_smoothed_until(None, out);
    }

    /// What a frame exposed at `t` should show, into a recycled value.
    pub fn predict(&mut self, t: MonoTime, expected: &mut FramePrediction) {
        expected.clear();
        let t = self.exposed(t);
        let ahead = t - self.core.state.t;
        if self.core.state.alive && ahead.s() <= FORESIGHT_S {
            self.ahead.copy_present(&self.core.state);
            self.ahead.propagate(t, &self.core.models);
            self.ahead.expect(&self.core.models, expected);
        }
    }

    /// The helicopter's own state at `t`, from what was taken so far; `None` where it is not known or nothing was
    /// measured for ten seconds before.
    pub fn ownship(&mut self, t: MonoTime) -> Option<Ownship> {
        let state = self.history.at(t);
        let ahead = t - state.t;
        if !(self.core.state.alive && state.alive && (0.0..=GUESS_S).contains(&ahead.s())) {
            return None;
        }
        // In a silence each goes on from the one before.
        if self.carried_from != Some(state.t) || self.carried.t > t {
            self.carried.copy_present(state);
            self.carried_from = Some(state.t);
        }
        self.carried.propagate(t, &self.core.models);
        Some(self.carried.ownship(&self.core.models, None, t))
    }

    fn start(&mut self, epoch: &Stamped<GnssEpoch>, out: &mut Vec<EstimatorOutput>) -> bool {
        self.compass.retain(|c| (epoch.t_recv - c.t_recv).abs() <= COMPASS_AGE);
        if self.compass.len() < FEWEST_READINGS {
            return false;
        }
        let Some(typical) = most_typical(&self.compass) else { return false };
        let core = &mut self.core;
        core.state.learnt.copy_from(&core.learning.start);
        if !start(&mut core.state, epoch.t_valid, &epoch.value, &typical, &core.models) {
            return false;
        }
        if core.learning.on {
            core.state.shake = Shake::presumed(&core.models);
        }
        if let Some(warm) = self.warm.take() {
            core.state.resume(&warm, &core.models, &core.learning);
        }
        let state = &self.core.state;
        self.carried_from = None;
        self.history.restart(epoch.t_valid, |base| base.copy_from(state));
        for reading in std::mem::take(&mut self.compass) {
            if reading.t_valid >= epoch.t_valid {
                self.attitude(&reading, out);
            }
        }
        true
    }

    /// Puts a measurement in its place and fuses it and everything after it; gives its index.
    fn take(
        &mut self,
        stamp: Stamp,
        source: FusionSource,
        out: &mut Vec<EstimatorOutput>,
        fill: impl FnOnce(&mut AnyMeasurement),
    ) -> Option<usize> {
        if let Err(disposition) = self.history.admit(stamp) {
            self.refused(source, stamp.t_valid, disposition, out);
            return None;
        }
        self.carried_from = None;
        let at = self.history.insert(stamp, fill);
        if at + 1 < self.history.len() {
            self.core.state.copy_from(self.history.before(at));
        }
        for index in at..self.history.len() {
            let entry = self.history.entry_mut(index);
            self.core.reporting = index == at;
            self.core.process(entry.stamp.t_valid, &entry.value);
            entry.after.copy_from(&self.core.state);
        }
        out.extend(self.core.results.drain(..).map(EstimatorOutput::Fusion));
        if let Some((t, moved_m)) = self.core.state.anchored
            && self.anchored.is_none_or(|reported| t > reported)
        {
            self.anchored = Some(t);
            out.push(EstimatorOutput::Anchored { moved_m });
        }
        self.tell_tilt(out);
        self.tell_misfits(out);
        if !self.is_reasonable() {
            self.reset("the state was no longer a number within reason", out);
            return None;
        }
        let before = self.history.len();
        self.history.trim();
        let gone = before - self.history.len();
        // A measurement true just within the history may be trimmed at once; its state is the base then.
        (at >= gone).then(|| at - gone)
    }

    /// Tells once what the tilt sensor was found to feel.
    fn tell_tilt(&mut self, out: &mut Vec<EstimatorOutput>) {
        let tilt = &self.core.state.tilt[0];
        let (Some(t), Some(felt)) = (tilt.decided, tilt.found()) else { return };
        if self.decided.is_none_or(|reported| t > reported) {
            self.decided = Some(t);
            out.push(EstimatorOutput::TiltFelt { felt, slope: tilt.slope() });
        }
    }

    /// Tells which sources do not fit what is said of them, each once a second.
    fn tell_misfits(&mut self, out: &mut Vec<EstimatorOutput>) {
        let t = self.core.state.t;
        if self.looked.is_some_and(|looked| t - looked < MISFIT_INTERVAL) {
            return;
        }
        self.looked = Some(t);
        let misfits = self.core.misfits().chain(self.core.vehicle_misfits());
        out.extend(
            misfits
                .map(|(source, cause, figure)| EstimatorOutput::Misfit(Misfit { t, source, figure, cause })),
        );
    }

    fn is_reasonable(&self) -> bool {
        let (state, own) = (&self.core.state, &self.core.state.own);
        state.is_sound() && own.position.norm() < ABSURD.0 && own.velocity.norm() < ABSURD.1
    }

    fn reset(&mut self, reason: &'static str, out: &mut Vec<EstimatorOutput>) {
        let core = &mut self.core;
        core.state.alive = false;
        core.state.own = Default::default();
        core.state.clear();
        self.compass.clear();
        let t = core.state.t;
        self.history.restart(t, |_| {});
        out.push(EstimatorOutput::Reset { reason });
    }

    fn emit_smoothed(&mut self, out: &mut Vec<EstimatorOutput>) {
        self.emit_smoothed_until(Some(self.core.state.t - self.lag), out);
    }

    /// Gives the smoothed estimates of frames exposed no later than `until` (all of them for `None`)
    /// that are not out yet, in their order.
    fn emit_smoothed_until(&mut self, until: Option<MonoTime>, out: &mut Vec<EstimatorOutput>) {
        loop {
            let last = self.smoothed_to;
            let due = |t: MonoTime| until.is_none_or(|u| t <= u) && last.is_none_or(|s| t > s);
            let copies = self.core.state.copies.iter().filter(|copy| copy.in_use && due(copy.t));
            let Some(copy) = copies.min_by_key(|copy| copy.t) else { return };
            for target in 0..self.core.state.targets.len() {
                out.push(EstimatorOutput::Smoothed(copy.estimate(&self.core.models, target)));
            }
            self.smoothed_to = Some(copy.t);
        }
    }

    fn refused(
        &self,
        source: FusionSource,
        t_valid: MonoTime,
        disposition: Disposition,
        out: &mut Vec<EstimatorOutput>,
    ) {
        out.push(EstimatorOutput::Fusion(FusionResult {
            t_valid,
            source,
            disposition,
            innovation: [0.0; 3],
            dimension: 0,
            test_ratio: f64::NAN,
        }));
    }
}

/// The reading that differs least from all others in sum: a wrong one among them does not win.
fn most_typical(readings: &VecDeque<Stamped<AttitudeSample>>) -> Option<AttitudeSample> {
    let apart = |a: &AttitudeSample, b: &AttitudeSample| {
        let heading = a.heading.zip(b.heading).map_or(0.0, |(a, b)| wrap_angle(a - b).abs());
        let tilt = |a: &windhover_base::geo::Tilt, b: &windhover_base::geo::Tilt| {
            wrap_angle(a.pitch - b.pitch).abs() + wrap_angle(a.roll - b.roll).abs()
        };
        heading + a.tilt.zip(b.tilt).map_or(0.0, |(a, b)| tilt(&a, &b))
    };
    let in_sum = |a: &AttitudeSample| readings.iter().map(|b| apart(a, &b.value)).sum::<f64>();
    let best = readings.iter().min_by(|a, b| in_sum(&a.value).total_cmp(&in_sum(&b.value)));
    best.map(|reading| reading.value)
}

fn stamp_of<T>(stamped: &Stamped<T>) -> Stamp {
    Stamp { t_valid: stamped.t_valid, t_recv: stamped.t_recv, seq: stamped.seq }
}
