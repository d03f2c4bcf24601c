//! A pass with covariances: the whole problem opened backward, the residual of each measurement, and the estimates.

use std::collections::BTreeMap;

use nalgebra::UnitQuaternion;

use windhover_base::msg::{MarkerId, Ownship, TargetEstimate, TrackStatus};
use windhover_estimate::Site;

use crate::block::{Block, Noise, Source};
use crate::front::Back;
use crate::noise::Components;
use crate::problem::{Origin, Pass, Problem};
use crate::recording::Recording;
use crate::result::{ClockDifference, Constant, Outlier, Refined, Tally};
use crate::solve::{EliminatedKind, Factors, Unsolved};
use crate::stamped::{own_covariance, target_covariance};
use crate::unknowns::{Prior, constant, knot};
use crate::values::{Knot, Values};

/// Result of a pass with covariances.
pub(crate) struct PassResult {
    pub(crate) components: Components,
    pub(crate) refined: Refined,
    /// Correlation of pixel errors from frame to frame.
    pub(crate) memory: PixelMemory,
    /// For each landmark: detections, and those outside the gate.
    pub(crate) landmarks: Vec<(usize, usize)>,
}

/// Opens the whole problem backward: covariances, the residual of each measurement, and the estimates.
pub(crate) fn look(
    pass: &mut Pass<'_>,
    factors: &Factors,
    values: &Values,
    noise: &Noise,
    site: &Site,
    recordings: &[Recording],
) -> Result<PassResult, Unsolved> {
    let problem = pass.problem;
    let mut looked = PassResult {
        components: Components::new(problem.targets, problem.plan.windows),
        refined: Refined::default(),
        memory: PixelMemory::default(),
        landmarks: vec![(0, 0); problem.plan.landmarks],
    };
    let mut counts = vec![(0usize, 0usize); Source::count(problem.targets)];
    let mut back = Back::new(problem.shape);
    for index in (0..factors.segments()).rev() {
        for (what, e) in factors.segment(index, pass, values, noise)?.iter().rev() {
            back.solve_with_covariance(e);
            match what {
                EliminatedKind::Constants => {
                    looked.refined.constants = constants(problem, values, &back);
                    looked.refined.clocks = clocks(problem, values, &back);
                }
                // Its frame's displacement is still closed.
                EliminatedKind::Knot(k) if problem.is_displaced(*k) => {}
                EliminatedKind::Landmark(_) => {}
                EliminatedKind::Knot(k) | EliminatedKind::Shake(k) => {
                    pass.blocks(*k, values, noise, &mut |origin: Origin, block: &Block| {
                        looked.take(origin, block, &back, problem, (*k, noise), &mut counts);
                    });
                    looked.estimate(pass, values, &back, *k, (site, recordings));
                }
            }
        }
    }
    looked.refined.own.reverse();
    looked.refined.targets.reverse();
    looked.refined.tallies = tallies(problem.targets, &counts, noise);
    Ok(looked)
}

impl PassResult {
    /// Adds the estimates of a knot.
    fn estimate(
        &mut self,
        pass: &Pass<'_>,
        values: &Values,
        back: &Back,
        k: usize,
        (site, recordings): (&Site, &[Recording]),
    ) {
        let (problem, stop) = (pass.problem, &pass.problem.plan.stops[k]);
        let late_s = values.constants[constant::CAMERA_DELAY];
        let state = pass.state_at(k, values, late_s);
        self.refined.own.push((stop.flight, ownship(pass, (k, late_s), &state, back, site, recordings)));
        if stop.frame.is_some() {
            for target in 0..problem.targets {
                let estimate = target_estimate(pass, (k, late_s), &state, back, target, recordings);
                self.refined.targets.push((stop.flight, estimate));
            }
        }
    }

    fn take(
        &mut self,
        origin: Origin,
        block: &Block,
        back: &Back,
        problem: &Problem<'_>,
        (k, noise): (usize, &Noise),
        counts: &mut [(usize, usize)],
    ) {
        let measured = origin.source.is_measured();
        let ratio = block.square() / problem.gates[block.len()];
        let outside = measured && ratio > 1.0;
        let count = &mut counts[origin.source.index()];
        (count.0, count.1) = (count.0 + 1, count.1 + usize::from(outside));
        if let Some(landmark) = origin.landmark {
            let seen = &mut self.landmarks[landmark];
            (seen.0, seen.1) = (seen.0 + 1, seen.1 + usize::from(outside));
        }
        if let Some(marker) = origin.marker.filter(|_| !outside) {
            self.memory.take(marker, k, &block.right);
        }
        let stop = &problem.plan.stops[k];
        if outside {
            let Origin { source, marker, .. } = origin;
            self.refined.outliers.push(Outlier { flight: stop.flight, t: stop.t, source, marker, ratio });
        }
        // Outliers count as far as they pull: where the noise is far too small, most are outside.
        let weight = if outside { 1.0 / ratio } else { 1.0 };
        let figure = noise.at(origin.source, stop.window);
        self.components.take(origin.source, (stop.window, figure, weight), block, back);
    }
}

/// Correlation of pixel errors, from the residuals of a marker in neighbouring frames.
///
/// A slightly wrong lens, or an edge that is located slightly to one side, has the same error in all frames.
/// Trajectories hardly depend on it; constants, which combine thousands of pixels, would get far too small sigmas.
#[derive(Clone, Debug, Default)]
pub(crate) struct PixelMemory {
    last: BTreeMap<MarkerId, (usize, Vec<f64>)>,
    together: f64,
    alone: f64,
}

/// Largest factor of correlated errors on a variance.
const MOST_INFLATION: f64 = 100.0;

impl PixelMemory {
    fn take(&mut self, marker: MarkerId, k: usize, left: &[f64]) {
        if let Some((later, before)) = self.last.get(&marker)
            && before.len() == left.len()
            && later.abs_diff(k) == 1
        {
            self.together += before.iter().zip(left).map(|(a, b)| a * b).sum::<f64>();
            self.alone += before.iter().chain(left).map(|a| 0.5 * a * a).sum::<f64>();
        }
        self.last.insert(marker, (k, left.to_vec()));
    }

    /// Factor on the variances of constants relative to white errors, `(1 + ρ)/(1 − ρ)` with the correlation ρ from
    /// frame to frame.
    pub(crate) fn inflation(&self) -> f64 {
        if self.alone <= 0.0 {
            return 1.0;
        }
        let correlation = (self.together / self.alone).clamp(0.0, 0.99);
        ((1.0 + correlation) / (1.0 - correlation)).min(MOST_INFLATION)
    }
}

fn tallies(targets: usize, counts: &[(usize, usize)], noise: &Noise) -> Vec<Tally> {
    use Source as S;
    let own = [S::Outside, S::GpsPosition, S::GpsVelocity, S::Heading, S::Tilt, S::Feature];
    let motion = [S::TiltMotion, S::YawMotion, S::Gust, S::Thrust, S::Vibration, S::Shake, S::ShakeRoll];
    let of_targets = (0..targets)
        .flat_map(|t| [S::Marker(t), S::Drive(t), S::Turn(t), S::Sway(t), S::Heave(t), S::Slip(t)]);
    let all = own.into_iter().chain(motion).chain(of_targets);
    let tally = |source: Source| {
        let (taken, outliers) = counts[source.index()];
        Tally { source, taken, outliers, figure: noise.of(source) }
    };
    all.map(tally).filter(|tally| tally.taken > 0).collect()
}

fn constants(problem: &Problem<'_>, values: &Values, back: &Back) -> Vec<Constant> {
    let at = problem.shape.constants_at();
    let constant = |(i, (prior, value)): (usize, (&Prior, &f64))| {
        let found = back.covariance(at + i, at + i).max(0.0).sqrt();
        let sigma = if prior.is_estimated() { found } else { prior.sigma };
        Constant { kind: prior.kind, value: *value, sigma, prior: prior.mean, prior_sigma: prior.careful }
    };
    problem.priors.iter().zip(&values.constants).enumerate().map(constant).collect()
}

fn clocks(problem: &Problem<'_>, values: &Values, back: &Back) -> Vec<ClockDifference> {
    let (camera, at) = (constant::CAMERA_DELAY, problem.shape.constants_at());
    let others = [constant::COMPASS_DELAY, constant::GPS_DELAY];
    let estimated = |i: &usize| problem.priors[*i].is_estimated() && problem.priors[camera].is_estimated();
    let difference = |other: usize| {
        let [a, b, ab] =
            [(camera, camera), (other, other), (camera, other)].map(|(i, j)| back.covariance(at + i, at + j));
        let late_s = values.constants[camera] - values.constants[other];
        let sigma_s = (a + b - 2.0 * ab).max(0.0).sqrt();
        ClockDifference { other: problem.priors[other].kind, late_s, sigma_s }
    };
    others.into_iter().filter(estimated).map(difference).collect()
}

fn ownship(
    pass: &Pass<'_>,
    (k, late_s): (usize, f64),
    state: &Knot,
    back: &Back,
    site: &Site,
    recordings: &[Recording],
) -> Ownship {
    let problem = pass.problem;
    let stop = &problem.plan.stops[k];
    let mut covariance = own_covariance(problem, (k, late_s), state, pass.pushed_at(k), back);
    for i in knot::ATTITUDE..knot::ATTITUDE + 2 {
        covariance[(i, i)] += problem.considered_tilt_var;
    }
    let position = state.three(knot::POSITION);
    let place = site.frame.geodetic(&position);
    Ownship {
        t_valid: stop.t,
        frame: stop.frame.map(|frame| recordings[stop.flight].frames[frame].value.frame),
        position_ned_m: position,
        velocity_ned_mps: state.three(knot::VELOCITY),
        ned_from_body: UnitQuaternion::from_rotation_matrix(&state.attitude),
        lat_deg: place.lat_deg,
        lon_deg: place.lon_deg,
        height_m: place.height_m,
        covariance,
    }
}

fn target_estimate(
    pass: &Pass<'_>,
    (k, late_s): (usize, f64),
    state: &Knot,
    back: &Back,
    target: usize,
    recordings: &[Recording],
) -> TargetEstimate {
    let problem = pass.problem;
    let stop = &problem.plan.stops[k];
    let frame = stop.frame.map(|frame| &recordings[stop.flight].frames[frame].value);
    let shown = frame.is_some_and(|frame| {
        let of = |marker| pass.predictor.find(marker).is_some_and(|(t, _)| t == target);
        frame.markers.iter().any(|seen| of(seen.marker))
    });
    let status = match (stop.held[target], shown) {
        (false, _) => TrackStatus::Lost,
        (true, true) => TrackStatus::Tracking,
        (true, false) => TrackStatus::Coasting,
    };
    let covariance = target_covariance(problem, (k, late_s), state, target, back);
    let mean = &state.target(target)[..5];
    let state = stop.held[target].then(|| pass.predictor.target_state(target, mean, &covariance));
    TargetEstimate { t_valid: stop.t, frame: frame.map_or(0, |frame| frame.frame), target, status, state }
}
