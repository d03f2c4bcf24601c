//! Whether a vehicle stands still, and whether it begins to move again.

use windhover_base::time::MonoTime;

use super::core::Core;
use super::update::Outcome;

/// Sliding mean of the test `(v̂, ω̂) P⁻¹ (v̂, ω̂)ᵀ`, which is two on average for a vehicle at rest.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct Standstill(f64);

/// Time for which a vehicle must have been at rest before it is treated as standing, s.
pub(crate) const REST_S: f64 = 0.5;
/// Value of the mean below which it stands.
const RESTING: f64 = 2.5;
/// The most that one frame counts, and where a moving vehicle begins.
const MOVING: f64 = 20.0;

impl Standstill {
    /// A vehicle that moves.
    pub(crate) const MOVES: Self = Self(MOVING);

    /// Takes a frame's test; `since_s` is the time since the frame before.
    pub(crate) fn take(&mut self, test: f64, since_s: f64) {
        self.0 += (since_s / REST_S).min(1.0) * (test.min(MOVING) - self.0);
    }

    /// Whether it stands.
    pub(crate) fn stands(self) -> bool {
        self.0 < RESTING
    }
}

/// Evidence of measurements against a vehicle at rest: excess of normalised squared innovations over the last quarter
/// of a second. A vehicle that drives off slowly under a hovering helicopter stays inside every gate: the filter, which
/// is certain that it stands, attributes its motion to the helicopter.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct Unrest {
    /// Sum of the residuals, each of variance one where the vehicle stands, and the variance of that sum.
    sum: f64,
    var: f64,
    last: Option<MonoTime>,
}

/// Memory, s; the most that one measurement counts; and the sigmas that no vehicle at rest reaches.
const UNREST_S: f64 = 0.25;
const MOST_UNREST: f64 = 4.0;
const UNREST_SIGMAS: f64 = 6.0;

impl Unrest {
    /// Takes a normalised squared innovation of `m` components; whether the vehicle has begun to move.
    pub(crate) fn take(&mut self, squared: f64, m: usize, t: MonoTime) -> bool {
        if !squared.is_finite() {
            return false;
        }
        let since_s = self.last.map_or(0.0, |last| (t - last).s().max(0.0));
        self.last = Some(t);
        let keep = (-since_s / UNREST_S).exp();
        let m = m as f64;
        self.sum = keep * self.sum + ((squared - m) / (2.0 * m).sqrt()).min(MOST_UNREST);
        self.var = keep * keep * self.var + 1.0;
        self.sum > UNREST_SIGMAS * self.var.sqrt()
    }
}

impl Core {
    /// A marker was compared with its standing vehicle's place: a vehicle that begins to move is woken.
    pub(crate) fn note_marker_unrest(&mut self, target: usize, outcome: &Outcome) {
        let (m, t) = (self.z.m, self.state.t);
        let squared = outcome.ratio * self.models.gates[m];
        let track = &mut self.state.targets[target];
        if track.standstill.stands() && track.unrest.take(squared, m, t) {
            self.state.rouse(&self.learning, target);
        }
    }

    /// The receiver's velocity was compared with the velocity over standing vehicles: if they differ, the vehicles
    /// move.
    pub(crate) fn note_velocity_unrest(&mut self, outcome: &Outcome) {
        let (m, t) = (self.z.m, self.state.t);
        let squared = outcome.ratio * self.models.gates[m];
        if !self.state.unrest.take(squared, m, t) {
            return;
        }
        for target in 0..self.state.targets.len() {
            let track = &self.state.targets[target];
            if track.standstill.stands() && (t - track.last_seen).s() < 1.0 {
                self.state.rouse(&self.learning, target);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vehicle_stands_after_a_second_of_small_tests_and_moves_at_one_large_one() {
        let mut rest = Standstill::MOVES;
        let mut frames = 0;
        while !rest.stands() {
            rest.take(2.0, 0.1);
            frames += 1;
        }
        // The mean falls from 20 toward 2 by a fifth a frame.
        assert!((10..20).contains(&frames), "{frames} frames of a tenth of a second");
        rest.take(1e6, 0.1);
        assert!(!rest.stands());
    }

    #[test]
    fn it_is_woken_within_a_third_of_a_second_of_innovations_too_large() {
        let frame = |n: u32| MonoTime::from_ns(1_000_000_000 + i64::from(n) * 66_666_667);
        let mut rest = Unrest::default();
        // Two tags a frame; squares of eight components as they are at rest, and one frame that is badly seen.
        let wild = |n: u32| if n == 40 { 300.0 } else { 4.0 + f64::from(n % 5) * 2.0 };
        assert!((0..200).all(|n| !rest.take(wild(n), 8, frame(n)) && !rest.take(8.0, 8, frame(n))));
        let woken = (200..).position(|n| rest.take(24.0, 8, frame(n)) | rest.take(24.0, 8, frame(n)));
        assert!(woken.is_some_and(|frames| frames < 5), "{woken:?} frames");
    }
}
