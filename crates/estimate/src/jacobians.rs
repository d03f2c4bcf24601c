//! Every F and H of the filter against central finite differences at random states.
//!
//! What the linear model leaves out on purpose is listed here term by term with a bound on its size
//! ([`Omitted`]); a derivative that differs anywhere else, or by more than the bound, fails. Seeds are the
//! loop's own numbers and stand in every message.

use nalgebra::{DMatrix, Matrix2, Rotation3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use windhover_base::geo::{Ground, Tilt};
use windhover_base::msg::{AttitudeSample, FixKind, GnssEpoch, MarkerDetection};
use windhover_base::time::Span;

use super::aid::feature::FeaturePixel;
use super::aid::pixel::{target_point, view};
use super::aid::rate::Rate;
use super::aid::specific_force::SpecificForce;
use super::aid::tilt::TiltReading;
use super::aid::{compass, gnss};
use super::blocks::{Block, own};
use super::core::Core;
use super::kind::Felt;
use super::update::Held;

use scene::{difference, most, moved, random_core, slope, with_every_sensor};

mod scene;
mod updates;

/// Random states each derivative is taken at.
const STATES: u64 = 40;
/// Step of the differences, in each state's own unit.
const STEP: f64 = 1e-4;

/// Columns in which a derivative is left out, and the most that any of their entries is.
struct Omitted {
    term: &'static str,
    columns: std::ops::Range<usize>,
    /// Rows likewise: of a measurement all.
    rows: std::ops::Range<usize>,
    at_most: f64,
}

const ALL_ROWS: std::ops::Range<usize> = 0..usize::MAX;

/// Holds a linear model against differences: `got` rows by state columns.
fn compare(
    what: &str,
    seed: u64,
    got: &DMatrix<f64>,
    wanted: &DMatrix<f64>,
    omitted: &[Omitted],
    tolerance: f64,
) {
    for ((row, column), value) in (0..got.nrows())
        .flat_map(|r| (0..got.ncols()).map(move |c| (r, c)))
        .map(|place| (place, got[place] - wanted[place]))
    {
        let term = omitted.iter().find(|o| o.columns.contains(&column) && o.rows.contains(&row));
        let scale = 1.0 + wanted[(row, column)].abs();
        let allowed = term.map_or(tolerance * scale, |o| o.at_most);
        assert!(
            value.abs() <= allowed,
            "{what}, seed {seed}: row {row}, column {column}: {} by the model, {} by differences{}",
            got[(row, column)],
            wanted[(row, column)],
            term.map_or(String::new(), |o| format!(" ({}, at most {})", o.term, o.at_most)),
        );
    }
}

/// F of one step of `dt` seconds, read off what it does to the covariance of a delayed copy with the present state: to
/// each row `e_j` of the copy's it applies `Fᵀ`.
fn transition(core: &Core, dt_s: f64) -> DMatrix<f64> {
    let n = core.state.layout().len();
    let mut state = core.state.clone();
    let rows = state.copies[0].cross.rows();
    let mut f = DMatrix::zeros(n, n);
    for first in (0..n).step_by(rows) {
        state.copy_from(&core.state);
        let copy = &mut state.copies[0];
        copy.in_use = true;
        copy.cross.fill(0.0);
        (0..rows.min(n - first)).for_each(|i| copy.cross.set(i, first + i, 1.0));
        state.propagate(state.t + Span::from_s(dt_s), &core.models);
        for i in 0..rows.min(n - first) {
            for (row, value) in state.copies[0].cross.row(i).iter().enumerate() {
                f[(row, first + i)] = *value;
            }
        }
    }
    f
}

fn transition_by_differences(core: &Core, dt_s: f64) -> DMatrix<f64> {
    let n = core.state.layout().len();
    let mut f = DMatrix::zeros(n, n);
    for column in 0..n {
        let after = |by: f64| {
            let mut core = moved(core, column, by);
            let t = core.state.t + Span::from_s(dt_s);
            core.state.propagate(t, &core.models);
            core.state
        };
        let change = difference(&after(STEP), &after(-STEP));
        (0..n).for_each(|row| f[(row, column)] = change[row] / (2.0 * STEP));
    }
    f
}

#[test]
fn motion_of_helicopter_targets_and_features() {
    // R exp(ω dt) moves by R J_r(ω dt) dω dt; the right Jacobian J_r is taken as one.
    let right_jacobian = Omitted {
        term: "right Jacobian of the turn in a step",
        rows: own::ATTITUDE.range(),
        columns: own::RATE.range(),
        at_most: 0.5 * most::RATE * most::DT * most::DT,
    };
    for seed in 0..STATES {
        let core = random_core(seed, Ground::Flat { down_m: 0.0 });
        for dt_s in [0.01, 0.05] {
            let (f, wanted) = (transition(&core, dt_s), transition_by_differences(&core, dt_s));
            compare("motion", seed, &f, &wanted, std::slice::from_ref(&right_jacobian), 1e-6);
        }
    }
}

#[test]
fn covariance_and_delayed_copies_move_by_the_same_f() {
    for seed in 0..STATES {
        let mut core = random_core(seed, Ground::Flat { down_m: 0.0 });
        let (n, dt_s) = (core.state.layout().len(), 0.04);
        let f = transition(&core, dt_s);
        let after = |core: &Core| {
            let mut state = core.state.clone();
            state.propagate(state.t + Span::from_s(dt_s), &core.models);
            DMatrix::from_fn(n, n, |i, j| state.cov.at(i, j))
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1_000 + seed);
        let root = DMatrix::from_fn(n, n, |_, _| rng.random_range(-0.3..0.3));
        let p = &root * root.transpose();
        // A car's yaw rate walks as the variance of its speed allows: a rover's does with and without P.
        core.models.targets[0].motion = core.models.targets[1].motion.clone();
        let noise = after(&core);
        (0..n).for_each(|i| (0..n).for_each(|j| core.state.cov.set(i, j, p[(i, j)])));
        compare("covariance", seed, &(after(&core) - noise), &(&f * p * f.transpose()), &[], 1e-9);
    }
}

/// A measurement's H and residual: what stands in the workspace after it was fused.
fn measured(core: &mut Core, fuse: &dyn Fn(&mut Core)) -> (DMatrix<f64>, Vec<f64>) {
    fuse(core);
    let (n, z) = (core.state.layout().len(), &core.z);
    let h = DMatrix::from_fn(z.m, n, |component, column| z.derivative(component, column));
    (h, z.residual[..z.m].to_vec())
}

fn check_measurement(what: &str, seed: u64, core: &Core, omitted: &[Omitted], fuse: &dyn Fn(&mut Core)) {
    let (h, residual) = measured(&mut core.clone(), fuse);
    assert!(!residual.is_empty(), "{what}, seed {seed}: nothing was fused");
    let mut wanted = DMatrix::zeros(residual.len(), core.state.layout().len());
    for column in 0..core.state.layout().len() {
        let (_, more) = measured(&mut moved(core, column, STEP), fuse);
        let (_, less) = measured(&mut moved(core, column, -STEP), fuse);
        for row in 0..residual.len() {
            // r = z − h(x)
            wanted[(row, column)] = (less[row] - more[row]) / (2.0 * STEP);
        }
    }
    compare(what, seed, &h, &wanted, omitted, 1e-5);
}

#[test]
fn gps_position() {
    use most::{ARM, DELAY_S, DRAG, FORCE, RATE, SPEED};
    // Of −v_a τ + ½ a τ² only what the position of a fix is worth: the rest is centimetres beside its metres.
    let half_tau2 = 0.5 * DELAY_S * DELAY_S;
    let omitted = [
        Omitted {
            term: "½ τ² ∂a/∂v",
            columns: own::VELOCITY.range(),
            rows: ALL_ROWS,
            at_most: half_tau2 * DRAG,
        },
        Omitted {
            term: "τ and ½ τ² of attitude",
            columns: own::ATTITUDE.range(),
            rows: ALL_ROWS,
            at_most: DELAY_S * RATE * ARM + half_tau2 * FORCE,
        },
        Omitted { term: "τ R l×", columns: own::RATE.range(), rows: ALL_ROWS, at_most: DELAY_S * ARM },
        Omitted {
            term: "½ τ² of gusts and thrust",
            columns: own::GUST.column(0)..own::THRUST.end(),
            rows: ALL_ROWS,
            at_most: 1.1 * half_tau2,
        },
        Omitted {
            term: "½ τ² of the wind", columns: own::WIND.range(), rows: ALL_ROWS, at_most: half_tau2
        },
        Omitted {
            term: "½ τ² of the trim",
            columns: own::TRIM.range(),
            rows: ALL_ROWS,
            at_most: half_tau2 * FORCE,
        },
        Omitted { term: "½ τ² v", columns: own::DRAG.range(), rows: ALL_ROWS, at_most: half_tau2 * SPEED },
    ];
    let epoch = GnssEpoch {
        fix: FixKind::ThreeD,
        lat_deg: Some(47.0),
        lon_deg: Some(8.0),
        alt_msl_m: Some(10.0),
        geoid_m: Some(0.0),
        ..GnssEpoch::default()
    };
    for seed in 0..STATES {
        let core = random_core(seed, Ground::Flat { down_m: 0.0 });
        check_measurement("GPS position", seed, &core, &omitted, &|core| gnss::fuse(core, &epoch));
    }
}

#[test]
fn gps_velocity() {
    let epoch = GnssEpoch {
        fix: FixKind::ThreeD,
        vel_ned_mps: Some(Vector3::new(1.0, 2.0, 0.5)),
        vel_has_down: true,
        ..GnssEpoch::default()
    };
    // Of the jerk, which the filter has only what the helicopter's turning and the delays make of, to second order in them.
    let second = 2.5 * most::DELAY_S * most::DELAY_S;
    let jerk = most::FORCE * most::RATE * second;
    let left_out = |columns, at_most| Omitted { term: "jerk", columns, rows: ALL_ROWS, at_most };
    let omitted = [
        left_out(own::ATTITUDE.range(), 3.0 * jerk),
        left_out(own::THRUST.range(), most::RATE * second),
        left_out(own::TRIM.range(), 3.0 * jerk),
    ];
    for seed in 0..STATES {
        let core = random_core(seed, Ground::Flat { down_m: 0.0 });
        check_measurement("GPS velocity", seed, &core, &omitted, &|core| gnss::fuse(core, &epoch));
    }
}

#[test]
fn compass_heading_and_tilt() {
    // Of the reading's change over the delay only what rates make of it.
    let turned = most::COMPASS_DELAY_S * most::RATE;
    let by_attitude = Omitted {
        term: "τ of attitude",
        columns: own::ATTITUDE.range(),
        rows: ALL_ROWS,
        at_most: 1.5 * turned,
    };
    let omitted = [
        Omitted {
            term: "τ of the force",
            columns: own::VELOCITY.range(),
            rows: ALL_ROWS,
            at_most: 0.2 * turned,
        },
        Omitted {
            term: "τ of the force",
            columns: own::GUST.column(0)..own::TRIM.end(),
            rows: ALL_ROWS,
            at_most: 2.0 * turned,
        },
        Omitted {
            term: "τ of the share",
            columns: own::TILT_GAIN.range(),
            rows: ALL_ROWS,
            at_most: 1.5 * turned,
        },
        Omitted { term: "τ of the drag", columns: own::DRAG.range(), rows: ALL_ROWS, at_most: 2.0 * turned },
        by_attitude,
    ];
    let tilt = Some(Tilt { pitch: 0.02, roll: -0.05 });
    for seed in 0..STATES {
        let core = random_core(seed, Ground::Flat { down_m: 0.0 });
        let heading = AttitudeSample { heading: Some(1.0), heading_is_true: true, tilt: None };
        check_measurement("heading", seed, &core, &omitted[4..], &|core| compass::fuse(core, &heading));
        let tilt = AttitudeSample { heading: None, heading_is_true: true, tilt };
        for felt in [Felt::Attitude, Felt::Force, Felt::Share] {
            let mut core = core.clone();
            core.state.tilt[0].felt = felt;
            check_measurement("tilt", seed, &core, &omitted, &|core| compass::fuse(core, &tilt));
        }
    }
}

#[test]
fn rates_forces_and_a_second_source_of_attitude() {
    for seed in 0..STATES {
        let core = with_every_sensor(random_core(seed, Ground::Flat { down_m: 0.0 }));
        check_measurement("rates", seed, &core, &[], &|core| Rate(Vector3::new(0.1, 0.2, 0.3)).fuse(core));
        let force = SpecificForce(Vector3::new(0.5, -0.3, -9.0));
        check_measurement("forces", seed, &core, &[], &|core| force.fuse(core));
        let heading = AttitudeSample { heading: Some(1.0), ..AttitudeSample::default() };
        let fuse = |core: &mut Core| compass::fuse_second(core, &heading);
        check_measurement("second heading", seed, &core, &[], &fuse);
        let tilt = Some(Tilt { pitch: 0.02, roll: -0.05 });
        let tilt = AttitudeSample { tilt, ..AttitudeSample::default() };
        let fuse = |core: &mut Core| compass::fuse_second(core, &tilt);
        check_measurement("second tilt", seed, &core, &[], &fuse);
    }
}

fn detection(core: &Core, target: usize, marker: usize) -> MarkerDetection {
    let model = &core.models.targets[target].markers[marker];
    MarkerDetection {
        marker: model.id,
        center_px: Vector2::new(640.0, 512.0),
        center_cov_px2: Matrix2::identity(),
        corners_px: model.corners.map(|_| [Vector2::new(640.0, 512.0); 4]),
        corner_cov_px2: [Matrix2::identity(); 4],
        hamming: 0,
        margin: 100.0,
        size_px: 40.0,
    }
}

#[test]
fn tag_corners_discs_and_features() {
    // Pixels per metre; the ground's slope is 8 %.
    let slope_of_a_cell = Omitted {
        term: "slope is that over a cell, not at the point",
        columns: own::LEN..usize::MAX,
        rows: ALL_ROWS,
        at_most: 1e-3,
    };
    for seed in 0..STATES {
        for (ground, omitted) in
            [(Ground::Flat { down_m: 0.0 }, &[][..]), (slope(), std::slice::from_ref(&slope_of_a_cell))]
        {
            let core = random_core(seed, ground);
            for (what, target, marker) in
                [("tag", 0, 0), ("disc", 0, 1), ("rover's tag", 1, 0), ("tag on the ground", 2, 0)]
            {
                let seen = detection(&core, target, marker);
                check_measurement(what, seed, &core, omitted, &|core| {
                    core.fuse_marker(target, marker, &seen, false);
                });
            }
            let pixel = FeaturePixel { slot: 3, px: Vector2::new(640.0, 512.0), sigma_px: 1.0, slack_m: 0.0 };
            check_measurement("feature", seed, &core, omitted, &|core| {
                pixel.fuse(core);
            });
        }
    }
}

/// Rows of a rolling shutter: how what moves changes a pixel. What the time of a row makes of how a place or a direction does
/// is left out: of 1,000 px a radian and 100 px a metre some tens and some.
#[test]
fn rows_exposed_one_after_the_other() {
    let left_out = |columns, at_most| {
        let term = "what a row's time makes of where and how a point is seen";
        Omitted { term, columns, rows: ALL_ROWS, at_most }
    };
    for seed in 0..STATES {
        let mut core = random_core(seed, Ground::Flat { down_m: 0.0 });
        (core.models.readout_s, core.state.own.readout_s) = (0.02, 0.005);
        let low = Vector2::new(640.0, 900.0);
        let (target, slot, layout) = (0, 3, core.state.layout());
        let of_pose = |seen: std::ops::Range<usize>| {
            [
                left_out(own::POSITION.range(), 5.0),
                left_out(own::ATTITUDE.range(), 60.0),
                // Some percent of what they move a pixel by themselves.
                left_out(own::LENS.range(), 60.0),
                left_out(seen, 20.0),
                left_out(layout.tag(0).all().column(0)..layout.len(), 5.0),
            ]
        };
        let mut seen = detection(&core, target, 0);
        (seen.center_px, seen.corners_px) = (low, Some([low; 4]));
        let omitted = of_pose(layout.target(target).pose().range());
        check_measurement("tag", seed, &core, &omitted, &|core| {
            core.fuse_marker(target, 0, &seen, false);
        });
        let pixel = FeaturePixel { slot, px: low, sigma_px: 1.0, slack_m: 0.0 };
        check_measurement("feature", seed, &core, &of_pose(layout.feature(slot).range()), &|core| {
            pixel.fuse(core);
        });
    }
}

/// A small turn about each axis moves attitude as `R = exp(δ) R̂` says.
#[test]
fn attitude_errors_are_turns_about_the_axes_of_ned() {
    for seed in 0..STATES {
        let core = random_core(seed, Ground::Flat { down_m: 0.0 });
        for axis in 0..3 {
            let turned = moved(&core, own::ATTITUDE.column(axis), 0.3).state.own.ned_from_body;
            let about =
                Rotation3::from_axis_angle(&nalgebra::Unit::new_normalize(Vector3::ith(axis, 1.0)), 0.3);
            let wanted = about * core.state.own.ned_from_body;
            let off = (turned.matrix() - wanted.matrix()).amax();
            assert!(off < 1e-12, "seed {seed}, axis {axis}: {off}");
        }
    }
}
