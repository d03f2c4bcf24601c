//! The helicopter: `ṗ = v`, `v̇ = R f + g − c v`, `Ṙ = R [ω]×`; rate and specific force are Gauss–Markov.
//!
//! A rotor pushes along its axis, so the force across it is small: this ties tilt to acceleration, as strongly as that
//! force's fitted sigma allows. The right Jacobian of the turn within a step (½ ω dt, at most 3 % of the rate's error at
//! 1 rad/s) is taken as one.

use nalgebra::{Matrix3, Rotation3, Vector3};

use windhover_base::geo::skew;

use crate::blocks::own;
use crate::fitted::Learnt;
use crate::matrix::Grid;
use crate::models::Models;
use crate::own::{GRAVITY, Own, SLOW_STATES, slow_decays, slow_growth};

/// Gusts and vibration straight into velocity, m/s per √s.
const VELOCITY_WALK: f64 = 0.02;

/// Everything the linear step needs.
pub(super) struct Step {
    dt: f64,
    /// `ned_from_body`.
    rotation: Matrix3<f64>,
    velocity: Vector3<f64>,
    drag_per_s: f64,
    /// ∂v̇/∂attitude.
    tilt: Matrix3<f64>,
    rate_decay: f64,
    force_decay: f64,
    slow_decay: [f64; SLOW_STATES],
}

impl Step {
    /// A step of `dt` seconds from where the helicopter is.
    pub(super) fn new(own: &Own, dt: f64, models: &Models) -> Self {
        let tau = &models.tau;
        Self {
            dt,
            rotation: *own.rotation(),
            velocity: own.velocity,
            drag_per_s: own.drag_per_s,
            tilt: -skew(&(own.ned_from_body * own.force)),
            rate_decay: (-dt / tau.rate_s).exp(),
            force_decay: (-dt / tau.force_s).exp(),
            slow_decay: slow_decays(models, dt),
        }
    }

    /// Its length, s.
    pub(super) fn dt(&self) -> f64 {
        self.dt
    }

    /// Carries the mean on.
    pub(super) fn advance(&self, own: &mut Own) {
        let dt = self.dt;
        let acceleration = own.acceleration();
        own.position += own.velocity * dt + acceleration * (0.5 * dt * dt);
        own.velocity += acceleration * dt;
        own.ned_from_body *= Rotation3::new(own.rate * dt);
        own.rate *= self.rate_decay;
        let weight = Vector3::new(0.0, 0.0, -GRAVITY);
        own.force = weight + (own.force - weight) * self.force_decay;
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
        let dt = self.dt;
        let pushed = self.tilt * own::ATTITUDE.of(row) + self.rotation * own::FORCE.of(row)
            - own::VELOCITY.of(row) * self.drag_per_s
            - self.velocity * row[own::DRAG.column(0)];
        let turned = self.rotation * own::RATE.of(row);
        for i in 0..3 {
            row[own::POSITION.column(i)] += dt * row[own::VELOCITY.column(i)] + 0.5 * dt * dt * pushed[i];
            row[own::VELOCITY.column(i)] += dt * pushed[i];
            row[own::ATTITUDE.column(i)] += dt * turned[i];
            row[own::RATE.column(i)] *= self.rate_decay;
            row[own::FORCE.column(i)] *= self.force_decay;
        }
        row[own::SLOW.range()].iter_mut().zip(&self.slow_decay).for_each(|(x, decay)| *x *= decay);
    }

    /// Adds Q.
    pub(super) fn add_noise(&self, models: &Models, learnt: &Learnt, p: &mut Grid) {
        let dt = self.dt;
        let rate_q = Vector3::new(learnt.tilt_rate_q, learnt.tilt_rate_q, learnt.yaw_rate_q);
        let turned = self.rotation * Matrix3::from_diagonal(&rate_q);
        let attitude_q = turned * self.rotation.transpose();
        let force_q = Vector3::new(learnt.side_force_var, learnt.side_force_var, learnt.thrust_var)
            * (1.0 - self.force_decay * self.force_decay);
        p.add_square(own::ATTITUDE, &attitude_q.map(|q| q * dt.powi(3) / 3.0));
        p.add_mixed(own::ATTITUDE, own::RATE, &turned.map(|q| q * dt * dt / 2.0));
        p.add_diagonal(own::RATE, &rate_q.map(|q| q * dt).into());
        p.add_diagonal(own::FORCE, &force_q.into());
        let q = VELOCITY_WALK.powi(2);
        p.add_diagonal(own::POSITION, &[q * dt.powi(3) / 3.0; 3]);
        p.add_mixed(own::POSITION, own::VELOCITY, &Matrix3::from_diagonal_element(q * dt * dt / 2.0));
        p.add_diagonal(own::VELOCITY, &[q * dt; 3]);
        p.add_diagonal(own::SLOW, &slow_growth(models, dt));
    }
}
