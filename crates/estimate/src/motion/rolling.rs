//! Rolling without slipping: `ẋ = v cos ψ`, `ẏ = v sin ψ`, `ψ̇ = ω`, with v and ω random walks (paper eq. 26;
//! the paper is named in `paper.rs`). What the models that roll have in common.

use nalgebra::{Matrix2, Matrix2x1};

use super::Intensities;
use crate::blocks::{TARGET, TargetBlock};
use crate::matrix::Grid;

/// Sine and cosine of the heading in the middle of a step, and the speed.
struct Course {
    sin: f64,
    cos: f64,
    speed: f64,
}

fn course(mean: &[f64; TARGET], dt: f64) -> Course {
    let [_, _, heading, speed, yaw_rate] = *mean;
    let (sin, cos) = (heading + 0.5 * yaw_rate * dt).sin_cos();
    Course { sin, cos, speed }
}

/// Carries the mean on.
pub(super) fn advance(mean: &mut [f64; TARGET], dt: f64) {
    let Course { sin, cos, speed } = course(mean, dt);
    mean[0] += speed * cos * dt;
    mean[1] += speed * sin * dt;
    mean[2] += mean[4] * dt;
}

/// `row ← row Fᵀ` for all rows of the grids.
pub(super) fn carry(
    mean: &[f64; TARGET],
    dt: f64,
    at: TargetBlock,
    grids: &mut dyn Iterator<Item = &mut Grid>,
) {
    let Course { sin, cos, speed } = course(mean, dt);
    for grid in grids {
        for i in 0..grid.rows() {
            let row = &mut grid.row_mut(i)[at.all().range()];
            let turned = dt * row[2] + 0.5 * dt * dt * row[4];
            row[0] += dt * cos * row[3] - speed * sin * turned;
            row[1] += dt * sin * row[3] + speed * cos * turned;
            row[2] += dt * row[4];
        }
    }
}

/// Adds Q: walks of speed (into the place along the course) and yaw rate (into heading), slip across.
pub(super) fn add_noise(mean: &[f64; TARGET], dt: f64, walks: Intensities, at: TargetBlock, p: &mut Grid) {
    let Course { sin, cos, .. } = course(mean, dt);
    let along = walks.speed_q * dt.powi(3) / 3.0;
    let across = walks.slip_q * dt;
    let mixed = (along - across) * cos * sin;
    p.add_square(
        at.place(),
        &Matrix2::new(
            along * cos * cos + across * sin * sin,
            mixed,
            mixed,
            along * sin * sin + across * cos * cos,
        ),
    );
    let moved = walks.speed_q * dt * dt / 2.0;
    p.add_mixed(at.place(), at.speed(), &Matrix2x1::new(moved * cos, moved * sin));
    p.add_diagonal(at.speed(), &[walks.speed_q * dt]);
    p.add_diagonal(at.heading(), &[walks.yaw_rate_q * dt.powi(3) / 3.0]);
    p.add_mixed(at.heading(), at.yaw_rate(), &nalgebra::Matrix1::new(walks.yaw_rate_q * dt * dt / 2.0));
    p.add_diagonal(at.yaw_rate(), &[walks.yaw_rate_q * dt]);
}
