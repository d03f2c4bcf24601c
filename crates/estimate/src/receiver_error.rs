//! The intensity of the receiver's slow error, fitted in flight: one that wanders farther than configured puts everything
//! elsewhere.
//!
//! As of motion (`learn.rs`): the posterior expectation of a squared increment of the error has the prior's mean where the
//! prior is right. What vehicles and ground show of the helicopter's own way makes an increment over some seconds known; what
//! the error was all along is never seen, but goes with it. So where the fit grows, helicopter, vehicles and ground may all
//! be elsewhere by what it grew, and the receiver's error is other by as much, which changes nothing that is measured.

use windhover_base::msg::{FusionSource, MisfitCause};

use super::blocks::own;
use super::core::Core;
use super::delayed::DelayedCopy;
use super::learn::increment;
use super::state::State;

/// Interval of the increments, and the time over which they are averaged, s.
const INTERVAL_S: f64 = 4.0;
const OVER_S: f64 = 20.0;
/// Mean square of the increments over the configured one from which on they are no chance: of ten squares the mean is
/// beyond it once in ten thousand flights. Below the second one what is configured holds again.
const BEYOND: f64 = 3.0;
const WITHIN: f64 = 1.5;
/// One increment counts no more than this: a jump is no wandering.
const MOST_OF_ONE: f64 = 9.0;
/// The most that the variance is taken to be over that configured.
const MOST: f64 = 25.0;

/// How far the receiver's slow error wanders.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Wandering {
    /// Mean square of its increments over that configured.
    mean: f64,
    /// Factor on the variance configured, one where it fits.
    factor: f64,
}

impl Default for Wandering {
    fn default() -> Self {
        Self { mean: 1.0, factor: 1.0 }
    }
}

impl Wandering {
    /// Factor on the variance configured.
    pub(crate) fn factor(self) -> f64 {
        self.factor
    }

    /// Takes the mean square of an increment over `age_s` over that configured; the factor's growth.
    fn take(&mut self, square: f64, age_s: f64) -> f64 {
        if !square.is_finite() {
            return 0.0;
        }
        let before = self.factor;
        // Where it is known to wander, an increment is measured against that.
        let most = MOST_OF_ONE * before;
        self.mean += (age_s / OVER_S).min(0.5) * (square.min(most) - self.mean);
        let wanders = self.mean > if before > 1.0 { WITHIN } else { BEYOND };
        self.factor = if wanders { self.mean.clamp(1.0, MOST) } else { 1.0 };
        self.factor / before - 1.0
    }
}

impl Core {
    /// Fits the receiver's slow error by what it was an interval ago.
    pub(crate) fn learn_receiver_error(&mut self) {
        if !self.learning.on || self.at_truth || self.state.is_blind() {
            self.state.past_bias.in_use = false;
            return;
        }
        let age_s = (self.state.t - self.state.past_bias.t).s();
        if self.state.past_bias.in_use && age_s >= INTERVAL_S {
            let wandering = self.state.learnt.receiver;
            let ratio = self.state.bias_increment(age_s, self.models.tau.gps_bias_s);
            let grown = self.state.learnt.receiver.take(ratio * wandering.factor(), age_s);
            self.loosen_receiver(grown);
            self.state.past_bias.in_use = false;
        }
        if !self.state.past_bias.in_use {
            self.state.copy_bias();
        }
    }

    /// The receiver's error, where it wanders farther than configured: how many times as far.
    pub(crate) fn receiver_misfit(&self) -> Option<(FusionSource, MisfitCause, f64)> {
        let factor = self.state.learnt.receiver.factor();
        (factor > 1.0).then(|| (FusionSource::GpsPosition, MisfitCause::Wanders, factor.sqrt()))
    }

    /// The receiver's error may be larger by a share of its variance, whatever was measured.
    fn loosen_receiver(&mut self, share: f64) {
        if share <= 0.0 {
            return;
        }
        let mut along = std::mem::take(&mut self.along);
        for axis in 0..2 {
            along.fill(0.0);
            along[own::GPS_BIAS.column(axis)] = 1.0;
            along[own::POSITION.column(axis)] = -1.0;
            for place in self.state.layout().places() {
                // What has no variance is no place yet.
                let column = place.column(axis);
                along[column] = if self.state.cov.at(column, column) > 0.0 { -1.0 } else { 0.0 };
            }
            let var = share * self.state.senses.gps_bias_var[axis];
            self.state.add_direction(&along, var.sqrt());
        }
        self.along = along;
        // What has just been added need not be added again for what the receiver states.
        let senses = &mut self.state.senses;
        let vars = senses.gps_bias_var.iter_mut().chain(&mut senses.gps_bias_held_var);
        vars.for_each(|var| *var *= 1.0 + share);
    }
}

impl State {
    /// Mean square of the horizontal error's increment over what it should be, 1 where the intensity is right.
    fn bias_increment(&self, age_s: f64, tau_s: f64) -> f64 {
        let decay = (-age_s / tau_s).exp();
        let past: &DelayedCopy = &self.past_bias;
        let squares = (0..2).map(|i| {
            let column = own::GPS_BIAS.column(i);
            let moved = self.own.gps_bias[i] - decay * past.mean[i];
            let spread = increment(past, i, self.cov.at(column, column), column, decay);
            (moved * moved + spread) / (self.senses.gps_bias_var[i] * (1.0 - decay * decay))
        });
        0.5 * squares.sum::<f64>()
    }
}
