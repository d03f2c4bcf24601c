//! Every row of the least-squares problem against central differences of its residual, at randomly changed states of a
//! simulated flight.

use std::sync::Arc;

use nalgebra::Rotation3;
use windhover_base::geo::Ground;
use windhover_base::msg::Stamped;
use windhover_base::settings::EstimatorConfig;
use windhover_estimate::Site;
use windhover_estimate::batch::Predictor;
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

use crate::block::{Block, Noise, Source};
use crate::initial::filtered;
use crate::problem::{Origin, Pass, Problem};
use crate::recording::Recording;
use crate::refine::{first_values, planned, stated};
use crate::unknowns::knot;
use crate::values::Values;

/// Step of the differences, in each unknown's own unit.
const STEP: f64 = 1e-5;
/// Knots that are checked.
const KNOTS: [usize; 2] = [20, 31];

pub(crate) fn flown(name: &str, seconds: f64) -> (World, Site, Recording) {
    let mut scenario = Scenario::named(name).expect("a named scenario");
    scenario.duration_s = seconds;
    let declination_rad = scenario.declination_deg.to_radians();
    let world = Arc::new(World::new(scenario, 3));
    let site = Site { frame: *world.frame(), ground: Ground::Flat { down_m: 0.0 }, declination_rad };
    let (mut suite, mut recording) = (SensorSuite::new(Arc::clone(&world)), Recording::default());
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
    drop(suite);
    (Arc::into_inner(world).expect("no other owner"), site, recording)
}

/// The residuals of each block of a knot.
fn left_over(pass: &mut Pass<'_>, k: usize, values: &Values, noise: &Noise) -> Vec<(Origin, Block)> {
    let mut all = Vec::new();
    pass.begin(values);
    pass.blocks(k, values, noise, &mut |origin, block| all.push((origin, block.clone())));
    all
}

/// Changes one unknown of the front that is open at knot `k`.
fn moved(problem: &Problem<'_>, values: &Values, k: usize, column: usize, by: f64) -> Values {
    let (mut values, shape) = (values.clone(), problem.shape);
    if column >= shape.constants_at() {
        values.constants[column - shape.constants_at()] += by;
    } else if column >= shape.shake_at() {
        values.shakes[k][column - shape.shake_at()] += by;
    } else if column >= 2 * shape.knot {
        let place = (column - 2 * shape.knot) / 2;
        let open = problem.plan.stops[k].features.iter().find(|seen| seen.place == place);
        if let Some(seen) = open {
            values.landmarks[seen.landmark][column % 2] += by;
        }
    } else {
        let which = if column / shape.knot == k % 2 { k } else { k + 1 };
        let mut dx = vec![0.0; shape.knot];
        dx[column % shape.knot] = by;
        values.knots[which].step(&dx);
    }
    values
}

#[test]
fn rows_are_the_derivatives_of_what_is_left_over() {
    let (world, site, recording) = flown("two-vehicles", 3.0);
    let (mut rig, config) = (world.scenario().rig.clone(), EstimatorConfig::default());
    rig.camera.readout_ms = 25.0;
    let recordings = [recording];
    let mut firsts = [filtered(&rig, &config, &site, &recordings[0])];
    let mut predictor = Predictor::new(&rig, &config, &site);
    let plan = planned(&predictor, &recordings, &firsts, rig.target.len(), 30.0);
    (firsts[0].sways[0], firsts[0].shake) = (true, Some(([1e-3; 2], 0.025)));
    let problem = stated((&rig, &config, &site), &recordings, plan, &mut predictor, &firsts);
    let mut values = first_values(&problem, &firsts, &predictor, &rig, &site);
    let mut seed = 5u64;
    let mut random = move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as f64 / f64::from(1u32 << 30) - 1.0
    };
    for state in &mut values.knots {
        state.attitude = Rotation3::from_euler_angles(0.01 * random(), 0.01 * random(), 0.0) * state.attitude;
        (knot::RATE..state.x.len()).for_each(|i| state.x[i] += 0.05 * random());
    }
    values.shakes.iter_mut().flatten().for_each(|x| *x += 1e-3 * random());
    for (prior, value) in problem.priors.iter().zip(&mut values.constants) {
        *value += 0.3 * prior.sigma * random();
    }
    let noise = Noise::new(problem.targets);
    let mut pass = Pass::new(&problem, predictor.clone());
    let mut checked = 0;
    for k in KNOTS {
        let blocks = left_over(&mut pass, k, &values, &noise);
        for column in 0..problem.shape.len() {
            let constant = column.checked_sub(problem.shape.constants_at());
            if constant.is_some_and(|i| !problem.priors[i].is_estimated()) {
                continue;
            }
            let more = left_over(&mut pass, k, &moved(&problem, &values, k, column, STEP), &noise);
            let less = left_over(&mut pass, k, &moved(&problem, &values, k, column, -STEP), &noise);
            for (((origin, block), (_, more)), (_, less)) in blocks.iter().zip(&more).zip(&less) {
                let place = block.columns.iter().position(|c| *c == column);
                for row in 0..block.len() {
                    let got = place.map_or(0.0, |_| {
                        let width = block.columns.len();
                        let of_row = &block.rows[row * width..][..width];
                        let same = block.columns.iter().zip(of_row).filter(|(c, _)| **c == column);
                        same.map(|(_, x)| x).sum()
                    });
                    let wanted = (less.right[row] - more.right[row]) / (2.0 * STEP);
                    let allowed = allowed(origin.source, column, &problem, wanted);
                    assert!(
                        (got - wanted).abs() <= allowed,
                        "{:?}, knot {k}, row {row}, column {column}: {got} by the model, {wanted} by differences",
                        origin.source
                    );
                    checked += usize::from(wanted != 0.0);
                }
            }
        }
    }
    assert!(checked > 2_000, "{checked} derivatives were checked");
}

/// Tolerance of a whitened row: a share of the derivative, and the effect of a sigma of the unknown.
fn allowed(source: Source, column: usize, problem: &Problem<'_>, wanted: f64) -> f64 {
    let (share, of_sigma) = match source {
        // How far the camera is turned on its mount already is left out.
        Source::Marker(_) | Source::Feature => (0.01, 0.1),
        // The delay's effect within a fix is left out.
        Source::GpsPosition | Source::GpsVelocity => (0.03, 0.1),
        _ => (0.01, 0.01),
    };
    let constant = column.checked_sub(problem.shape.constants_at());
    let sigma = constant.map_or(0.02, |i| problem.priors[i].sigma);
    of_sigma / sigma.max(1e-3) + share * wanted.abs()
}
