//! Intensities of the helicopter's motion, fitted in flight.
//!
//! By the tower rule the posterior expectation of a squared increment has the prior's mean where the prior's intensity
//! is right: `E[(x_t − φ x_s)² | data]` averages to `q`-times-what-`q`-does over the interval. The filter holds `x_t`,
//! the smoothed `x_s` and their covariance, so the expectation is at hand, and a sliding mean of it is the fit
//! (expectation maximisation with forgetting).
//!
//! Without a marker in view GPS and compass do not tell thrust from what they do not see, nor the reading's error from
//! gusts: these stay what is configured. Rate and gusts are fitted over longer increments then, within limits of their own.

use super::blocks::own;
use super::core::Core;
use super::delayed::DelayedCopy;
use super::fitted::{Learning, blend, blend_within};
use super::models::Models;
use super::own::MOTION_STATES;
use super::state::State;

/// Limits of the roll and pitch rate's walk, (rad/s)²/s, while no marker is seen.
const BLIND_RATE_Q: (f64, f64) = (0.04, 36.0);
/// Limits of the gusts' variance likewise, (m/s²)², and how much slower it is fitted.
const BLIND_GUST_VAR: (f64, f64) = (0.04, 2.25);
const BLIND_GUST_GAIN: f64 = 0.2;
/// Least slow error of a tilt reading that markers may show, rad²: 0.05°.
const LEAST_TILT_ERROR_VAR: f64 = 7.6e-7;
/// Where the fits of gusts and thrust, (m/s²)², and of the rates' walks, (rad/s)²/s, begin at the most when a marker comes
/// into view; that of the reading's error begins at its least. What is more than that shows within a second, what is less slowly.
const SEEN_GUST_VAR: f64 = 0.01;
const SEEN_THRUST_VAR: f64 = 0.1;
const SEEN_TILT_RATE_Q: f64 = 0.16;
const SEEN_YAW_RATE_Q: f64 = 0.0225;

/// A helicopter that moves faster than was thought: its walk is at least this, (rad/s)²/s, …
const WOKEN_RATE_Q: f64 = 9.0;
/// … and so much is added to the variances of its rates, (rad/s)², and of its tilt, rad²: what a tenth of a second of that walk does.
const WOKEN_RATE_VAR: f64 = 0.9;
const WOKEN_TILT_VAR: f64 = 1e-3;

impl State {
    /// Fits from what it was an interval ago.
    pub(crate) fn learn(&mut self, models: &Models, learning: &Learning) {
        if !learning.on {
            return;
        }
        self.notice_sight();
        let interval = if self.is_blind() { learning.blind_interval } else { learning.interval };
        if self.past_motion.in_use && self.t - self.past_motion.t >= interval {
            self.learn_own(models, learning);
            self.past_motion.in_use = false;
        }
        if !self.past_motion.in_use {
            self.copy_motion();
        }
    }

    /// Where a marker comes into view, what GPS and compass could not tell apart is fitted from small figures on.
    fn notice_sight(&mut self) {
        let (blind, l) = (self.is_blind(), &mut self.learnt);
        if l.blind && !blind {
            l.gust_var = l.gust_var.min(SEEN_GUST_VAR);
            l.thrust_var = l.thrust_var.min(SEEN_THRUST_VAR);
            l.tilt_rate_q = l.tilt_rate_q.min(SEEN_TILT_RATE_Q);
            l.yaw_rate_q = l.yaw_rate_q.min(SEEN_YAW_RATE_Q);
            l.tilt_error_var = l.tilt_error_var.min(LEAST_TILT_ERROR_VAR);
        }
        l.blind = blind;
    }

    fn learn_own(&mut self, models: &Models, learning: &Learning) {
        let age_s = (self.t - self.past_motion.t).s();
        let gain = (age_s / learning.over_s).min(0.5);
        let tau = &models.tau;
        let decay = |tau_s: f64| (-age_s / tau_s).exp();
        let (rate, gust, error) = (decay(tau.rate_s), decay(tau.gust_s), decay(self.senses.tilt_error_tau_s));
        let decays = [rate, rate, rate, gust, gust, decay(tau.thrust_s), error, error];
        let now = self.own.motion();
        let squares: [f64; MOTION_STATES] = std::array::from_fn(|i| {
            let column = own::MOTION.column(i);
            let moved = now[i] - decays[i] * self.past_motion.mean[i];
            let expected = increment(&self.past_motion, i, self.cov.at(column, column), column, decays[i]);
            (moved.powi(2) + expected) / (1.0 - decays[i] * decays[i])
        });
        let per_s = 2.0 / tau.rate_s;
        let rate_q = 0.5 * (squares[0] + squares[1]) * per_s;
        let gust_var = 0.5 * (squares[3] + squares[4]);
        let blind = self.is_blind();
        let (l, s) = (&mut self.learnt, &learning.start);
        blend(&mut l.yaw_rate_q, squares[2] * per_s, gain, s.yaw_rate_q);
        if blind {
            blend_within(&mut l.tilt_rate_q, rate_q, gain, BLIND_RATE_Q);
            blend_within(&mut l.gust_var, gust_var, BLIND_GUST_GAIN * gain, BLIND_GUST_VAR);
            l.thrust_var = l.thrust_var.max(s.thrust_var);
        } else {
            blend(&mut l.tilt_rate_q, rate_q, gain, s.tilt_rate_q);
            blend(&mut l.gust_var, gust_var, gain, s.gust_var);
            blend(&mut l.thrust_var, squares[5], gain, s.thrust_var);
            let modelled = self.senses.tilt_error_var;
            let limits = (LEAST_TILT_ERROR_VAR.min(modelled), modelled);
            let error_var = 0.5 * (squares[6] + squares[7]);
            blend_within(&mut l.tilt_error_var, error_var, gain, limits);
        }
    }

    /// The helicopter turns faster than was thought.
    fn wake_own(&mut self) {
        self.learnt.tilt_rate_q = self.learnt.tilt_rate_q.max(WOKEN_RATE_Q);
        self.cov.add_diagonal(own::RATE.part::<2>(0), &[WOKEN_RATE_VAR; 2]);
        self.cov.add_diagonal(own::ATTITUDE.part::<2>(0), &[WOKEN_TILT_VAR; 2]);
    }
}

impl Core {
    /// Wakes the helicopter's rates where the measurement in `self.z` lies outside the gate, as the one of its source
    /// before did, while no marker is seen.
    pub(crate) fn wake_own(&mut self, refused_before: u32) {
        if refused_before == 0 || !self.learning.on || !self.state.is_blind() {
            return;
        }
        if self.gate_ratio().is_some_and(|ratio| ratio > 1.0) {
            self.state.wake_own();
        }
    }
}

/// Variance of `x_now − decay · x_then`.
pub(crate) fn increment(copy: &DelayedCopy, row: usize, var_now: f64, column: usize, decay: f64) -> f64 {
    var_now + decay * decay * copy.cov.at(row, row) - 2.0 * decay * copy.cross.at(row, column)
}
