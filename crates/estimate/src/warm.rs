//! Out of one filter into the next: what is learnt of the sensors outlives a restart.

use windhover_base::msg::{WARM_STATES, WarmFilter};
use windhover_base::time::MonoTime;

use super::learn::{LEAST, Learning, MOST};
use super::models::Models;
use super::state::{State, at};

/// A state whose age cannot be told (the computer's clock was stepped) counts as this old, s.
const UNKNOWN_AGE_S: f64 = 3600.0;

impl State {
    /// The sensors' slow errors with their covariance, and the fitted intensities.
    pub(super) fn warm(&self) -> WarmFilter {
        let (own, l) = (&self.own, &self.learnt);
        WarmFilter {
            t_ns: self.t.ns(),
            mean: [
                own.gps_bias.x,
                own.gps_bias.y,
                own.gps_bias.z,
                own.heading_bias,
                own.tilt_gain,
                own.tilt_bias.x,
                own.tilt_bias.y,
                own.gps_delay_s,
                own.drag_per_s,
            ],
            covariance: std::array::from_fn(|i| {
                std::array::from_fn(|j| self.cov.at(at::GPS_BIAS + i, at::GPS_BIAS + j))
            }),
            fitted: [l.tilt_rate_q, l.yaw_rate_q, l.side_force_var, l.thrust_var, l.tilt_var, l.heading_var],
        }
    }

    /// Puts an earlier filter's sensors in the place of the prior of a state that was just started.
    /// They have aged meanwhile: each uncertainty grows as it does in flight, up to the prior's.
    pub(super) fn resume(&mut self, warm: &WarmFilter, models: &Models, learning: &Learning) {
        let age_s = (self.t - MonoTime::from_ns(warm.t_ns)).s();
        let age_s = if (0.0..UNKNOWN_AGE_S).contains(&age_s) { age_s } else { UNKNOWN_AGE_S };
        let decay = (-age_s / models.tau.gps_bias_s).exp();
        let scale = |i: usize| if i < 3 { decay } else { 1.0 };
        let walk = &models.walk;
        let grown = [
            models.gps_bias_var[0] * (1.0 - decay * decay),
            models.gps_bias_var[1] * (1.0 - decay * decay),
            models.gps_bias_var[2] * (1.0 - decay * decay),
            walk.heading_bias_q * age_s,
            walk.tilt_gain_q * age_s,
            walk.tilt_bias_q * age_s,
            walk.tilt_bias_q * age_s,
            walk.gps_delay_q * age_s,
            0.0,
        ];
        for i in 0..WARM_STATES {
            for j in 0..WARM_STATES {
                let own = if i == j { grown[i] } else { 0.0 };
                let value = scale(i) * scale(j) * warm.covariance[i][j] + own;
                self.cov.set(at::GPS_BIAS + i, at::GPS_BIAS + j, value);
            }
        }
        self.adopt_means(warm, decay);
        self.tie_heading();
        let (l, s) = (&mut self.learnt, &learning.start);
        let places = [
            (&mut l.tilt_rate_q, s.tilt_rate_q),
            (&mut l.yaw_rate_q, s.yaw_rate_q),
            (&mut l.side_force_var, s.side_force_var),
            (&mut l.thrust_var, s.thrust_var),
            (&mut l.tilt_var, s.tilt_var),
            (&mut l.heading_var, s.heading_var),
        ];
        for ((place, start), value) in places.into_iter().zip(warm.fitted) {
            *place = value.clamp(start * LEAST * LEAST, start * (MOST * MOST).max(400.0));
        }
    }

    /// Means; heading and tilt were read off the compass as if it had no error.
    fn adopt_means(&mut self, warm: &WarmFilter, decay: f64) {
        let own = &mut self.own;
        let [north, east, down, heading, gain, pitch, roll, delay, drag] = warm.mean;
        own.gps_bias = nalgebra::Vector3::new(north, east, down) * decay;
        own.heading_bias = heading;
        own.tilt_gain = gain;
        own.tilt_bias = nalgebra::Vector2::new(pitch, roll);
        own.gps_delay_s = delay;
        own.drag_per_s = drag;
        let turned = nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::z_axis(), -heading);
        own.ned_from_body = turned * own.ned_from_body;
    }

    /// Heading is the reading less the bias: where the one errs, so does the other.
    fn tie_heading(&mut self) {
        let (turn, bias) = (at::ATTITUDE + 2, at::HEADING_BIAS);
        let reading_var = super::ownship::START_HEADING.powi(2);
        self.cov.set(turn, turn, self.cov.at(bias, bias) + reading_var);
        for i in at::GPS_BIAS..at::GPS_BIAS + WARM_STATES {
            let value = -self.cov.at(bias, i);
            self.cov.set(turn, i, value);
            self.cov.set(i, turn, value);
        }
    }
}
