//! Intensities fitted in flight.
//!
//! Vehicles: the smoother, which knows what was measured later, shows how wrong the filter was; a walk is right
//! that makes the filter as wrong as it said it was (`learn_target`).
//!
//! Helicopter: by the tower rule the posterior expectation of a squared increment has the prior's mean where the
//! prior's intensity is right: `E[(x_t − φ x_s)² | data]` averages to `q`-times-what-`q`-does over the
//! interval. The filter holds `x_t`, the smoothed `x_s` and their covariance, so the expectation is at
//! hand, and a sliding mean of it is the fit (expectation maximisation with forgetting).

use windhover_base::time::{MonoTime, Span};

use super::models::Models;
use super::state::{Echo, State, at};

/// What is fitted.
#[derive(Clone, Debug, Default)]
pub(super) struct Learnt {
    /// Intensities of speed and yaw rate walk per target, (m/s)²/s and (rad/s)²/s.
    pub(super) target_q: Vec<[f64; 2]>,
    /// Intensity of roll and pitch rate walk, (rad/s)²/s.
    pub(super) tilt_rate_q: f64,
    /// Intensity of yaw rate walk, (rad/s)²/s.
    pub(super) yaw_rate_q: f64,
    /// Variance of the force across the rotor axis, (m/s²)².
    pub(super) side_force_var: f64,
    /// Variance of the thrust about the weight, (m/s²)².
    pub(super) thrust_var: f64,
    /// Variance of a tilt reading, rad².
    pub(super) tilt_var: f64,
    /// Variance of a heading reading, rad².
    pub(super) heading_var: f64,
    /// Factors on the variance of each target's marker pixels, and of ground features.
    pub(super) marker_factor: Vec<f64>,
    pub(super) feature_factor: f64,
    /// Factors on the variance of the receiver's position and velocity noise.
    pub(super) gps_factor: f64,
    pub(super) gps_velocity_factor: f64,
    /// When the targets' intensities were last fitted.
    pub(super) t_target: MonoTime,
}

/// Limits of what is learnt, as factors on the configured standard deviation.
pub(super) const LEAST: f64 = 0.01;
pub(super) const MOST: f64 = 5.0;

/// Least that is learnt of a vehicle's motion, likewise: one that is parked does not move at all.
const STILL: f64 = 0.005;

/// The configured values and how fast to leave them.
#[derive(Clone, Debug)]
pub(super) struct Learning {
    pub(super) on: bool,
    pub(super) over_s: f64,
    /// Interval of the increments looked at.
    pub(super) interval: Span,
    pub(super) start: Learnt,
}

impl Learnt {
    /// Copies without allocating where the sizes match.
    pub(super) fn copy_from(&mut self, other: &Self) {
        self.target_q.clone_from(&other.target_q);
        self.tilt_rate_q = other.tilt_rate_q;
        self.yaw_rate_q = other.yaw_rate_q;
        self.side_force_var = other.side_force_var;
        self.thrust_var = other.thrust_var;
        self.tilt_var = other.tilt_var;
        self.heading_var = other.heading_var;
        self.marker_factor.clone_from(&other.marker_factor);
        self.feature_factor = other.feature_factor;
        self.gps_factor = other.gps_factor;
        self.gps_velocity_factor = other.gps_velocity_factor;
        self.t_target = other.t_target;
    }
}

impl State {
    /// Fits from the probe and from the target copy that is `interval` old.
    pub(super) fn learn(&mut self, models: &Models, learning: &Learning) {
        if !learning.on {
            return;
        }
        if self.probe.live && self.t - self.probe.t >= learning.interval {
            self.learn_own(models, learning);
            self.probe.live = false;
        }
        if !self.probe.live {
            self.echo_own();
        }
    }

    fn learn_own(&mut self, models: &Models, learning: &Learning) {
        let age_s = (self.t - self.probe.t).s();
        let gain = (age_s / learning.over_s).min(0.5);
        let rate_decay = (-age_s / models.tau.rate_s).exp();
        let force_decay = (-age_s / models.tau.force_s).exp();
        let weight = -super::state::GRAVITY;
        let own = self.own;
        let now = [own.rate.x, own.rate.y, own.rate.z, own.force.x, own.force.y, own.force.z - weight];
        let mut squares = [0.0; 6];
        for (i, square) in squares.iter_mut().enumerate() {
            let decay = if i < 3 { rate_decay } else { force_decay };
            let then = self.probe.mean[i] - if i == 5 { weight } else { 0.0 };
            let expected =
                increment(&self.probe, i, self.cov.at(at::RATE + i, at::RATE + i), at::RATE + i, decay);
            *square = ((now[i] - decay * then).powi(2) + expected) / (1.0 - decay * decay);
        }
        let per_s = 2.0 / models.tau.rate_s;
        let (l, s) = (&mut self.learnt, &learning.start);
        blend(&mut l.tilt_rate_q, 0.5 * (squares[0] + squares[1]) * per_s, gain, s.tilt_rate_q);
        blend(&mut l.yaw_rate_q, squares[2] * per_s, gain, s.yaw_rate_q);
        blend(&mut l.side_force_var, 0.5 * (squares[3] + squares[4]), gain, s.side_force_var);
        blend(&mut l.thrust_var, squares[5], gain, s.thrust_var);
    }

    /// Fits the targets' intensities. Call once a frame, after its fusion.
    pub(super) fn learn_targets(&mut self, learning: &Learning) {
        let now = self.t;
        let since_s = (now - self.learnt.t_target).s().clamp(0.0, 0.2);
        self.learnt.t_target = now;
        if !learning.on {
            return;
        }
        for i in 0..self.targets.len() {
            if self.targets[i].held && self.targets[i].last_seen == now {
                self.learn_rest(learning, i, since_s);
                for k in 0..2 {
                    self.learn_target(learning, i, k, since_s);
                }
            }
        }
    }

    /// Fits the walk of target `i`'s speed (`k` = 0) or yaw rate (`k` = 1).
    ///
    /// Twice the filter's memory `P/q` ago (at least two frames, at most the interval) it told a value and a
    /// variance; since then the smoother has moved that value, and knows by how much it should have: `P_f − P_s`,
    /// and more where motion is smooth ([`more_than_found`]). The logarithm of the intensity moves by what the
    /// ratio of the two differs from one, so that the mean ratio over time is one.
    fn learn_target(&mut self, learning: &Learning, i: usize, k: usize, since_s: f64) {
        let (column, row) = (self.target_at(i) + 3 + k, at::TARGET * i + 3 + k);
        let start = learning.start.target_q[i][k];
        let q = self.walk_seen(i, k, start);
        let memory_s = self.cov.at(column, column) / q;
        self.targets[i].memory_s[k] = memory_s;
        let target = &self.targets[i];
        // A target started again since then has nothing in common with its copy.
        let usable = || self.echoes.iter().filter(|e| e.live && e.t < self.t && e.t >= target.started);
        let Some(last) = usable().map(|e| e.t).max() else { return };
        let frame_s = (self.t - last).s();
        let lag_s = (LAG * memory_s).min(learning.interval.s()).max(2.0 * frame_s);
        let misfit = |e: &&Echo| ((self.t - e.t).s() - lag_s).abs();
        let Some(echo) = usable().min_by(|a, b| misfit(a).total_cmp(&misfit(b))) else { return };
        let age_s = (self.t - echo.t).s();
        if age_s < 0.75 * lag_s {
            return;
        }
        let (value, var) = echo.told[i][k];
        let found = var - echo.cov.at(row, row);
        if found < LEAST_TOLD * var {
            return;
        }
        let due = found * (1.0 + more_than_found(memory_s, age_s, frame_s));
        let ratio = (echo.mean[row] - value).powi(2) / due;
        let gain = since_s / learning.over_s.max(MEMORIES * memory_s);
        if ratio.is_finite() && ratio > 0.0 {
            // Never beyond what explains this one.
            let grown = q * (gain * (ratio - 1.0)).min(ratio.ln().max(0.0)).exp();
            self.learnt.target_q[i][k] = grown.clamp(start * STILL * STILL, start * MOST * MOST);
            self.targets[i].fitted_memory_s[k] = memory_s;
        }
    }
}

impl State {
    /// A vehicle that has stood still for a second is taken to stand: its intensities fall fast, where
    /// the fit alone would take long, since increments that cannot be told from noise teach it little.
    ///
    /// The test is `(v̂, ω̂) P⁻¹ (v̂, ω̂)ᵀ`, two on average for a vehicle at rest. One that creeps slower than
    /// can be seen fails it as soon as the smaller intensity has sharpened the estimate.
    fn learn_rest(&mut self, learning: &Learning, i: usize, since_s: f64) {
        let s = self.target_at(i);
        let (vv, ww, vw) = (self.cov.at(s + 3, s + 3), self.cov.at(s + 4, s + 4), self.cov.at(s + 3, s + 4));
        let target = &mut self.targets[i];
        let [.., v, w] = target.mean;
        let test = (v * v * ww - 2.0 * v * w * vw + w * w * vv) / (vv * ww - vw * vw).max(1e-18);
        target.motion += (since_s / REST_S).min(1.0) * (test.min(MOVING) - target.motion);
        if target.motion < RESTING {
            let keep = (-since_s / REST_S).exp();
            for (q, start) in self.learnt.target_q[i].iter_mut().zip(&learning.start.target_q[i]) {
                *q = (*q * keep).max(start * STILL * STILL);
            }
        }
    }

    /// A target whose markers have all left the gate moves otherwise than it did. One that stood has begun to move:
    /// its intensities are what is configured again, and its motion is as uncertain as they make it in half a second.
    /// Of one that moves both are raised a little; where the next frame finds it out of the gate too, it is as with
    /// one that stood.
    pub(super) fn wake(&mut self, learning: &Learning, i: usize) {
        let s = self.target_at(i);
        let anew = self.targets[i].motion < RESTING || self.targets[i].rejected > 1;
        if anew {
            self.targets[i].motion = MOVING;
        }
        for (k, start) in learning.start.target_q[i].iter().enumerate() {
            let (q, var) = (&mut self.learnt.target_q[i][k], self.cov.at(s + 3 + k, s + 3 + k));
            let (woken, more) = if anew { (*start, 0.5 * *start) } else { (RAISE * *q, (RAISE - 1.0) * var) };
            if *q < *start {
                *q = woken.min(*start);
                self.cov.add(s + 3 + k, s + 3 + k, more);
            }
        }
    }
}

/// By what factor variances of a vehicle's motion are raised when it moves otherwise than was expected.
const RAISE: f64 = 4.0;

/// Time over which a vehicle must have stood still to be taken to stand, s.
const REST_S: f64 = 0.5;
/// Value of the test (mean of two at rest) below which it stands, and the most one frame counts.
const RESTING: f64 = 2.5;
pub(super) const MOVING: f64 = 20.0;

/// How much later than the filter's memory P/q an estimate is compared with what became of it.
const LAG: f64 = 2.0;
/// Memories over which it is fitted at the least: what lies closer together tells the same.
const MEMORIES: f64 = 4.0;
/// Least share of a variance that must have been found out since.
const LEAST_TOLD: f64 = 0.2;
/// Shortest increment looked at, s.
pub(super) const SHORTEST_S: f64 = 0.1;

/// By what share more than a smoother finds out an honest estimate of a memory of `memory_s` turns out to
/// be off after `age_s`: nothing where motion is a walk. Where it is smooth the estimate trails, which no
/// later noise takes part in: `E[(filtered − smoothed)²]` of a target at constant acceleration,
/// computed over noise and frame rates, exceeds `P_f − P_s` by `min(0.27 age/T, 0.42 + 0.17 frame/T)`.
/// A vehicle is smooth over times short against its own response, and walks over long ones.
fn more_than_found(memory_s: f64, age_s: f64, frame_s: f64) -> f64 {
    let smooth = (0.27 * age_s).min(0.42 * memory_s + 0.17 * frame_s) / memory_s;
    smooth / (1.0 + memory_s / RESPONSE_S)
}

/// Time within which a vehicle follows its driver, s: a steering gear takes about a quarter of a second, a drive
/// that has a mass to move two thirds.
const RESPONSE_S: f64 = 0.4;

/// Variance of `x_now − decay · x_then`.
fn increment(echo: &Echo, row: usize, var_now: f64, column: usize, decay: f64) -> f64 {
    var_now + decay * decay * echo.cov.at(row, row) - 2.0 * decay * echo.cross.at(row, column)
}

/// Moves `value` toward `sample`, within the limits about `start`.
fn blend(value: &mut f64, sample: f64, gain: f64, start: f64) {
    if sample.is_finite() {
        *value = (*value + gain * (sample - *value)).clamp(start * LEAST * LEAST, start * MOST * MOST);
    }
}

/// Moves a measurement's variance toward what its residual after fusion shows:
/// `E[(z − h)² | data] = (R/S r)² + R (1 − R/S)`.
pub(super) fn blend_noise(
    value: &mut f64,
    residual: f64,
    innovation_var: f64,
    gain: f64,
    limits: (f64, f64),
) {
    let share = *value / innovation_var.max(*value);
    let sample = (share * residual).powi(2) + *value * (1.0 - share);
    if sample.is_finite() {
        *value = (*value + gain * (sample - *value)).clamp(limits.0, limits.1);
    }
}

/// Farther outside the gate than this a measurement teaches nothing of the noise of good ones.
pub(super) const LEARN_RATIO: f64 = 4.0;

/// Moves a factor on a measurement's noise toward what its misfit (one where the noise is right) shows.
pub(super) fn blend_factor(value: &mut f64, misfit: f64, samples: f64, limits: (f64, f64)) {
    if misfit.is_finite() {
        *value = (*value * (1.0 + (misfit - 1.0) / samples)).clamp(limits.0, limits.1);
    }
}

/// Limits of a factor on the variance of pixels: from a tenth of the sigma assumed to five times as much.
pub(super) const PIXEL_FACTORS: (f64, f64) = (0.01, 25.0);
/// Likewise of the receiver's noise. What it filters is not white, so little is made of a small residual.
pub(super) const GPS_FACTORS: (f64, f64) = (0.25, 25.0);
