//! A vehicle that turns tighter than its model of motion allows: the bound on its yaw rate is lifted.
//!
//! An `ackermann` target turns only as it rolls. One on tracks configured so, or a car that slides, belies that: its yaw
//! rate stays beyond the tightest turn at its speed by more than the filter's own doubt. After half a second of it the
//! model is taken to be wrong for the rest of the flight.

use super::core::Core;
use super::state::State;

/// How far beyond the tightest turn at most is steering, as a factor on it.
const TOLERANCE: f64 = 1.2;
/// Sigmas of speed and yaw rate beyond that.
const SIGMAS: f64 = 3.0;
/// How long it must last, s.
const LASTING_S: f64 = 0.5;
/// Yaw rates below this are no turn, rad/s.
const LEAST_RADPS: f64 = 0.05;

/// How a vehicle has turned tighter than it can.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct Spin {
    /// For how long, s: more than [`LASTING_S`] for good.
    lasted_s: f64,
    /// Its yaw rate over the most that it should have been.
    over: f64,
}

impl Spin {
    /// Whether the bound is lifted.
    pub(crate) fn is_free(self) -> bool {
        self.lasted_s >= LASTING_S
    }

    /// Yaw rate over the most that its model allows, as it was when the bound was lifted.
    pub(crate) fn over_the_bound(self) -> f64 {
        self.over
    }

    /// Takes a frame's yaw rate over the most that it can be; `since_s` is the time since the frame before.
    fn take(&mut self, over: f64, since_s: f64) {
        if !self.is_free() {
            let too_tight = over > 1.0;
            *self =
                if too_tight { Self { lasted_s: self.lasted_s + since_s, over } } else { Self::default() };
        }
    }
}

impl Core {
    /// Appearance at the turns of the targets a frame has shown.
    pub(crate) fn judge_turns(&mut self) {
        for i in 0..self.state.targets.len() {
            let Some(tightest) = self.models.targets[i].motion.model().tightest_turn() else { continue };
            let target = &self.state.targets[i];
            if !target.life.is_held() || target.last_seen != self.state.t || target.spin.is_free() {
                continue;
            }
            let over = self.state.turn_over_tightest(i, tightest);
            let (now, target) = (self.state.t, &mut self.state.targets[i]);
            let since_s = (now - target.turn_judged).s().clamp(0.0, 0.25);
            target.turn_judged = now;
            target.spin.take(over, since_s);
            if target.spin.is_free() {
                // As it had turned under the bound, nothing is known of how it turns.
                self.state.learnt.target_q[i][1] = self.learning.start.target_q[i][1];
            }
        }
    }
}

impl State {
    /// The least that its yaw rate may be over the most that it can be by its model.
    fn turn_over_tightest(&self, i: usize, tightest: f64) -> f64 {
        let at = self.layout().target(i);
        let [.., speed, yaw_rate] = self.targets[i].mean;
        let fastest = speed.abs() + SIGMAS * self.cov.sigma(at.speed(), 0);
        let least = yaw_rate.abs() - SIGMAS * self.cov.sigma(at.yaw_rate(), 0);
        least / (TOLERANCE * tightest * fastest).max(LEAST_RADPS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_too_tight_must_last_and_then_counts_for_good() {
        let mut spin = Spin::default();
        for over in [2.0, 2.0, 0.9, 2.0, 2.0, 2.0, 2.0] {
            spin.take(over, 0.1);
        }
        assert!(!spin.is_free(), "four frames in a row");
        spin.take(3.0, 0.11);
        assert!(spin.is_free() && spin.over_the_bound() == 3.0);
        spin.take(0.0, 1.0);
        assert!(spin.is_free());
    }
}
