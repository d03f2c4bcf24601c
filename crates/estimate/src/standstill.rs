//! Whether a vehicle stands still.

/// Sliding mean of the test `(v̂, ω̂) P⁻¹ (v̂, ω̂)ᵀ`, which is two on average for a vehicle at rest.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct Standstill(f64);

/// Time over which a vehicle must have stood still to be taken to stand, s.
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
}
