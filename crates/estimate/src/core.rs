//! The filter proper: one state, one measurement after another in order of validity.

use windhover_base::msg::{
    AttitudeSample, Disposition, FrameObservations, FusionResult, FusionSource, GnssEpoch,
};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::{MonoTime, Span};

use super::Site;
use super::learn::{Learning, Learnt};
use super::models::Models;
use super::state::State;
use super::update::{Measurement, Outcome, Workspace};

/// Interval over which increments are looked at to learn intensities: long enough that they stand
/// out of the noise, short enough to be what the filter's memory sees.
const LEARN_INTERVAL_MS: f64 = 400.0;

/// A measurement of any source, in a form that is recycled.
#[derive(Clone, Debug)]
pub(super) struct AnyMeasurement {
    pub(super) kind: Kind,
    pub(super) gnss: GnssEpoch,
    pub(super) attitude: AttitudeSample,
    pub(super) frame: FrameObservations,
}

impl Default for AnyMeasurement {
    /// With room for a frame, whatever it is first used for.
    fn default() -> Self {
        let frame = FrameObservations {
            frame: 0,
            markers: Vec::with_capacity(ROOM),
            features: Vec::with_capacity(ROOM),
        };
        Self { kind: Kind::Nothing, gnss: GnssEpoch::default(), attitude: AttitudeSample::default(), frame }
    }
}

/// Markers or features of a frame that fit without allocating.
const ROOM: usize = 16;

/// Which part of an [`AnyMeasurement`] counts.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(super) enum Kind {
    #[default]
    Nothing,
    Gnss,
    Attitude,
    Frame,
}

/// State, models and room for arithmetic.
#[derive(Clone, Debug)]
pub(super) struct Core {
    pub(super) models: Models,
    pub(super) learning: Learning,
    pub(super) lost_after: Span,
    pub(super) restart_after: u32,
    /// How long delayed copies are kept.
    pub(super) keep_copies: Span,
    pub(super) state: State,
    pub(super) work: Workspace,
    pub(super) z: Measurement,
    /// What became of measurements; filled only while `reporting`.
    pub(super) results: Vec<FusionResult>,
    pub(super) reporting: bool,
    /// For the bound: the mean is the truth, so innovations are taken as zero and nothing is gated.
    pub(super) at_truth: bool,
}

impl Core {
    pub(super) fn new(rig: &Rig, estimator: &EstimatorConfig, site: &Site) -> Self {
        let models = Models::new(rig, estimator, site);
        let e = estimator;
        let start = Learnt {
            target_q: vec![models.target_walks; rig.target.len()],
            tilt_rate_q: e.tilt_rate_walk.powi(2),
            yaw_rate_q: e.yaw_rate_walk.powi(2),
            side_force_var: e.side_force_mps2.powi(2),
            thrust_var: e.thrust_mps2.powi(2),
            tilt_var: rig.compass.tilt_noise_deg.to_radians().powi(2),
            heading_var: rig.compass.heading_noise_deg.to_radians().powi(2),
            marker_factor: vec![1.0; rig.target.len()],
            feature_factor: 1.0,
            gps_factor: 1.0,
            gps_velocity_factor: 1.0,
            t_target: MonoTime::default(),
        };
        let lag_frames = (e.smoother_lag_ms * 1e-3 * rig.camera.fps).ceil() as usize;
        let state =
            State::new(rig.target.len(), e.features, (lag_frames * 3 / 2 + 6).min(MAX_ECHOES), start.clone());
        Self {
            work: Workspace::new(state.len()),
            z: Measurement::default(),
            models,
            learning: Learning {
                on: e.learn,
                over_s: e.learn_s,
                interval: Span::from_ms(LEARN_INTERVAL_MS),
                start,
            },
            lost_after: Span::from_s(e.lost_after_s),
            restart_after: e.rejections_to_restart,
            keep_copies: Span::from_ms(e.smoother_lag_ms.max(LEARN_INTERVAL_MS) + 150.0),
            state,
            results: Vec::with_capacity(64),
            reporting: false,
            at_truth: false,
        }
    }

    /// Carries the state to `t` and fuses what was true then.
    pub(super) fn process(&mut self, t: MonoTime, measurement: &AnyMeasurement) {
        self.state.propagate(t, &self.models);
        match measurement.kind {
            Kind::Nothing => {}
            Kind::Gnss => self.fuse_gnss(&measurement.gnss),
            Kind::Attitude => self.fuse_attitude(&measurement.attitude),
            Kind::Frame => self.fuse_frame(&measurement.frame),
        }
        self.state.learn(&self.models, &self.learning);
    }

    /// Fuses what stands in `self.z` through the gate, and reports it.
    pub(super) fn fuse_gated(&mut self, source: FusionSource) -> Outcome {
        let gate = (!self.at_truth).then_some(self.models.gates[self.z.m]);
        let outcome = self.fuse(gate);
        self.report(source, outcome);
        outcome
    }

    /// Fuses what stands in `self.z`.
    pub(super) fn fuse(&mut self, gate: Option<f64>) -> Outcome {
        if self.at_truth {
            self.z.residual.fill(0.0);
        }
        self.work.fuse(&mut self.state, &self.z, gate)
    }

    fn report(&mut self, source: FusionSource, outcome: Outcome) {
        if !self.reporting {
            return;
        }
        let r = &self.z.residual;
        self.results.push(FusionResult {
            t_valid: self.state.t,
            source,
            disposition: outcome.disposition,
            innovation: [r[0], r[1], r[2]],
            dimension: self.z.m.min(3),
            test_ratio: outcome.ratio,
        });
    }

    /// Reports a measurement that was not even tried.
    pub(super) fn refuse(&mut self, source: FusionSource, disposition: Disposition) {
        if self.reporting {
            self.results.push(FusionResult {
                t_valid: self.state.t,
                source,
                disposition,
                innovation: [0.0; 3],
                dimension: 0,
                test_ratio: f64::NAN,
            });
        }
    }
}

/// Most delayed copies kept, whatever frame rate and lag are.
const MAX_ECHOES: usize = 40;
