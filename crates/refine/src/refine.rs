//! From recordings to a refined flight.

use nalgebra::{Rotation3, Vector3};

use windhover_base::geo::{locate, wrap_angle};
use windhover_base::msg::{FeltTilt, FixKind, TargetEstimate};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::MonoTime;
use windhover_estimate::Site;
use windhover_estimate::batch::{Predictor, SHAKE_COLUMNS};

use crate::block::{Noise, Source};
use crate::covariance_pass::{PassResult, look};
use crate::felt::felt as decide_felt;
use crate::front::Shape;
use crate::initial::{InitialValues, filtered};
use crate::motion::Processes;
use crate::noise::first as first_noise;
use crate::plan::Plan;
use crate::problem::{Pass, Problem};
use crate::recording::Recording;
use crate::result::Refined;
use crate::roughness::make_consistent;
use crate::solve::{Unsolved, Watch, apply, solve};
use crate::surveyed::control_points;
use crate::unknowns::{constant, knot, outside_places, places, priors};
use crate::values::{Knot, Values};

/// Why a flight could not be refined.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum RefineError {
    /// There is no position.
    #[error("the receiver never had a position: there are no initial values")]
    NoFix,
    /// There is no heading.
    #[error("there are no compass readings: heading and tilt have no initial values")]
    NoCompass,
    /// The filter never started.
    #[error(
        "positions and compass readings are never within three seconds of each other: the filter does not start"
    )]
    NotStarted,
    /// The normal equations cannot be solved.
    #[error("the measurements do not determine the flight (the normal equations are singular)")]
    Singular,
    /// The caller stopped it.
    #[error("stopped")]
    Stopped,
}

impl From<Unsolved> for RefineError {
    fn from(unsolved: Unsolved) -> Self {
        match unsolved {
            Unsolved::Singular => Self::Singular,
            Unsolved::Stopped => Self::Stopped,
        }
    }
}

/// Most rounds of fitting noise and motion, and the change of a factor's logarithm that ends them.
const ROUNDS: usize = 8;
const SETTLED: f64 = 0.1;
/// A step with a smaller expected reduction of the sum of squares is negligible; while factors still change, the limit
/// is this for each knot.
const CONVERGED: f64 = 0.05;
const NEARLY: f64 = 2e-3;
const ROUGHLY: f64 = 30.0;
/// A ground feature with a larger share of detections outside the gate is dropped.
const MOVING: f64 = 0.25;
const MOST_MOVE: f64 = 0.6;
/// Chi-square values that good measurements exceed once in a thousand, by number of components.
const GATES: [f64; 9] = [f64::INFINITY, 10.83, 13.82, 16.27, 18.47, 20.52, 22.46, 24.32, 26.12];
/// A flight in which a smaller share of knots has a target is blind.
const BLIND: f64 = 0.2;
/// The slow error of tilt readings where it is not estimated, rad.
const HELD_TILT_ERROR: f64 = 1e-5;
/// Knots of which all eliminations are kept at once: some 200 MB.
const SEGMENT: usize = 5_000;
/// Most outliers that are listed.
const NAMED: usize = 200;
/// Factor on the variance of tilt readings of which it is not known what they mean.
const UNBELIEVED: f64 = 100.0;
/// Correlation time of the thrust beyond the weight, s.
const THRUST_TAU_S: f64 = 2.0;

/// Estimates the trajectories of helicopter and targets over whole recordings at once, with the constants they share.
///
/// `watch` is called often with the approximate completed share; `false` stops.
///
/// # Errors
/// The recordings do not determine a flight, or it was stopped.
pub fn refine(
    rig: &Rig,
    estimator: &EstimatorConfig,
    site: &Site,
    recordings: &[Recording],
    watch: &mut dyn FnMut(f64) -> bool,
) -> Result<Refined, RefineError> {
    let mut firsts: Vec<InitialValues> =
        recordings.iter().map(|recording| filtered(rig, estimator, site, recording)).collect();
    let mut predictor = Predictor::new(rig, estimator, site);
    let plan = planned(&predictor, recordings, &firsts, rig.target.len(), estimator.lost_after_s);
    if plan.stops.is_empty() {
        return Err(why_not_started(recordings));
    }
    let (gust_mps2, thrust_mps2) = (estimator.side_force_mps2, estimator.thrust_mps2);
    let shakes = shake_of(&firsts).map(|shake| shake.0);
    let mut noise = first_noise(rig.target.len(), gust_mps2, thrust_mps2, shakes);
    let total = (plan.stops.len() * (ROUNDS + 1) * 3) as f64;
    let mut done = 0usize;
    let mut step = |_: usize| {
        done += 1;
        watch((done as f64 / total).min(1.0))
    };
    let mut felt = firsts.iter().find_map(|first| first.felt);
    if felt.is_none() {
        let config = (rig, estimator, site);
        felt = undecided_felt(config, recordings, (plan.clone(), &firsts), &noise, &mut step)?;
        firsts.iter_mut().for_each(|first| first.felt = felt);
    }
    predictor.set_felt(felt);
    let mut problem = stated((rig, estimator, site), recordings, plan, &mut predictor, &firsts);
    let mut values = first_values(&problem, &firsts, &predictor, rig, site);
    let nearly = NEARLY * problem.plan.stops.len() as f64;
    let mut last = false;
    for round in 0.. {
        let looked = {
            let mut pass = Pass::new(&problem, predictor.clone());
            // Between rounds one step is enough: the next noise moves the solution again.
            let enough = [nearly, ROUGHLY * nearly, CONVERGED][usize::from(round > 0) + usize::from(last)];
            let factors = solve(&mut pass, &mut values, &noise, enough, &mut step)?;
            let mut looked = look(&mut pass, &factors, &values, &noise, site, recordings)?;
            if !last {
                apply(&mut pass, &factors, &mut values, &noise)?;
            } else {
                drop(factors);
                let of = (site, recordings);
                make_consistent(&mut pass, &values, &noise, &mut looked, of, &mut step)?;
            }
            looked
        };
        if last {
            let mut refined = looked.refined;
            refined.finish(&problem, &firsts, felt, looked.memory.inflation());
            return Ok(refined);
        }
        let changed = drop_movers(&mut problem, &looked) + widen(&mut problem, &values);
        let moved = looked.components.fit(problem.targets, &mut noise);
        last = round + 1 >= ROUNDS || (moved < SETTLED && changed == 0);
    }
    unreachable!("the loop ends by its rounds")
}

/// What the tilt sensor measures, where the filter did not find out; `None` where the flight does not show it.
fn undecided_felt(
    config: (&Rig, &EstimatorConfig, &Site),
    recordings: &[Recording],
    (plan, firsts): (Plan, &[InitialValues]),
    noise: &Noise,
    watch: Watch<'_>,
) -> Result<Option<FeltTilt>, RefineError> {
    let (rig, estimator, site) = config;
    let mut predictor = Predictor::new(rig, estimator, site);
    let problem = stated(config, recordings, plan, &mut predictor, firsts);
    if problem.considered_tilt_var > 0.0 {
        return Ok(None);
    }
    let mut values = first_values(&problem, firsts, &predictor, rig, site);
    let mut noise = noise.clone();
    noise.set(Source::Tilt, UNBELIEVED);
    let enough = ROUGHLY * NEARLY * problem.plan.stops.len() as f64;
    let mut pass = Pass::new(&problem, predictor);
    solve(&mut pass, &mut values, &noise, enough, watch)?;
    Ok(decide_felt(&mut pass, &values))
}

fn why_not_started(recordings: &[Recording]) -> RefineError {
    let fixes = |r: &Recording| r.epochs.iter().any(|e| e.value.fix.has_position());
    let headings = |r: &Recording| r.readings.iter().any(|s| s.value.heading.is_some());
    match (recordings.iter().any(fixes), recordings.iter().any(headings)) {
        (false, _) => RefineError::NoFix,
        (_, false) => RefineError::NoCompass,
        _ => RefineError::NotStarted,
    }
}

/// How far the camera shakes, of several flights that in which it does most.
fn shake_of(firsts: &[InitialValues]) -> Option<([f64; 2], f64)> {
    firsts.iter().filter_map(|first| first.shake).max_by(|a, b| a.0[0].total_cmp(&b.0[0]))
}

pub(crate) fn planned(
    predictor: &Predictor,
    recordings: &[Recording],
    firsts: &[InitialValues],
    targets: usize,
    lost_after_s: f64,
) -> Plan {
    let mut plan = Plan::default();
    let find = |marker| predictor.find(marker).map(|(target, _)| target);
    for (flight, (recording, first)) in recordings.iter().zip(firsts).enumerate() {
        plan.add(flight, recording, first, &find, targets, lost_after_s);
    }
    plan
}

pub(crate) fn stated<'a>(
    (rig, estimator, site): (&Rig, &EstimatorConfig, &Site),
    recordings: &'a [Recording],
    plan: Plan,
    predictor: &mut Predictor,
    firsts: &[InitialValues],
) -> Problem<'a> {
    let targets = rig.target.len();
    let share = match firsts.iter().find_map(|first| first.felt) {
        Some(FeltTilt::Share(share)) => Some(share),
        _ => None,
    };
    // Any body may sway by millimetres; how far is fitted.
    let sways: Vec<bool> = (0..targets).map(|target| predictor.moves(target)).collect();
    sways.iter().enumerate().for_each(|(target, sways)| predictor.set_sways(target, *sways));
    let shake = shake_of(firsts);
    predictor.set_shakes(shake.map(|shake| shake.1));
    let shakes = shake.is_some();
    let wanders = firsts.iter().map(|first| first.wanders).fold(1.0, f64::max);
    let seen = plan.stops.iter().filter(|stop| stop.held.contains(&true)).count();
    let blind = (seen as f64) < BLIND * plan.stops.len() as f64;
    let mut priors = priors(rig, predictor, share, blind);
    for prior in &mut priors {
        firsts.iter().for_each(|first| prior.widen_by(&first.wrong));
    }
    let reading = predictor.tilt_error();
    let control_points = control_points(rig, predictor, &site.frame, recordings, &priors);
    let places = places(predictor, &sways, shakes, &priors);
    let heights = sways.iter().enumerate().map(|(t, sways)| sways.then(|| predictor.markers_height_m(t)));
    let sways = heights.collect();
    let best_fix = recordings.iter().flat_map(|r| &r.epochs).map(|e| e.value.fix).max();
    let (vars, tau_s) = predictor.gps_bias(best_fix.unwrap_or(FixKind::ThreeD));
    let shape = Shape {
        knot: knot::target(targets),
        landmarks: plan.places,
        shake: if shakes { SHAKE_COLUMNS } else { 0 },
        constants: priors.len(),
    };
    Problem {
        recordings,
        control_points,
        dropped: vec![false; plan.landmarks],
        plan,
        shape,
        outside_places: outside_places(&places),
        places,
        priors,
        targets,
        sways,
        moves: (0..targets).map(|target| predictor.moves(target)).collect(),
        processes: Processes {
            gust_tau_s: estimator.force_tau_s,
            thrust_tau_s: THRUST_TAU_S,
            // Motion must not explain the reading's slow error either: it is considered, not estimated.
            tilt_error: if blind { (HELD_TILT_ERROR.powi(2), reading.1) } else { reading },
            gps_bias: (vars.map(|var| var * wanders.powi(2)), tau_s),
            slip_q: predictor.slip_q(),
        },
        considered_tilt_var: if blind { reading.0 } else { 0.0 },
        camera_at: rig.camera.mount.position(),
        gates: GATES,
        segment_len: SEGMENT,
    }
}

pub(crate) fn first_values(
    problem: &Problem<'_>,
    firsts: &[InitialValues],
    predictor: &Predictor,
    rig: &Rig,
    site: &Site,
) -> Values {
    let stops = &problem.plan.stops;
    let mut knots: Vec<Knot> =
        stops.iter().map(|stop| firsts[stop.flight].knot_at(stop.t, problem.targets)).collect();
    for target in 0..problem.targets {
        for (stop, knot) in stops.iter().zip(&mut knots).filter(|(stop, _)| stop.held[target]) {
            let at = knot::target(target);
            let mean = target_at(&firsts[stop.flight].targets[target], stop.t, predictor.reference_m(target));
            match mean {
                Some(mean) => knot.x[at..at + 5].copy_from_slice(&mean),
                // Never tracked: below the helicopter.
                None => knot.x.copy_within(0..2, at),
            }
        }
    }
    let mut values = Values {
        knots,
        landmarks: vec![[0.0; 2]; problem.plan.landmarks],
        constants: problem.priors.iter().map(|prior| prior.mean).collect(),
        shakes: if problem.shape.shake > 0 { vec![[0.0; SHAKE_COLUMNS]; stops.len()] } else { Vec::new() },
    };
    place_landmarks(problem, rig, site, &mut values);
    values
}

/// A target's mean at a time, between its estimates.
fn target_at(track: &[TargetEstimate], t: MonoTime, reference_m: f64) -> Option<[f64; 5]> {
    let mean = |e: &TargetEstimate| {
        e.state.map(|s| {
            let (sin, cos) = s.heading_rad.sin_cos();
            let (north, east) = (s.north_m - reference_m * cos, s.east_m - reference_m * sin);
            [north, east, s.heading_rad, s.speed_mps, s.yaw_rate_radps]
        })
    };
    let after = track.partition_point(|e| e.t_valid < t).min(track.len().checked_sub(1)?);
    let (a, b) = (&track[after.saturating_sub(1)], &track[after]);
    let (from, mut to) = (mean(a)?, mean(b)?);
    to[2] = from[2] + wrap_angle(to[2] - from[2]);
    let whole = (b.t_valid - a.t_valid).s();
    let share = if whole > 0.0 { ((t - a.t_valid).s() / whole).clamp(0.0, 1.0) } else { 1.0 };
    Some(std::array::from_fn(|i| from[i] + (to[i] - from[i]) * share))
}

/// Initial landmarks, from the detection in the middle of their life.
fn place_landmarks(problem: &Problem<'_>, rig: &Rig, site: &Site, values: &mut Values) {
    let mut sightings: Vec<Vec<(usize, usize)>> = vec![Vec::new(); problem.plan.landmarks];
    for (k, stop) in problem.plan.stops.iter().enumerate() {
        stop.features.iter().for_each(|seen| sightings[seen.landmark].push((k, seen.index)));
    }
    let body_from_camera = rig.camera.mount.body_from_camera();
    for (landmark, seen) in sightings.iter().enumerate() {
        let Some(&(k, index)) = seen.get(seen.len() / 2) else { continue };
        let (stop, state) = (&problem.plan.stops[k], &values.knots[k]);
        let Some(frame) = stop.frame else { continue };
        let px = problem.recordings[stop.flight].frames[frame].value.features[index].px;
        let attitude: Rotation3<f64> = state.attitude;
        let camera: Vector3<f64> = state.three(knot::POSITION) + attitude * problem.camera_at;
        let turned = attitude * body_from_camera;
        let found = locate(&rig.camera.intrinsics, &camera, &turned, px, &site.ground, 0.0, 1e4);
        let place = found.map_or(state.three(knot::POSITION), |point| point.ned_m);
        values.landmarks[landmark] = [place.x, place.y];
    }
}

/// Drops landmarks that were too often outside the gate; returns how many.
fn drop_movers(problem: &mut Problem<'_>, looked: &PassResult) -> usize {
    let [seen, outside] =
        looked.landmarks.iter().fold([0; 2], |[all, out], (seen, outside)| [all + seen, out + outside]);
    // Where everything moves, it is the noise that is not known yet.
    if outside as f64 > MOST_MOVE * seen as f64 {
        return 0;
    }
    let mut more = 0;
    for (dropped, (seen, outside)) in problem.dropped.iter_mut().zip(&looked.landmarks) {
        let moves = *outside as f64 > MOVING * *seen as f64;
        more += usize::from(moves && !*dropped);
        *dropped |= moves;
    }
    more
}

/// Widens the priors of constants that turned out to be configured wrongly; returns how many.
///
/// A camera that is late makes fixes and readings early, both by as much.
fn widen(problem: &mut Problem<'_>, values: &Values) -> usize {
    let priors = problem.priors.iter_mut().zip(&values.constants);
    let widened: usize = priors.map(|(prior, value)| usize::from(prior.widen(*value))).sum();
    let camera = &mut problem.priors[constant::CAMERA_DELAY];
    let early = [constant::GPS_DELAY, constant::COMPASS_DELAY].map(|delay| -values.constants[delay]);
    widened + usize::from(camera.widen(camera.mean + early[0].min(early[1]).max(0.0)))
}

impl Refined {
    fn finish(
        &mut self,
        problem: &Problem<'_>,
        firsts: &[InitialValues],
        felt: Option<FeltTilt>,
        inflation: f64,
    ) {
        self.clocks.iter_mut().for_each(|clock| clock.sigma_s *= inflation.sqrt());
        for (constant, prior) in self.constants.iter_mut().zip(&problem.priors) {
            if prior.is_estimated() {
                constant.sigma = (constant.sigma * inflation.sqrt()).min(prior.sigma);
            }
        }
        self.outliers.sort_by(|a, b| b.ratio.total_cmp(&a.ratio));
        self.outliers.truncate(NAMED);
        self.felt = felt;
        let dropped = problem.dropped.iter().filter(|dropped| **dropped).count();
        self.features = (problem.dropped.len() - dropped, dropped);
        let begins = problem.plan.stops.iter().filter(|stop| stop.begins).map(|stop| (stop.flight, stop.t));
        self.begins = begins.collect();
        self.resets = firsts.iter().flat_map(|first| first.resets.clone()).collect();
    }
}
