//! Simulated flights as values, the filter's estimates, and the refined ones.

use std::sync::Arc;

use nalgebra::Matrix3;

use windhover_base::geo::{Ground, wrap_angle};
use windhover_base::msg::{EstimatorOutput, Stamped, TargetEstimate, TrackStatus};
use windhover_base::settings::EstimatorConfig;
use windhover_estimate::{Estimator, Site};
use windhover_refine::{Recording, Refined, refine};
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

/// Scores start here, seconds into the flight: the filter has settled.
pub(super) const BURN_S: f64 = 6.0;

pub(super) struct Flown {
    pub(super) world: Arc<World>,
    pub(super) site: Site,
    pub(super) recording: Recording,
}

pub(super) fn fly(name: &str, seconds: f64, seed: u64, change: impl FnOnce(&mut Scenario)) -> Flown {
    let mut scenario = Scenario::named(name).expect("a named scenario");
    scenario.duration_s = seconds;
    change(&mut scenario);
    let declination_rad = scenario.declination_deg.to_radians();
    let world = Arc::new(World::new(scenario, seed));
    let site = Site { frame: *world.frame(), ground: Ground::Flat { down_m: 0.0 }, declination_rad };
    let mut suite = SensorSuite::new(Arc::clone(&world));
    let mut recording = Recording::default();
    while let Some(sample) = suite.next() {
        match sample {
            Sample::Gnss { stamped, .. } => recording.epochs.push(stamped),
            Sample::Attitude { stamped, .. } => recording.readings.push(stamped),
            Sample::Frame { truth, seq } => recording.frames.push(Stamped {
                t_valid: truth.t_stamp,
                t_recv: truth.t_recv,
                seq,
                value: suite.observations().clone(),
            }),
        }
    }
    Flown { world, site, recording }
}

impl Flown {
    pub(super) fn refined(&self) -> Refined {
        let recordings = std::slice::from_ref(&self.recording);
        let config = EstimatorConfig::default();
        refine(&self.world.scenario().rig, &config, &self.site, recordings, &mut |_| true).expect("a flight")
    }

    /// Real-time estimates of the filter.
    pub(super) fn filtered(&self) -> Vec<TargetEstimate> {
        let mut filter = Estimator::new(&self.world.scenario().rig, &EstimatorConfig::default(), &self.site);
        let (mut out, r) = (Vec::new(), &self.recording);
        let (mut e, mut a, mut f) = (0, 0, 0);
        loop {
            let next = [
                r.epochs.get(e).map(|m| m.t_recv),
                r.readings.get(a).map(|m| m.t_recv),
                r.frames.get(f).map(|m| m.t_recv),
            ];
            let Some(t) = next.iter().flatten().min().copied() else { break };
            if next[0] == Some(t) {
                filter.gnss(&r.epochs[e], &mut out);
                e += 1;
            } else if next[1] == Some(t) {
                filter.attitude(&r.readings[a], &mut out);
                a += 1;
            } else {
                filter.frame(&r.frames[f], &mut out);
                f += 1;
            }
        }
        let estimate = |o: EstimatorOutput| match o {
            EstimatorOutput::Estimate(e) => Some(e),
            _ => None,
        };
        out.into_iter().filter_map(estimate).collect()
    }
}

/// Errors of one estimator on one flight, from [`BURN_S`] on.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Score {
    pub(super) frames: f64,
    /// Sums of squares of heading (rad), speed, yaw rate, each over its variance too.
    pub(super) squares: [f64; 3],
    pub(super) normalised: [f64; 3],
    /// Sums of the variances.
    pub(super) variances: [f64; 3],
    pub(super) nees: f64,
    pub(super) position: f64,
}

impl Score {
    pub(super) fn of<'a>(estimates: impl IntoIterator<Item = &'a TargetEstimate>, world: &World) -> Self {
        let mut score = Self::default();
        for e in estimates {
            let live = matches!(e.status, TrackStatus::Tracking | TrackStatus::Coasting);
            let Some(state) = e.state.filter(|_| live && world.seconds(e.t_valid) >= BURN_S) else {
                continue;
            };
            let truth = world.vehicle(e.target, e.t_valid);
            let errors = nalgebra::Vector3::new(
                wrap_angle(state.heading_rad - truth.heading_rad),
                state.speed_mps - truth.speed_mps,
                state.yaw_rate_radps - truth.yaw_rate_radps,
            );
            let p = state.covariance.expect("reported");
            let three: Matrix3<f64> = p.fixed_view::<3, 3>(2, 2).into();
            score.frames += 1.0;
            for i in 0..3 {
                score.squares[i] += errors[i] * errors[i];
                score.variances[i] += three[(i, i)];
                score.normalised[i] += errors[i] * errors[i] / three[(i, i)];
            }
            score.nees += three.try_inverse().map_or(f64::NAN, |inverse| errors.dot(&(inverse * errors)));
            let reference = truth.reference(world.scenario().rig.target[e.target].reference_m);
            let off = nalgebra::Vector2::new(state.north_m - reference.x, state.east_m - reference.y);
            let place = p.fixed_view::<2, 2>(0, 0).into_owned();
            score.position += place.try_inverse().map_or(f64::NAN, |inverse| off.dot(&(inverse * off)));
        }
        score
    }

    pub(super) fn rms(&self, i: usize) -> f64 {
        (self.squares[i] / self.frames).sqrt()
    }

    /// Root of the mean variance: for the models linearised at the solution, the batch Cramér–Rao bound.
    pub(super) fn bound(&self, i: usize) -> f64 {
        (self.variances[i] / self.frames).sqrt()
    }

    pub(super) fn add(&mut self, other: &Self) {
        self.frames += other.frames;
        self.nees += other.nees;
        self.position += other.position;
        for i in 0..3 {
            self.squares[i] += other.squares[i];
            self.normalised[i] += other.normalised[i];
            self.variances[i] += other.variances[i];
        }
    }
}

impl std::fmt::Display for Score {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "heading {:.3} deg, speed {:.4} m/s, yaw rate {:.4} rad/s; normalised {:.2?}, of all three {:.2}, of position \
             {:.2}",
            self.rms(0).to_degrees(),
            self.rms(1),
            self.rms(2),
            self.normalised.map(|n| n / self.frames),
            self.nees / self.frames,
            self.position / self.frames
        )
    }
}
