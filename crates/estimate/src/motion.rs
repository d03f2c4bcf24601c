//! How everything moves from one instant to the next, and how uncertainty grows with it.
//!
//! Helicopter: `ṗ = v`, `v̇ = R f + g − c v`, `Ṙ = R [ω]×`; rate and specific force are Gauss–Markov. A
//! rotor pushes along its axis, so the force across it is small: this ties tilt to acceleration, as
//! strongly as that force's learnt sigma allows. Vehicle: `ẋ = v cos ψ`, `ẏ = v sin ψ`, `ψ̇ = ω`, with
//! v and ω random walks (paper eq. 26). Ground features stand still.

use nalgebra::{Matrix3, Vector3};

use windhover_base::geo::skew;
use windhover_base::settings::TargetModel;
use windhover_base::time::MonoTime;

use super::learn::SHORTEST_S;
use super::matrix::Grid;
use super::models::Models;
use super::state::{GRAVITY, State, at};

/// Longest step, seconds: the linearisation holds over it.
const MAX_STEP_S: f64 = 0.05;

/// Everything the linear step needs.
struct Step {
    dt: f64,
    /// `ned_from_body`.
    rotation: Matrix3<f64>,
    velocity: Vector3<f64>,
    drag_per_s: f64,
    /// ∂v̇/∂attitude.
    tilt: Matrix3<f64>,
    rate_decay: f64,
    force_decay: f64,
    bias_decay: f64,
}

/// One target's part of the linear step.
#[derive(Clone, Copy)]
struct TargetStep {
    start: usize,
    cos: f64,
    sin: f64,
    speed: f64,
}

impl State {
    /// Carries mean and covariance on to `t`; does nothing where `t` is not later.
    pub(super) fn propagate(&mut self, t: MonoTime, models: &Models) {
        let mut left = (t - self.t).s();
        while left > 0.0 {
            let dt = left.min(MAX_STEP_S);
            self.step(dt, models);
            left -= dt;
        }
        self.t = self.t.max(t);
    }

    fn step(&mut self, dt: f64, models: &Models) {
        let tau = &models.tau;
        let step = Step {
            dt,
            rotation: *self.own.rotation(),
            velocity: self.own.velocity,
            drag_per_s: self.own.drag_per_s,
            tilt: -skew(&(self.own.ned_from_body * self.own.force)),
            rate_decay: (-dt / tau.rate_s).exp(),
            force_decay: (-dt / tau.force_s).exp(),
            bias_decay: (-dt / tau.gps_bias_s).exp(),
        };
        let count = self.targets.len();
        for row in 0..self.cov.rows() {
            step.own(self.cov.row_mut(row));
        }
        for echo in self.echoes.iter_mut().chain([&mut self.probe]).filter(|e| e.live) {
            for row in 0..echo.cross.rows() {
                step.own(echo.cross.row_mut(row));
            }
        }
        for i in 0..count {
            let Some(target) = self.target_step(i, dt, models) else { continue };
            for row in 0..self.cov.rows() {
                target.apply(self.cov.row_mut(row), dt);
            }
            for echo in self.echoes.iter_mut().chain([&mut self.probe]).filter(|e| e.live) {
                for row in 0..echo.cross.rows() {
                    target.apply(echo.cross.row_mut(row), dt);
                }
            }
        }
        // P Fᵀ is done; F (P Fᵀ) is the same on the rows of its transpose.
        self.cov.transpose();
        for row in 0..self.cov.rows() {
            step.own(self.cov.row_mut(row));
        }
        for i in 0..count {
            let Some(target) = self.target_step(i, dt, models) else { continue };
            for row in 0..self.cov.rows() {
                target.apply(self.cov.row_mut(row), dt);
            }
        }
        self.add_own_noise(&step, models);
        for i in 0..count {
            self.add_target_noise(i, dt, models);
        }
        self.move_mean(dt, models);
    }

    fn target_step(&self, i: usize, dt: f64, models: &Models) -> Option<TargetStep> {
        let target = &self.targets[i];
        if !target.held || models.targets[i].model == TargetModel::Static {
            return None;
        }
        let [_, _, heading, speed, yaw_rate] = target.mean;
        let (sin, cos) = (heading + 0.5 * yaw_rate * dt).sin_cos();
        Some(TargetStep { start: self.target_at(i), cos, sin, speed })
    }

    fn move_mean(&mut self, dt: f64, models: &Models) {
        let tau = &models.tau;
        let own = &mut self.own;
        let acceleration = own.acceleration();
        own.position += own.velocity * dt + acceleration * (0.5 * dt * dt);
        own.velocity += acceleration * dt;
        own.ned_from_body *= nalgebra::Rotation3::new(own.rate * dt);
        own.rate *= (-dt / tau.rate_s).exp();
        let weight = Vector3::new(0.0, 0.0, -GRAVITY);
        own.force = weight + (own.force - weight) * (-dt / tau.force_s).exp();
        own.gps_bias *= (-dt / tau.gps_bias_s).exp();
        for (target, model) in self.targets.iter_mut().zip(&models.targets) {
            if target.held && model.model != TargetModel::Static {
                let [_, _, heading, speed, yaw_rate] = target.mean;
                let (sin, cos) = (heading + 0.5 * yaw_rate * dt).sin_cos();
                target.mean[0] += speed * cos * dt;
                target.mean[1] += speed * sin * dt;
                target.mean[2] += yaw_rate * dt;
            }
        }
    }

    fn add_own_noise(&mut self, step: &Step, models: &Models) {
        let (dt, walk, learnt) = (step.dt, &models.walk, &self.learnt);
        let rate_q = Vector3::new(learnt.tilt_rate_q, learnt.tilt_rate_q, learnt.yaw_rate_q);
        let turned = step.rotation * Matrix3::from_diagonal(&rate_q);
        let attitude_q = turned * step.rotation.transpose();
        let force_q = Vector3::new(learnt.side_force_var, learnt.side_force_var, learnt.thrust_var)
            * (1.0 - step.force_decay * step.force_decay);
        let p = &mut self.cov;
        for i in 0..3 {
            for j in 0..3 {
                p.add(at::ATTITUDE + i, at::ATTITUDE + j, attitude_q[(i, j)] * dt.powi(3) / 3.0);
                let cross = turned[(i, j)] * dt * dt / 2.0;
                p.add(at::ATTITUDE + i, at::RATE + j, cross);
                p.add(at::RATE + j, at::ATTITUDE + i, cross);
            }
            p.add(at::RATE + i, at::RATE + i, rate_q[i] * dt);
            p.add(at::FORCE + i, at::FORCE + i, force_q[i]);
            add_walk(p, at::POSITION + i, at::VELOCITY + i, walk.velocity_q, dt);
            p.add(
                at::GPS_BIAS + i,
                at::GPS_BIAS + i,
                models.gps_bias_var[i] * (1.0 - step.bias_decay * step.bias_decay),
            );
        }
        p.add(at::HEADING_BIAS, at::HEADING_BIAS, walk.heading_bias_q * dt);
        p.add(at::TILT_GAIN, at::TILT_GAIN, walk.tilt_gain_q * dt);
        p.add(at::TILT_BIAS, at::TILT_BIAS, walk.tilt_bias_q * dt);
        p.add(at::TILT_BIAS + 1, at::TILT_BIAS + 1, walk.tilt_bias_q * dt);
        p.add(at::GPS_DELAY, at::GPS_DELAY, walk.gps_delay_q * dt);
    }

    fn add_target_noise(&mut self, i: usize, dt: f64, models: &Models) {
        let Some(step) = self.target_step(i, dt, models) else { return };
        let s = step.start;
        let (speed_q, yaw_rate_q) = self.target_intensity(i, models);
        let (c, sn) = (step.cos, step.sin);
        let p = &mut self.cov;
        let along = speed_q * dt.powi(3) / 3.0;
        let across = models.walk.slip_q * dt;
        p.add(s, s, along * c * c + across * sn * sn);
        p.add(s + 1, s + 1, along * sn * sn + across * c * c);
        let mixed = (along - across) * c * sn;
        p.add(s, s + 1, mixed);
        p.add(s + 1, s, mixed);
        for (k, part) in [(0, c), (1, sn)] {
            let value = speed_q * dt * dt / 2.0 * part;
            p.add(s + k, s + 3, value);
            p.add(s + 3, s + k, value);
        }
        p.add(s + 3, s + 3, speed_q * dt);
        add_walk(p, s + 2, s + 4, yaw_rate_q, dt);
    }

    /// How target `i`'s speed (`k` = 0) or yaw rate (`k` = 1) walks while it is seen: as was learnt, which is true at
    /// the scale of the memory the filter had then. Where it remembers for longer now (a marker is hidden) and nothing
    /// is learnt, motion, smoother than a walk, goes farther: its intensity grows as the memory does.
    pub(super) fn walk_seen(&self, i: usize, k: usize, most: f64) -> f64 {
        let (target, learnt) = (&self.targets[i], self.learnt.target_q[i][k]);
        if target.fitted_memory_s[k] <= 0.0 {
            return learnt;
        }
        (learnt * (target.memory_s[k] / target.fitted_memory_s[k]).max(1.0)).min(most).max(learnt)
    }

    /// How target `i` walks at present. What was learnt is true at the scale of the filter's memory T; motion is
    /// smoother than a walk, so that over a longer time t out of sight its increments grow as `q t²/T`, a walk of
    /// intensity `2 q t/T`, until it may do whatever is configured.
    fn present_walks(&self, i: usize, models: &Models) -> [f64; 2] {
        let target = &self.targets[i];
        let away_s = (self.t - target.last_seen).s();
        std::array::from_fn(|k| {
            let most = models.target_walks[k];
            let seen = self.walk_seen(i, k, most);
            if away_s < super::track::BLINK_S {
                return seen;
            }
            let grown = seen * (2.0 * away_s / target.memory_s[k].max(SHORTEST_S)).max(1.0);
            grown.min(most).max(seen)
        })
    }

    /// Intensities of target `i`'s speed and yaw rate walks. A car turns only as it rolls: its yaw
    /// rate walk is bounded by what its tightest turn allows at the present speed.
    pub(super) fn target_intensity(&self, i: usize, models: &Models) -> (f64, f64) {
        let [speed_q, yaw_rate_q] = self.present_walks(i, models);
        let Some(curvature) = models.targets[i].max_curvature else { return (speed_q, yaw_rate_q) };
        let s = self.target_at(i);
        let speed2 = self.targets[i].mean[3].powi(2) + self.cov.at(s + 3, s + 3);
        // Half the tightest turn as one sigma, changing over a second.
        let bound = 2.0 * (0.5 * curvature).powi(2) * speed2;
        (speed_q, yaw_rate_q.min(bound + 1e-6))
    }
}

/// Noise of a random walk of intensity `q` in state `j`, integrated into state `i`.
fn add_walk(p: &mut Grid, i: usize, j: usize, q: f64, dt: f64) {
    p.add(i, i, q * dt.powi(3) / 3.0);
    p.add(i, j, q * dt * dt / 2.0);
    p.add(j, i, q * dt * dt / 2.0);
    p.add(j, j, q * dt);
}

impl Step {
    /// `row ← row Fᵀ` for the helicopter's states. Each line reads only what is not yet overwritten.
    fn own(&self, row: &mut [f64]) {
        let dt = self.dt;
        let three = |row: &[f64], i: usize| Vector3::new(row[i], row[i + 1], row[i + 2]);
        let attitude = three(row, at::ATTITUDE);
        let pushed = self.tilt * attitude + self.rotation * three(row, at::FORCE)
            - three(row, at::VELOCITY) * self.drag_per_s
            - self.velocity * row[at::DRAG];
        let turned = self.rotation * three(row, at::RATE);
        for i in 0..3 {
            row[at::POSITION + i] += dt * row[at::VELOCITY + i] + 0.5 * dt * dt * pushed[i];
            row[at::VELOCITY + i] += dt * pushed[i];
            row[at::ATTITUDE + i] += dt * turned[i];
            row[at::RATE + i] *= self.rate_decay;
            row[at::FORCE + i] *= self.force_decay;
            row[at::GPS_BIAS + i] *= self.bias_decay;
        }
    }
}

impl TargetStep {
    /// `row ← row Fᵀ` for the target's states.
    fn apply(&self, row: &mut [f64], dt: f64) {
        let row = &mut row[self.start..self.start + at::TARGET];
        let turned = dt * row[2] + 0.5 * dt * dt * row[4];
        row[0] += dt * self.cos * row[3] - self.speed * self.sin * turned;
        row[1] += dt * self.sin * row[3] + self.speed * self.cos * turned;
        row[2] += dt * row[4];
    }
}
