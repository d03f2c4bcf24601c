//! The helicopter: `ṗ = v`, `v̇ = f + g` with the force f of `force.rs`, `Ṙ = R [ω]×`; rate, gusts and thrust excess are
//! Gauss–Markov, wind and trim walk.
//!
//! A rotor pushes along its axis, and what else pushes is wind and drag of known size: this ties tilt to acceleration.
//! The right Jacobian of the turn within a step (½ ω dt, at most 3 % of the rate's error at 1 rad/s) is taken as one.

use std::ops::Range;

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::blocks::{Layout, own};
use crate::force::Force;
use crate::matrix::Grid;
use crate::own::{Own, SLOW_STATES};
use crate::slow::Terms;

/// Vibration and what is finer than a gust straight into velocity, m/s per √s.
const VELOCITY_WALK: f64 = 0.02;

/// Everything the linear step needs.
pub(super) struct Step {
    dt: f64,
    /// `ned_from_body`.
    rotation: Matrix3<f64>,
    force: Force,
    drag_per_s: f64,
    rate_decay: f64,
    /// Columns of the states that move by themselves.
    slow: Range<usize>,
    slow_decay: [f64; SLOW_STATES],
}

impl Step {
    /// A step of `dt` seconds from where the helicopter is.
    pub(super) fn new(own: &Own, layout: Layout, dt: f64, terms: &Terms<'_>) -> Self {
        Self {
            slow: layout.slow(),
            dt,
            rotation: *own.rotation(),
            force: Force::of(own),
            drag_per_s: own.drag_per_s,
            rate_decay: (-dt / terms.models.tau.rate_s).exp(),
            slow_decay: terms.decays(dt),
        }
    }

    /// Its length, s.
    pub(super) fn dt(&self) -> f64 {
        self.dt
    }

    /// Carries the mean on.
    pub(super) fn advance(&self, own: &mut Own) {
        let dt = self.dt;
        let acceleration = self.force.acceleration();
        own.position += own.velocity * dt + acceleration * (0.5 * dt * dt);
        own.velocity += acceleration * dt;
        own.ned_from_body *= Rotation3::new(own.rate * dt);
        own.rate *= self.rate_decay;
        own.change_slow(|i, mean| *mean *= self.slow_decay[i]);
    }

    /// `row ← row Fᵀ` for all rows of a grid.
    pub(super) fn carry(&self, grid: &mut Grid) {
        for row in 0..grid.rows() {
            self.carry_row(grid.row_mut(row));
        }
    }

    /// Each line reads only what is not yet overwritten.
    fn carry_row(&self, row: &mut [f64]) {
        let (dt, force) = (self.dt, &self.force);
        let across = own::WIND.of(row) + own::GUST.of(row);
        let pushed = force.d_attitude * own::ATTITUDE.of(row)
            + force.d_trim * own::TRIM.of(row)
            + force.d_thrust * row[own::THRUST.column(0)]
            + force.d_drag * row[own::DRAG.column(0)]
            - own::VELOCITY.of(row) * self.drag_per_s
            + Vector3::new(across.x, across.y, 0.0);
        let turned = self.rotation * own::RATE.of(row);
        for i in 0..3 {
            row[own::POSITION.column(i)] += dt * row[own::VELOCITY.column(i)] + 0.5 * dt * dt * pushed[i];
            row[own::VELOCITY.column(i)] += dt * pushed[i];
            row[own::ATTITUDE.column(i)] += dt * turned[i];
            row[own::RATE.column(i)] *= self.rate_decay;
        }
        row[self.slow.clone()].iter_mut().zip(&self.slow_decay).for_each(|(x, decay)| *x *= decay);
    }

    /// Adds Q.
    pub(super) fn add_noise(&self, terms: &Terms<'_>, p: &mut Grid) {
        let (dt, learnt) = (self.dt, terms.learnt);
        let rate_q = Vector3::new(learnt.tilt_rate_q, learnt.tilt_rate_q, learnt.yaw_rate_q);
        let turned = self.rotation * Matrix3::from_diagonal(&rate_q);
        let attitude_q = turned * self.rotation.transpose();
        p.add_square(own::ATTITUDE, &attitude_q.map(|q| q * dt.powi(3) / 3.0));
        p.add_mixed(own::ATTITUDE, own::RATE, &turned.map(|q| q * dt * dt / 2.0));
        p.add_diagonal(own::RATE, &rate_q.map(|q| q * dt).into());
        let q = VELOCITY_WALK.powi(2);
        p.add_diagonal(own::POSITION, &[q * dt.powi(3) / 3.0; 3]);
        p.add_mixed(own::POSITION, own::VELOCITY, &Matrix3::from_diagonal_element(q * dt * dt / 2.0));
        p.add_diagonal(own::VELOCITY, &[q * dt; 3]);
        p.add_to_diagonal(self.slow.clone(), &terms.growth(dt));
    }
}
