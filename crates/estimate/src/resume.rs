//! Out of one filter into the next: what was learnt of the sensors outlives a restart.

use nalgebra::{Rotation3, Vector3};

use windhover_base::msg::{WARM_STATES, WarmFilter};
use windhover_base::time::MonoTime;

use super::blocks::own;
use super::fitted::{LEAST, Learning, Learnt, MOST};
use super::models::Models;
use super::own::SENSOR_STATES;
use super::slow::Terms;
use super::start::START_HEADING;
use super::state::State;

/// A state whose age is not known (the computer's clock was stepped) counts as this old, s.
const UNKNOWN_AGE_S: f64 = 3600.0;

/// What is kept are the sensors' states, all of them.
const _: () = assert!(WARM_STATES == SENSOR_STATES);
/// Where the sensors' states begin among those that move by themselves.
const FIRST: usize = own::SENSORS.column(0) - own::SLOW.column(0);

/// The intensities that are kept, in the order of [`WarmFilter::fitted`].
fn fitted(learnt: &mut Learnt) -> [&mut f64; 6] {
    [
        &mut learnt.tilt_rate_q,
        &mut learnt.yaw_rate_q,
        &mut learnt.gust_var,
        &mut learnt.thrust_var,
        &mut learnt.tilt_var[0],
        &mut learnt.heading_var[0],
    ]
}

impl State {
    /// The sensors' slow errors with their covariance, and the fitted intensities.
    pub(crate) fn warm(&self) -> WarmFilter {
        let l = &self.learnt;
        WarmFilter {
            t_ns: self.t.ns(),
            mean: std::array::from_fn(|i| self.own.slow()[FIRST + i]),
            covariance: std::array::from_fn(|i| {
                std::array::from_fn(|j| self.cov.at(own::SENSORS.column(i), own::SENSORS.column(j)))
            }),
            fitted: [l.tilt_rate_q, l.yaw_rate_q, l.gust_var, l.thrust_var, l.tilt_var[0], l.heading_var[0]],
        }
    }

    /// Puts an earlier filter's sensors in the place of the prior of a state that was just started.
    /// They have aged meanwhile: each uncertainty grows as it does in flight, up to the prior's.
    pub(crate) fn resume(&mut self, warm: &WarmFilter, models: &Models, learning: &Learning) {
        let age_s = (self.t - MonoTime::from_ns(warm.t_ns)).s();
        let age_s = if (0.0..UNKNOWN_AGE_S).contains(&age_s) { age_s } else { UNKNOWN_AGE_S };
        let terms = Terms { models, learnt: &self.learnt, senses: &self.senses };
        let (decays, grown) = (terms.decays(age_s), terms.growth(age_s));
        // How much of the tilt is read goes with what the sensor is found to feel, and that begins anew.
        let share = own::TILT_GAIN.column(0) - own::SLOW.column(0);
        let kept = || (FIRST..FIRST + SENSOR_STATES).filter(|i| *i != share);
        for i in kept() {
            for j in kept() {
                let own = if i == j { grown[i] } else { 0.0 };
                let value = decays[i] * decays[j] * warm.covariance[i - FIRST][j - FIRST] + own;
                self.cov.set(own::SLOW.column(i), own::SLOW.column(j), value);
            }
        }
        self.own.change_slow(|i, mean| {
            if (FIRST..FIRST + SENSOR_STATES).contains(&i) && i != share {
                *mean = warm.mean[i - FIRST] * decays[i];
            }
        });
        // Heading was read off the compass as if it had no error.
        let turned = Rotation3::from_axis_angle(&Vector3::z_axis(), -self.own.heading_bias);
        self.own.ned_from_body = turned * self.own.ned_from_body;
        self.tie_heading();
        let mut start = learning.start.clone();
        let places = fitted(&mut self.learnt).into_iter().zip(fitted(&mut start));
        for ((place, start), value) in places.zip(warm.fitted) {
            *place = value.clamp(*start * LEAST * LEAST, *start * (MOST * MOST).max(400.0));
        }
    }

    /// Heading is the reading less the bias: where the one errs, so does the other.
    fn tie_heading(&mut self) {
        let (turn, bias) = (own::TURN.column(0), own::HEADING_BIAS.column(0));
        self.cov.set(turn, turn, self.cov.at(bias, bias) + START_HEADING.powi(2));
        for i in own::SENSORS.range() {
            let value = -self.cov.at(bias, i);
            self.cov.set(turn, i, value);
            self.cov.set(i, turn, value);
        }
    }
}
