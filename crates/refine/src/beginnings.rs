//! Priors of knots: where a trajectory or the estimation of a target begins, and of what is not estimated there.

use windhover_estimate::batch::SWAY_COLUMNS;

use crate::block::{Noise, Source};
use crate::front::Front;
use crate::motion::{sway_sources, sway_variances};
use crate::problem::Pass;
use crate::unknowns::knot;
use crate::values::Values;

/// Weak knowledge of a trajectory's first knot, one sigma: position m, velocity m/s, attitude rad, rate rad/s, angular
/// acceleration rad/s², wind m/s².
const FIRST: [f64; 6] = [1e4, 100.0, 1.0, 2.0, 10.0, 1.5];
/// The same for a target at the start of its estimation: place m, heading rad, speed m/s, yaw rate rad/s, acceleration
/// m/s², yaw acceleration rad/s², jerk m/s³, yaw jerk rad/s³.
const TAKEN_UP: [f64; knot::RIGID] = [1e4, 1e4, 10.0, 30.0, 5.0, 3.0, 3.0, 5.0, 5.0];
/// Sigma of speed, yaw rate and their derivatives of a target that does not move, in their units.
const STANDS: f64 = 1e-3;

impl Pass<'_> {
    /// Adds the priors of a knot: where a trajectory begins, and for quantities that are not estimated there.
    pub(crate) fn beginnings(&self, k: usize, values: &Values, noise: &Noise, front: &mut Front) -> f64 {
        let (stop, state) = (&self.problem.plan.stops[k], &values.knots[k]);
        let (at, p) = (self.problem.shape.knot_at(k), &self.problem.processes);
        let mut cost = 0.0;
        if stop.begins {
            let vague = [knot::POSITION, knot::VELOCITY, knot::ATTITUDE];
            for (first, sigma) in vague.into_iter().zip(FIRST) {
                (0..3).for_each(|i| front.add_prior(at + first + i, sigma.powi(-2), 0.0));
            }
            let mut about_zero = |first: usize, sigmas: &[f64]| {
                for (i, sigma) in sigmas.iter().enumerate() {
                    let (information, value) = (sigma.powi(-2), state.x[first + i]);
                    front.add_prior(at + first + i, information, -value);
                    cost += value * value * information;
                }
            };
            about_zero(knot::RATE, &[FIRST[3]; 3]);
            about_zero(knot::SPIN, &[FIRST[4]; 3]);
            about_zero(knot::GUST, &[noise.of(Source::Gust).sqrt(); 2]);
            about_zero(knot::THRUST, &[noise.of(Source::Thrust).sqrt()]);
            about_zero(knot::TILT_ERROR, &[p.tilt_error.0.sqrt(); 2]);
            about_zero(knot::WIND, &[FIRST[5]; 2]);
            about_zero(knot::GPS_BIAS, &p.gps_bias.0.map(f64::sqrt));
        }
        for target in 0..self.problem.targets {
            let first = at + knot::target(target);
            if !stop.held[target] {
                (0..knot::RIGID).for_each(|i| front.add_prior(first + i, 1.0, 0.0));
            } else {
                let sigmas = match (self.problem.moves[target], stop.taken_up[target]) {
                    (false, true) => [&TAKEN_UP[..3], &[STANDS; knot::RIGID - 3]].concat(),
                    (false, false) => [&[f64::INFINITY; 3][..], &[STANDS; knot::RIGID - 3]].concat(),
                    (true, true) => TAKEN_UP.to_vec(),
                    (true, false) => Vec::new(),
                };
                for (i, sigma) in sigmas.iter().enumerate() {
                    let (information, value) = (sigma.powi(-2), values.knots[k].target(target)[i]);
                    let pull = if i < 3 { 0.0 } else { value };
                    front.add_prior(first + i, information, -pull);
                    cost += pull * pull * information;
                }
            }
            cost += self.sway_begins(k, target, values, noise, front);
        }
        cost
    }

    /// Adds the prior of a target's sway where its estimation begins; where there is no sway it is zero.
    fn sway_begins(&self, k: usize, target: usize, values: &Values, noise: &Noise, front: &mut Front) -> f64 {
        let (stop, first) = (&self.problem.plan.stops[k], knot::target(target) + knot::SWAY);
        let at = self.problem.shape.knot_at(k) + first;
        let Some(height_m) = self.problem.sways[target].filter(|_| stop.held[target]) else {
            (0..SWAY_COLUMNS).for_each(|i| front.add_prior(at + i, 1.0, 0.0));
            return 0.0;
        };
        if !stop.taken_up[target] {
            return 0.0;
        }
        let mut cost = 0.0;
        for (i, (var, source)) in sway_variances(height_m).into_iter().zip(sway_sources(target)).enumerate() {
            let (information, value) = (1.0 / (var * noise.of(source)), values.knots[k].x[first + i]);
            front.add_prior(at + i, information, -value);
            cost += value * value * information;
        }
        cost
    }
}
