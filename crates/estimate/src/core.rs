//! The filter proper: one state, one measurement after another in order of validity.

use windhover_base::msg::{Disposition, FixKind, FusionResult, FusionSource, MarkerDetection};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::{MonoTime, Span};

use super::Site;
use super::blocks::{Layout, own};
use super::fit::WATCHED;
use super::fitted::{LEARN_RATIO, Learning, Learnt};
use super::ground::GroundWork;
use super::kind::TiltWatch;
use super::measurement::Measurement;
use super::models::Models;
use super::own::Senses;
use super::receiver_error::Wandering;
use super::state::State;
use super::update::{Outcome, Workspace};

/// Interval over which increments are looked at to fit intensities: long enough that they stand
/// out of the noise, short enough to be what the filter's memory sees.
const LEARN_INTERVAL_MS: f64 = 400.0;
/// Likewise while nothing but GPS and compass is measured, which show motion over a second.
const BLIND_INTERVAL_MS: f64 = 1000.0;

/// State, models and room for arithmetic.
#[derive(Clone, Debug)]
pub(crate) struct Core {
    pub(crate) models: Models,
    pub(crate) learning: Learning,
    pub(crate) lost_after: Span,
    pub(crate) restart_after: u32,
    /// How long delayed copies are kept.
    pub(crate) keep_copies: Span,
    pub(crate) state: State,
    pub(crate) work: Workspace,
    pub(crate) z: Measurement,
    pub(crate) ground: GroundWork,
    /// Room for a direction of the error state.
    pub(crate) along: Vec<f64>,
    /// Room for the markers of a frame that are fused.
    pub(crate) chosen: Vec<MarkerDetection>,
    /// What became of measurements; filled only while `reporting`.
    pub(crate) results: Vec<FusionResult>,
    pub(crate) reporting: bool,
    /// For the bound: the mean is the truth, so innovations are taken as zero and nothing is gated.
    pub(crate) at_truth: bool,
}

impl Core {
    pub(crate) fn new(rig: &Rig, estimator: &EstimatorConfig, site: &Site) -> Self {
        let models = Models::new(rig, estimator, site);
        let e = estimator;
        let second = rig.attitude.unwrap_or_default();
        let variance = |deg: f64| deg.to_radians().powi(2);
        let tilt = [rig.compass.tilt, second.tilt].map(TiltWatch::new);
        let mut senses = Senses::default();
        senses.of_tilt(&tilt);
        senses.of_fix(FixKind::ThreeD, None, 1.0, &models);
        senses.hold_bias(MonoTime::default());
        let tilt_error_var = senses.tilt_error_var;
        let start = Learnt {
            target_q: vec![models.target_walks; rig.target.len()],
            tilt_rate_q: e.tilt_rate_walk.powi(2),
            yaw_rate_q: e.yaw_rate_walk.powi(2),
            gust_var: e.side_force_mps2.powi(2),
            thrust_var: e.thrust_mps2.powi(2),
            tilt_error_var,
            tilt_var: [rig.compass.tilt_noise_deg, second.tilt_noise_deg].map(variance),
            heading_var: [rig.compass.heading_noise_deg, second.heading_noise_deg].map(variance),
            marker_factor: vec![1.0; rig.target.len()],
            feature_factor: 1.0,
            gps_factor: 1.0,
            receiver: Wandering::default(),
            gps_velocity_factor: 1.0,
            force_factor: 1.0,
            blind: true,
            t_target: MonoTime::default(),
        };
        let lag_frames = (e.smoother_lag_ms * 1e-3 * rig.camera.fps).ceil() as usize;
        let own = match (rig.imu, rig.attitude) {
            (_, Some(_)) => own::WITH_SECOND,
            (Some(_), None) => own::WITH_IMU,
            (None, None) => own::LEN,
        };
        let layout =
            Layout { own, targets: rig.target.len(), features: e.features, tags: models.fitted_tags() };
        let copies = (lag_frames * 3 / 2 + 6).min(MAX_COPIES);
        let state = State::new(layout, copies, start.clone(), senses, tilt);
        Self {
            work: Workspace::new(layout.len()),
            z: Measurement::default(),
            along: vec![0.0; layout.len()],
            chosen: Vec::with_capacity(64),
            ground: GroundWork::new(layout.features, layout.len()),
            models,
            learning: Learning {
                on: e.learn,
                over_s: e.learn_s,
                interval: Span::from_ms(LEARN_INTERVAL_MS),
                blind_interval: Span::from_ms(BLIND_INTERVAL_MS),
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

    /// Fuses what stands in `self.z` through the gate, and reports it.
    pub(crate) fn fuse_gated(&mut self, source: FusionSource) -> Outcome {
        let gate = (!self.at_truth).then_some(self.models.gates[self.z.m]);
        let outcome = self.fuse(source, gate);
        if let (Some(place), Some(gate)) = (WATCHED.iter().position(|watched| *watched == source), gate) {
            let (z, t) = (&self.z, self.state.t);
            let (squared, is_blind) = (outcome.ratio * gate, self.state.is_blind());
            self.state.fits[place].take(t, squared, &z.residual, &outcome.innovation_var, z.m, is_blind);
        }
        self.report(source, outcome);
        outcome
    }

    /// The normalised innovation squared over the gate of what stands in `self.z`, which is not fused; `None` where it cannot
    /// be computed.
    pub(crate) fn gate_ratio(&mut self) -> Option<f64> {
        let square = self.work.square(&self.state, &self.z)?;
        Some(square / self.models.gates[self.z.m])
    }

    /// Whether a measurement says something of the noise of good ones.
    pub(crate) fn teaches(&self, outcome: &Outcome) -> bool {
        self.learning.on && outcome.ratio < LEARN_RATIO
    }

    /// Fuses what stands in `self.z`.
    pub(crate) fn fuse(&mut self, source: FusionSource, gate: Option<f64>) -> Outcome {
        if self.at_truth {
            self.z.residual.fill(0.0);
        }
        let held = self.state.held(source);
        self.work.fuse(&mut self.state, &self.z, gate, held)
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
    pub(crate) fn refuse(&mut self, source: FusionSource, disposition: Disposition) {
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
const MAX_COPIES: usize = 40;
