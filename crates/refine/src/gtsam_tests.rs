//! The solver against GTSAM, on the same linear problem: solution and sigmas.
//!
//! The least-squares problem at its solution, whitened and with its robust weights, is handed to GTSAM (`tests/gtsam`), which
//! eliminates it by orthogonal transformations.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use windhover_base::settings::EstimatorConfig;
use windhover_estimate::batch::Predictor;

use crate::block::{Block, Loss, Noise};
use crate::front::{Back, Front};
use crate::initial::filtered;
use crate::jacobians::flown;
use crate::noise::first as first_noise;
use crate::problem::{Origin, Pass, Problem};
use crate::refine::{first_values, planned, stated};
use crate::solve::{EliminatedKind, LANDMARK, factorise, solve};
use crate::values::Values;

/// Largest difference of a sigma, and of the solution in sigmas.
const AGREES: f64 = 0.02;

/// Key and width of a column's variable, and its place there: knots, then landmarks, then the constants.
fn variable(problem: &Problem<'_>, k: usize, column: usize) -> (usize, usize, usize) {
    let (shape, knots) = (problem.shape, problem.plan.stops.len());
    if column >= shape.constants_at() {
        return (knots + problem.plan.landmarks, shape.constants, column - shape.constants_at());
    }
    if column >= 2 * shape.knot {
        let place = (column - 2 * shape.knot) / 2;
        let open = problem.plan.stops[k].features.iter().find(|seen| seen.place == place);
        return (knots + open.expect("it is in view").landmark, 2, (column - 2 * shape.knot) % 2);
    }
    let which = if column / shape.knot == k % 2 { k } else { k + 1 };
    (which, shape.knot, column % shape.knot)
}

/// Sigmas of every unknown, by the keys of the variables.
type Sigmas = BTreeMap<usize, Vec<f64>>;

/// One factor as a line of text, with every unknown in units of its sigma: GTSAM refuses what is scaled otherwise.
fn factor(
    text: &mut String,
    (problem, sigmas): (&Problem<'_>, &Sigmas),
    k: usize,
    block: &Block,
    weight: f64,
) {
    let (width, by) = (block.columns.len(), weight.sqrt());
    let places: Vec<_> = block.columns.iter().map(|column| variable(problem, k, *column)).collect();
    let mut keys: Vec<(usize, usize)> = places.iter().map(|(key, len, _)| (*key, *len)).collect();
    keys.sort_unstable();
    keys.dedup();
    text.push_str(&format!("factor {} {}", block.len(), keys.len()));
    keys.iter().for_each(|(key, len)| text.push_str(&format!(" {key} {len}")));
    for (key, len) in &keys {
        let mut matrix = vec![0.0; block.len() * len];
        for (row, values) in block.rows.chunks_exact(width).enumerate() {
            for ((of, _, place), value) in places.iter().zip(values).filter(|((of, ..), _)| of == key) {
                debug_assert_eq!(of, key);
                matrix[row * len + place] += by * value * sigmas[key][*place];
            }
        }
        matrix.iter().for_each(|x| text.push_str(&format!(" {x:e}")));
    }
    block.right.iter().for_each(|x| text.push_str(&format!(" {:e}", by * x)));
    text.push('\n');
}

/// A prior of single unknowns, from the diagonal of a front that has nothing else.
fn prior(
    text: &mut String,
    of: (&Problem<'_>, &Sigmas),
    k: usize,
    front: &Front,
    columns: std::ops::Range<usize>,
) {
    for column in columns {
        let (information, right) = front.alone(column);
        if information > 0.0 {
            let sigma = information.sqrt();
            let block = Block { columns: vec![column], rows: vec![sigma], right: vec![right / sigma] };
            factor(text, of, k, &block, 1.0);
        }
    }
}

/// Every factor of the problem.
fn factors(pass: &mut Pass<'_>, values: &Values, noise: &Noise, sigmas: &Sigmas) -> String {
    let (problem, mut text) = (pass.problem, String::new());
    let of = (problem, sigmas);
    let shape = problem.shape;
    pass.begin(values);
    let mut front = Front::new(shape);
    pass.constants(values, &mut front);
    prior(&mut text, of, 0, &front, shape.constants_at()..shape.len());
    for (k, stop) in problem.plan.stops.iter().enumerate() {
        let mut front = Front::new(shape);
        pass.beginnings(k, values, noise, &mut front);
        let at = shape.knot_at(k);
        prior(&mut text, of, k, &front, at..at + shape.knot);
        for (place, _) in &stop.closes {
            let mut front = Front::new(shape);
            let first = shape.landmark_at(*place);
            (0..2).for_each(|i| front.hold(first + i, LANDMARK));
            prior(&mut text, of, k, &front, first..first + 2);
        }
        pass.blocks(k, values, noise, &mut |origin: Origin, block: &Block| {
            let gate = problem.gates[block.len()];
            let weight =
                if origin.source.is_measured() { Loss::of(block.square(), gate).weight } else { 1.0 };
            factor(&mut text, of, k, block, weight);
        });
    }
    text
}

/// A Python with GTSAM; `None` where there is none.
fn python() -> Option<PathBuf> {
    let ours = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../target/venv-gtsam/bin/python");
    [ours, PathBuf::from("python3")].into_iter().find(|python| {
        let has = Command::new(python).args(["-c", "import gtsam"]).stderr(Stdio::null()).status();
        has.is_ok_and(|status| status.success())
    })
}

#[test]
#[ignore = "needs GTSAM's Python package"]
fn proof_gtsam_agrees() {
    let Some(python) = python() else {
        println!("skipped: no Python with gtsam (pip install gtsam)");
        return;
    };
    let (world, site, recording) = flown("follow", 4.0);
    let (rig, config) = (world.scenario().rig.clone(), EstimatorConfig::default());
    let recordings = [recording];
    let firsts = [filtered(&rig, &config, &site, &recordings[0])];
    let mut predictor = Predictor::new(&rig, &config, &site);
    let plan = planned(&predictor, &recordings, &firsts, rig.target.len(), 30.0);
    let problem = stated((&rig, &config, &site), &recordings, plan, &mut predictor, &firsts);
    let mut values = first_values(&problem, &firsts, &predictor, &rig, &site);
    let noise = first_noise(problem.targets, config.side_force_mps2, config.thrust_mps2, None);
    let mut pass = Pass::new(&problem, predictor);
    solve(&mut pass, &mut values, &noise, 10.0, &mut |_| true).expect("a flight");
    let solved = factorise(&mut pass, &values, &noise, 0.0, &mut |_| true).expect("a flight");
    let knots = problem.plan.stops.len();
    let (mut back, mut sigmas, mut solution) = (Back::new(problem.shape), Sigmas::new(), Sigmas::new());
    let steps = solved.segment(0, &mut pass, &values, &noise).expect("it was solved");
    for (what, e) in steps.iter().rev() {
        back.solve_with_covariance(e);
        let key = match what {
            EliminatedKind::Knot(k) => *k,
            EliminatedKind::Landmark(landmark) => knots + landmark,
            EliminatedKind::Shake(_) => continue,
            EliminatedKind::Constants => knots + problem.plan.landmarks,
        };
        sigmas.insert(key, e.range().map(|column| back.covariance(column, column).sqrt()).collect());
        solution.insert(key, back.x[e.range()].to_vec());
    }
    let mut text = factors(&mut pass, &values, &noise, &sigmas);
    let wanted: Vec<usize> = (0..knots).step_by(5).chain([knots + problem.plan.landmarks]).collect();
    wanted.iter().for_each(|key| text.push_str(&format!("wanted {key}\n")));
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/gtsam/compare.py");
    let mut child = Command::new(python)
        .arg(script)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("it was there");
    child.stdin.take().expect("piped").write_all(text.as_bytes()).expect("it reads");
    let output = child.wait_with_output().expect("it ends");
    assert!(output.status.success());
    let answer = String::from_utf8(output.stdout).expect("numbers");
    let numbers =
        |line: &str| -> Vec<f64> { line.split(' ').map(|x| x.parse().expect("a number")).collect() };
    let lines: Vec<Vec<f64>> = answer.lines().map(numbers).collect();
    let (mut worst, mut compared) = ([0.0f64; 2], 0);
    for (key, other) in wanted.iter().zip(lines.chunks_exact(2)) {
        for (i, (x, sigma)) in solution[key].iter().zip(&sigmas[key]).enumerate() {
            worst[0] = worst[0].max((other[1][i] - 1.0).abs());
            worst[1] = worst[1].max((x / sigma - other[0][i]).abs());
            compared += 1;
        }
    }
    println!("{compared} unknowns: sigmas within {:.1e}, solution within {:.1e} sigmas", worst[0], worst[1]);
    assert!(compared > 100 && worst.iter().all(|worst| *worst < AGREES), "{worst:?}");
}
