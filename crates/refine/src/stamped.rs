//! Estimates at the stamps of frames.
//!
//! A knot is at the exposure of its frame, which is earlier than the stamp by the camera's delay τ. The state at the stamp is
//! `y = x + τ ẋ + ½ τ² ẍ`, and its error `δy = A δx + ẏ δτ`, with the unknowns on which `ẋ` depends in A. So how well τ is known is
//! part of the covariance: absolute time is known by the configured latencies only.

use nalgebra::SMatrix;

use crate::front::Back;
use crate::motion::Pushed;
use crate::problem::Problem;
use crate::unknowns::{Place, constant, knot};
use crate::values::Knot;

/// Rows of a linear function of the unknowns of a front: column and value of each term.
struct Sparse<const N: usize>([Vec<(usize, f64)>; N]);

impl<const N: usize> Sparse<N> {
    /// The unknowns from `at` on themselves.
    fn of(at: usize) -> Self {
        Self(std::array::from_fn(|i| vec![(at + i, 1.0)]))
    }

    fn add(&mut self, row: usize, column: usize, value: f64) {
        self.0[row].push((column, value));
    }

    fn covariance(&self, back: &Back) -> SMatrix<f64, N, N> {
        let product = |a: &[(usize, f64)], b: &[(usize, f64)]| -> f64 {
            a.iter().map(|(i, x)| b.iter().map(|(j, y)| x * y * back.covariance(*i, *j)).sum::<f64>()).sum()
        };
        SMatrix::from_fn(|i, j| product(&self.0[i.min(j)], &self.0[i.max(j)]))
    }
}

/// The column of the camera's delay, where it is estimated.
fn of_delay(problem: &Problem<'_>) -> Option<usize> {
    let estimated = problem.priors[constant::CAMERA_DELAY].is_estimated();
    estimated.then(|| problem.shape.constants_at() + constant::CAMERA_DELAY)
}

/// Covariance of position, velocity and attitude of the helicopter (NED; m, m/s, rad) at the stamp of knot `k`, which is `late_s`
/// after it, where `state` is.
pub(crate) fn own_covariance(
    problem: &Problem<'_>,
    (k, late_s): (usize, f64),
    state: &Knot,
    pushed: &Pushed,
    back: &Back,
) -> SMatrix<f64, 9, 9> {
    let at = problem.shape.knot_at(k);
    let mut rows = Sparse::<9>::of(at);
    let turn = state.attitude.matrix();
    let turning = turn * state.three(knot::RATE);
    for i in 0..3 {
        rows.add(i, at + knot::VELOCITY + i, late_s);
        for j in 0..3 {
            rows.add(knot::ATTITUDE + i, at + knot::RATE + j, turn[(i, j)] * late_s);
            rows.add(knot::ATTITUDE + i, at + knot::SPIN + j, 0.5 * turn[(i, j)] * late_s * late_s);
        }
        for (column, by) in &pushed.1 {
            let column = match problem.places[*column] {
                Place::Knot(place) => at + place,
                Place::Constant(place) => problem.shape.constants_at() + place,
                Place::Landmark(_) | Place::Shake(_) | Place::Known(_) | Place::Nowhere => continue,
            };
            rows.add(knot::VELOCITY + i, column, by[i] * late_s);
        }
        if let Some(delay) = of_delay(problem) {
            rows.add(knot::POSITION + i, delay, state.x[knot::VELOCITY + i]);
            rows.add(knot::VELOCITY + i, delay, pushed.0[i]);
            rows.add(knot::ATTITUDE + i, delay, turning[i]);
        }
    }
    rows.covariance(back)
}

/// Covariance of a target's north, east (m), heading (rad), speed (m/s) and yaw rate (rad/s), likewise.
pub(crate) fn target_covariance(
    problem: &Problem<'_>,
    (k, late_s): (usize, f64),
    state: &Knot,
    target: usize,
    back: &Back,
) -> SMatrix<f64, 5, 5> {
    let at = problem.shape.knot_at(k) + knot::target(target);
    let mut rows = Sparse::<5>::of(at);
    let heading = state.target(target)[knot::HEADING];
    let speed = state.target(target)[knot::SPEED];
    let (s, c) = heading.sin_cos();
    let moves = [
        (0, knot::SPEED, c),
        (1, knot::SPEED, s),
        (0, knot::HEADING, -speed * s),
        (1, knot::HEADING, speed * c),
        (knot::HEADING, knot::YAW_RATE, 1.0),
        (knot::SPEED, knot::ACCELERATION, 1.0),
        (knot::YAW_RATE, knot::YAW_ACCELERATION, 1.0),
    ];
    moves.into_iter().for_each(|(row, column, by)| rows.add(row, at + column, by * late_s));
    let jerks = [
        (knot::SPEED, knot::JERK),
        (knot::YAW_RATE, knot::YAW_JERK),
        (knot::HEADING, knot::YAW_ACCELERATION),
    ];
    jerks.into_iter().for_each(|(row, column)| rows.add(row, at + column, 0.5 * late_s * late_s));
    if let Some(delay) = of_delay(problem) {
        let flow = state.target_flow(target);
        flow.into_iter().enumerate().for_each(|(row, flow)| rows.add(row, delay, flow));
    }
    rows.covariance(back)
}
