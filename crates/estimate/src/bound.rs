//! What the information allows: the posterior Cramér–Rao bound, by the same models linearised at the
//! truth (Tichavský 1998: for additive Gaussian noise the bound's recursion is the Kalman filter's
//! covariance recursion with the Jacobians taken at the true state). A tool for simulations: it is fed
//! with the measurements of a flight in order of their true times, and with the truth at each.

use nalgebra::{Rotation3, SMatrix, Vector2, Vector3};

use windhover_base::msg::{AttitudeSample, FrameObservations, GnssEpoch};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::MonoTime;

use super::Site;
use super::blocks::own;
use super::core::Core;
use super::force::Force;
use super::kind::TiltWatch;
use super::output::target_state;
use super::own::GRAVITY;
use super::sources::{AnyMeasurement, Kind};
use super::start::start;

/// The truth at one instant.
#[derive(Clone, PartialEq, Debug)]
pub struct BoundTruth {
    /// Position of the body frame's origin, NED, m.
    pub position: Vector3<f64>,
    /// Velocity, NED, m/s.
    pub velocity: Vector3<f64>,
    /// Acceleration, NED, m/s².
    pub acceleration: Vector3<f64>,
    /// Attitude.
    pub ned_from_body: Rotation3<f64>,
    /// Angular rate in the body frame, rad/s.
    pub rate: Vector3<f64>,
    /// How much of the tilt the compass reads.
    pub tilt_gain: f64,
    /// Sigma (rad) and correlation time (s) of the slow error with which it does.
    pub tilt_error: (f64, f64),
    /// Drag, 1/s.
    pub drag_per_s: f64,
    /// How much older GPS is than its stamp says, s.
    pub gps_delay_s: f64,
    /// Per target: rear axle north, east, heading, speed, yaw rate.
    pub targets: Vec<[f64; 5]>,
}

/// The recursion.
#[derive(Clone, Debug)]
pub struct Bound {
    core: Core,
    scratch: AnyMeasurement,
}

impl Bound {
    /// A bound with the noise figures of a configuration, unchanged: nothing is learnt.
    pub fn new(rig: &Rig, estimator: &EstimatorConfig, site: &Site) -> Self {
        let mut core = Core::new(rig, estimator, site);
        core.learning.on = false;
        core.at_truth = true;
        Self { core, scratch: AnyMeasurement::default() }
    }

    /// Takes an epoch that was true at `t`. The first one starts the recursion.
    pub fn gnss(&mut self, t: MonoTime, epoch: &GnssEpoch, truth: &BoundTruth) {
        if !self.core.state.alive {
            let compass = AttitudeSample { heading: Some(0.0), ..AttitudeSample::default() };
            self.core.state.tilt[0] = TiltWatch::known(truth.tilt_gain);
            if !start(&mut self.core.state, t, epoch, &compass, &self.core.models) {
                return;
            }
            let (sigma, tau_s) = truth.tilt_error;
            let state = &mut self.core.state;
            (state.senses.tilt_error_var, state.senses.tilt_error_tau_s) = (sigma * sigma, tau_s);
            state.learnt.tilt_error_var = sigma * sigma;
            state.renew(own::TILT_ERROR, &[sigma * sigma; 2]);
        }
        self.scratch.kind = Kind::Gnss;
        self.scratch.gnss = *epoch;
        self.process(t, truth);
    }

    /// Takes a compass reading that was true at `t`.
    pub fn attitude(&mut self, t: MonoTime, sample: &AttitudeSample, truth: &BoundTruth) {
        self.scratch.kind = Kind::Attitude;
        self.scratch.attitude = *sample;
        self.process(t, truth);
    }

    /// Takes a frame exposed at `t`, with what was seen in it.
    pub fn frame(&mut self, t: MonoTime, seen: &FrameObservations, truth: &BoundTruth) {
        self.scratch.kind = Kind::Frame;
        self.scratch.frame.clone_from(seen);
        self.process(t, truth);
    }

    /// The bound on a target's covariance at its reference point: north, east, heading, speed, yaw
    /// rate. `None` while it has not been seen.
    pub fn target(&self, target: usize) -> Option<SMatrix<f64, 5, 5>> {
        let (state, block) = (&self.core.state, self.core.state.layout().target(target).all());
        let track = &state.targets[target];
        let covariance = state.cov.block(block, block);
        let at_reference = target_state(&self.core.models, target, &track.mean, &covariance);
        (state.alive && track.life.is_held()).then_some(at_reference.covariance).flatten()
    }

    fn process(&mut self, t: MonoTime, truth: &BoundTruth) {
        if !self.core.state.alive || t < self.core.state.t {
            return;
        }
        self.core.state.propagate(t, &self.core.models);
        self.adopt(truth);
        self.core.process(t, &self.scratch);
        self.adopt(truth);
    }

    /// Puts the truth in the place of the mean.
    fn adopt(&mut self, truth: &BoundTruth) {
        let own = &mut self.core.state.own;
        own.position = truth.position;
        own.velocity = truth.velocity;
        own.ned_from_body = truth.ned_from_body;
        own.rate = truth.rate;
        own.drag_per_s = truth.drag_per_s;
        // Thrust along the axis carries the weight and what vertical force is felt; the rest across is gusts.
        let felt = truth.acceleration + truth.velocity * truth.drag_per_s - Vector3::z() * GRAVITY;
        own.thrust = -felt.z - GRAVITY;
        own.gust = Vector2::zeros();
        own.gust = (felt - Force::of(own).ned - own.velocity * own.drag_per_s).xy();
        own.tilt_gain = truth.tilt_gain;
        own.gps_delay_s = truth.gps_delay_s;
        for (target, mean) in self.core.state.targets.iter_mut().zip(&truth.targets) {
            target.mean = *mean;
        }
    }
}
