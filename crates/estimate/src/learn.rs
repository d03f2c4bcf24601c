//! Intensities of the helicopter's motion, fitted in flight.
//!
//! By the tower rule the posterior expectation of a squared increment has the prior's mean where the prior's intensity
//! is right: `E[(x_t − φ x_s)² | data]` averages to `q`-times-what-`q`-does over the interval. The filter holds `x_t`,
//! the smoothed `x_s` and their covariance, so the expectation is at hand, and a sliding mean of it is the fit
//! (expectation maximisation with forgetting).

use super::blocks::own;
use super::delayed::DelayedCopy;
use super::fitted::{Learning, blend};
use super::models::Models;
use super::own::GRAVITY;
use super::state::State;

impl State {
    /// Fits from rate and force as they were an interval ago.
    pub(crate) fn learn(&mut self, models: &Models, learning: &Learning) {
        if !learning.on {
            return;
        }
        if self.past_motion.in_use && self.t - self.past_motion.t >= learning.interval {
            self.learn_own(models, learning);
            self.past_motion.in_use = false;
        }
        if !self.past_motion.in_use {
            self.copy_motion();
        }
    }

    fn learn_own(&mut self, models: &Models, learning: &Learning) {
        let age_s = (self.t - self.past_motion.t).s();
        let gain = (age_s / learning.over_s).min(0.5);
        let rate_decay = (-age_s / models.tau.rate_s).exp();
        let force_decay = (-age_s / models.tau.force_s).exp();
        let weight = -GRAVITY;
        let (rate, force) = (self.own.rate, self.own.force);
        let now = [rate.x, rate.y, rate.z, force.x, force.y, force.z - weight];
        let mut squares = [0.0; 6];
        for (i, square) in squares.iter_mut().enumerate() {
            let decay = if i < 3 { rate_decay } else { force_decay };
            let then = self.past_motion.mean[i] - if i == 5 { weight } else { 0.0 };
            let column = own::MOTION.column(i);
            let expected = increment(&self.past_motion, i, self.cov.at(column, column), column, decay);
            *square = ((now[i] - decay * then).powi(2) + expected) / (1.0 - decay * decay);
        }
        let per_s = 2.0 / models.tau.rate_s;
        let (l, s) = (&mut self.learnt, &learning.start);
        blend(&mut l.tilt_rate_q, 0.5 * (squares[0] + squares[1]) * per_s, gain, s.tilt_rate_q);
        blend(&mut l.yaw_rate_q, squares[2] * per_s, gain, s.yaw_rate_q);
        blend(&mut l.side_force_var, 0.5 * (squares[3] + squares[4]), gain, s.side_force_var);
        blend(&mut l.thrust_var, squares[5], gain, s.thrust_var);
    }
}

/// Variance of `x_now − decay · x_then`.
fn increment(copy: &DelayedCopy, row: usize, var_now: f64, column: usize, decay: f64) -> f64 {
    var_now + decay * decay * copy.cov.at(row, row) - 2.0 * decay * copy.cross.at(row, column)
}
