//! The bound on the errors: an information filter that is linearised about the truth.

use std::sync::Arc;

use nalgebra::{SMatrix, SVector, Vector3};
use windhover_base::msg::FrameObservations;
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::{MonoTime, Span};
use windhover_estimate::{Bound, BoundTruth, Site};
use windhover_simulate::{Sample, SensorSuite, World};

use crate::score::{BURN_S, Figures, shows};

/// The truth in the form for the bound.
fn truth_at(world: &World, t: MonoTime, gps_delay_s: f64) -> BoundTruth {
    let own = world.ownship(t);
    let targets = (0..world.vehicles()).map(|i| {
        let v = world.vehicle(i, t);
        [v.north_m, v.east_m, v.heading_rad, v.speed_mps, v.yaw_rate_radps]
    });
    BoundTruth {
        position: own.position_ned_m,
        velocity: own.velocity_ned_mps,
        acceleration: own.acceleration_ned_mps2,
        ned_from_body: own.ned_from_body,
        rate: own.body_rate_radps,
        tilt_gain: world.scenario().compass.tilt_gain,
        tilt_error: (0.0, 30.0),
        drag_per_s: world.scenario().helicopter.drag_per_s,
        gps_delay_s,
        targets: targets.collect(),
    }
}

/// Intensities of motion: a target's speed and yaw rate, the helicopter's rates about its roll and pitch axes and about
/// its yaw axis, forces other than thrust along its axis, its thrust; units²/s.
type Intensities = [f64; 6];

/// Limits of the time scale of intensities, s.
const SCALES_S: (f64, f64) = (0.1, 5.0);
/// Time scale at which the filter learns the motion of the helicopter, and at which the bound starts, s.
const LEARNT_OVER_S: f64 = 0.4;

/// Intensities of the true motion, each by its increments over its own `scale`.
fn intensities(world: &World, scales_s: &[f64; 6]) -> Intensities {
    let scenario = world.scenario();
    let components = |t: MonoTime| -> [f64; 8] {
        let (vehicle, own) = (world.vehicle(0, t), world.ownship(t));
        let drag = own.velocity_ned_mps * scenario.helicopter.drag_per_s;
        let felt = own.acceleration_ned_mps2 + drag - Vector3::z() * 9.806_65;
        let axis = own.ned_from_body * Vector3::z();
        let (gust, rate) = (felt - axis * (felt.z / axis.z), own.body_rate_radps);
        [vehicle.speed_mps, vehicle.yaw_rate_radps, rate.x, rate.y, rate.z, gust.x, gust.y, felt.z]
    };
    let walk = |kind: usize, places: &[usize]| {
        let step_s = scales_s[kind];
        let times =
            (0..).map(|k| BURN_S + 0.1 * f64::from(k)).take_while(|t| t + step_s < scenario.duration_s);
        let (sum, n) = times.fold((0.0, 0.0), |(sum, n), t| {
            let (a, b) = (components(world.time(t)), components(world.time(t + step_s)));
            (sum + places.iter().map(|i| (b[*i] - a[*i]).powi(2)).sum::<f64>(), n + places.len() as f64)
        });
        sum / f64::max(n, 1.0) / step_s
    };
    // A vehicle at rest has intensity zero; a configured value must be positive.
    [
        walk(0, &[0]).max(4e-4),
        walk(1, &[1]).max(1e-4),
        walk(2, &[2, 3]).max(1e-8),
        walk(3, &[4]).max(1e-8),
        walk(4, &[5, 6]).max(1e-8),
        walk(5, &[7]).max(1e-8),
    ]
}

/// Correlation time of the thrust beyond the weight in the filter's model, s.
const THRUST_TAU_S: f64 = 2.0;

/// The configuration with these intensities and the true noise.
fn configured_with_truth(world: &World, q: &Intensities) -> (Rig, EstimatorConfig) {
    let scenario = world.scenario();
    let mut rig = scenario.rig.clone();
    let mut e = EstimatorConfig::default();
    (e.target_speed_walk, e.target_yaw_rate_walk) = (q[0].sqrt(), q[1].sqrt());
    (e.tilt_rate_walk, e.yaw_rate_walk) = (q[2].sqrt(), q[3].sqrt());
    // A Gauss–Markov process of variance s² walks by 2 s²/τ.
    let sigma = |q: f64, tau_s: f64| (q * 0.5 * tau_s).sqrt();
    (e.side_force_mps2, e.thrust_mps2) = (sigma(q[4], e.force_tau_s), sigma(q[5], THRUST_TAU_S));
    let (gps, compass) = (&scenario.gps, &scenario.compass);
    (e.marker_noise_px, e.feature_sigma_factor) = (0.0, 1.0);
    (rig.gps.bias_sigma_m, rig.gps.noise_m) = (gps.bias_sigma_m, gps.noise_m);
    rig.gps.velocity_noise_mps = gps.velocity_noise_mps;
    rig.compass.heading_noise_deg = compass.heading_noise_deg;
    rig.compass.tilt_noise_deg = compass.tilt_noise_deg;
    (rig, e)
}

/// Mean variances of the bound over a run, of every target.
#[derive(Default)]
struct BoundScore {
    frames: f64,
    variance: SVector<f64, 5>,
}

impl BoundScore {
    fn add(&mut self, covariance: &SMatrix<f64, 5, 5>) {
        self.frames += 1.0;
        self.variance += covariance.diagonal();
    }

    /// Memory of an optimal filter for speed and yaw rate: `4/3 P/q`.
    fn scales_s(&self, q: &Intensities) -> [f64; 2] {
        let p = [self.variance[3], self.variance[4]].map(|sum| sum / self.frames.max(1.0));
        std::array::from_fn(|i| (4.0 / 3.0 * p[i] / q[i]).clamp(SCALES_S.0, SCALES_S.1))
    }

    fn figures(&self) -> Figures {
        let rms = |i: usize| (self.variance[i] / self.frames.max(1.0)).sqrt();
        let none = f64::NAN;
        Figures([none, rms(2).to_degrees(), rms(3), rms(4), none, none, none, none])
    }
}

/// The bound over a flight: its measurements in order of validity. Motion is smoother than a random walk, so the
/// describing walk depends on the time scale: for the helicopter 0.4 s, as in the filter; for vehicles the bound's own
/// memory of the component, found by iteration.
pub(crate) fn bound(world: &Arc<World>, site: &Site) -> Figures {
    let mut suite = SensorSuite::new(Arc::clone(world));
    let delay_s = suite.gps_latency_error().s();
    let mut taken = Vec::new();
    while let Some(sample) = suite.next() {
        let t = match &sample {
            Sample::Gnss { stamped, .. } => stamped.t_valid - Span::from_s(delay_s),
            Sample::Attitude { t_true, .. } => *t_true,
            Sample::Frame { truth, .. } => truth.t_true,
        };
        let seen = matches!(sample, Sample::Frame { .. }).then(|| suite.observations().clone());
        taken.push((t, sample, seen));
    }
    taken.sort_by_key(|(t, ..)| *t);
    let mut scales_s = [LEARNT_OVER_S; 6];
    let mut score = BoundScore::default();
    for _ in 0..PASSES {
        let q = intensities(world, &scales_s);
        score = bound_pass(world, site, &configured_with_truth(world, &q), &taken);
        scales_s[..2].copy_from_slice(&score.scales_s(&q));
    }
    score.figures()
}

/// The measurements of a flight, their times of validity, and the detections of the frames.
type Taken = Vec<(MonoTime, Sample, Option<FrameObservations>)>;
/// Iterations of the bound until the time scales agree with it.
const PASSES: usize = 4;

fn bound_pass(world: &World, site: &Site, configured: &(Rig, EstimatorConfig), taken: &Taken) -> BoundScore {
    let mut bound = Bound::new(&configured.0, &configured.1, site);
    let mut score = BoundScore::default();
    for (t, sample, seen) in taken {
        // A fix enters at its stamp, with the delay that is to be estimated.
        let truth = truth_at(world, *t, 0.0);
        match sample {
            Sample::Gnss { stamped, .. } => bound.gnss(*t, &stamped.value, &truth),
            Sample::Attitude { stamped, .. } => bound.attitude(*t, &stamped.value, &truth),
            Sample::Frame { .. } => {
                if let Some(seen) = seen {
                    bound.frame(*t, seen, &truth);
                }
                let scored = world.seconds(*t) >= BURN_S;
                let shown = |target: &usize| {
                    seen.as_ref().is_some_and(|seen| shows(seen, &world.scenario().rig, *target))
                };
                for target in (0..world.vehicles()).filter(|_| scored).filter(shown) {
                    if let Some(covariance) = bound.target(target) {
                        score.add(&covariance);
                    }
                }
            }
        }
    }
    score
}
