//! Side slip of a vehicle, fitted in flight: one that slides does not go where it points.
//!
//! A frame moves the vehicle's place across its heading, as seen from the helicopter, by `d`; an honest filter has
//! `E[d²] = P⁻ − P⁺` of that place. Where it is more the walk across grows, and where it is not it falls back to what is
//! configured: of a vehicle that rolls nothing is given away.

use nalgebra::{Matrix2, Vector2};

use super::blocks::own;
use super::state::State;

/// Time over which it is fitted, s.
const OVER_S: f64 = 1.5;
/// Mean of d² over what is due beyond which slip grows: what other errors of the model make.
const LEAST_RATIO: f64 = 3.0;
/// Most, as a factor on the walk configured.
const MOST: f64 = 50.0;
/// Factor on its intensity for each frame outside the gate.
const OPENED: f64 = 30.0;
/// Time over which a slide is averaged that is reported, s, and how many times the walk configured it must be.
const SHOWN_S: f64 = 3.0;
const SHOWN: f64 = 1.5;
/// Least share of the variance that a frame must have found out.
const LEAST_FOUND: f64 = 0.3;

/// Slip of one vehicle.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct Slip {
    /// Logarithm of the walk's intensity over that configured.
    growth: f64,
    /// Its mean over [`SHOWN_S`].
    mean_growth: f64,
}

impl Slip {
    /// Factor on the configured intensity.
    pub(crate) fn factor(self) -> f64 {
        self.growth.exp()
    }

    /// A vehicle that leaves the gate in all its markers, frame after frame, may be sliding: the walk across is what a slide
    /// needs at once.
    pub(crate) fn open(&mut self) {
        self.growth = (self.growth + OPENED.ln()).min(2.0 * MOST.ln());
    }

    /// The walk over that configured, its mean over some seconds; `None` where that is not beyond doubt.
    pub(crate) fn shown(self) -> Option<f64> {
        let times = (0.5 * self.mean_growth).exp();
        (times > SHOWN).then_some(times)
    }

    /// Takes a frame's d² over what was due.
    fn take(&mut self, ratio: f64, since_s: f64) {
        if ratio.is_finite() && ratio > 0.0 {
            // Never beyond what explains this one.
            let step = (since_s / OVER_S * (ratio - LEAST_RATIO)).min(ratio.ln().max(0.0));
            self.growth = (self.growth + step).clamp(0.0, 2.0 * MOST.ln());
            self.mean_growth += (since_s / SHOWN_S).min(1.0) * (self.growth - self.mean_growth);
        }
    }
}

/// Where a vehicle was across its heading before a frame was fused.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Across {
    direction: Vector2<f64>,
    from_us: Vector2<f64>,
    var: f64,
}

impl Across {
    /// Its variance then, m².
    pub(crate) fn var(&self) -> f64 {
        self.var
    }

    /// How far the vehicle has moved across its heading of then, m.
    pub(crate) fn moved(&self, now: &Self) -> f64 {
        self.direction.dot(&(now.from_us - self.from_us))
    }
}

impl State {
    /// Where target `i` is across its heading.
    pub(crate) fn across(&self, i: usize) -> Across {
        let [north, east, heading, ..] = self.targets[i].mean;
        let (sin, cos) = heading.sin_cos();
        let direction = Vector2::new(-sin, cos);
        let from_us = Vector2::new(north, east) - self.own.position.xy();
        Across { direction, from_us, var: self.var_from_us(i, &direction) }
    }

    /// The present variance of the place of target `i` across its heading as it was before.
    pub(crate) fn across_var(&self, i: usize, before: &Across) -> f64 {
        self.var_from_us(i, &before.direction)
    }

    /// Variance of target `i`'s place, as seen from the helicopter, in a direction.
    fn var_from_us(&self, i: usize, direction: &Vector2<f64>) -> f64 {
        let (place, us) = (self.layout().target(i).place(), own::POSITION.part::<2>(0));
        let both: Matrix2<f64> = self.cov.block(place, place) + self.cov.block(us, us)
            - self.cov.block(place, us)
            - self.cov.block(us, place);
        direction.dot(&(both * direction))
    }
}

impl State {
    /// Fits target `i`'s slip by what a frame has made of where it was; `since_s` is the time since it was seen before.
    pub(crate) fn learn_slip(&mut self, i: usize, before: &Across, since_s: f64) {
        let found = before.var - self.across_var(i, before);
        if found < LEAST_FOUND * before.var {
            return;
        }
        let moved = before.moved(&self.across(i));
        self.targets[i].slip.take(moved * moved / found, since_s);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slip_grows_where_a_vehicle_slides_and_falls_back() {
        let mut slip = Slip::default();
        // Squares that an honest filter sees: 1 on average.
        for ratio in [0.1, 2.5, 0.3, 1.1, 0.0, 3.5, 0.2, 0.8] {
            slip.take(ratio, 0.1);
        }
        assert!(slip.factor() < 1.1, "{slip:?}");
        (0..5).for_each(|_| slip.take(100.0, 0.1));
        assert!(slip.factor() > 1e3, "{slip:?}");
        (0..200).for_each(|_| slip.take(1.0, 0.1));
        assert_eq!(slip.factor(), 1.0);
    }
}
