//! What the filter has found of its sensors and of motion: single figures, and all of it in a line of text.

use windhover_base::msg::FusionSource;

use super::blocks::own;
use super::filter::Estimator;

impl Estimator {
    /// How much older the receiver's velocity is than configured, as learnt so far, seconds: what motion shows best.
    pub fn gps_delay_s(&self) -> f64 {
        self.core.state.own.velocity_age_s()
    }

    /// Of a camera that was found to shake: displacement of rows in normalised coordinates and roll, rad, one sigma; and the time
    /// from the first row to the last, s.
    pub fn camera_shake(&self) -> Option<([f64; 2], f64)> {
        let state = &self.core.state;
        let readout_s = state.own.whole_readout_s(self.core.models.readout_s);
        state.shake.is_shown().then(|| (state.shake.sigmas(), readout_s))
    }

    /// One line on what the filter believes of the sensors and of the intensities of motion.
    pub fn inside(&self) -> String {
        let (own, l) = (&self.core.state.own, &self.core.state.learnt);
        let cov = &self.core.state.cov;
        let [shake_px, roll_px] =
            self.core.state.shake.sigmas().map(|sigma| sigma * self.core.models.camera.fx);
        let targets: Vec<String> =
            l.target_q.iter().map(|q| format!("{:.3}/{:.3}", q[0].sqrt(), q[1].sqrt())).collect();
        let colour = |source| self.core.state.colour_factor(source);
        format!(
            "heading bias {:.2}±{:.2} deg, tilt felt {:?} (slope {:.2}) gain {:.2}±{:.2} error {:.2},{:.2}±{:.2} deg \
             bias {:.2},{:.2}±{:.2} deg, trim {:.1},{:.1}±{:.1} deg, wind {:.2},{:.2}±{:.2} m/s2, drag {:.2}±{:.2}, delay {:.0}±{:.0} and {:.0}±{:.0} ms, compass {:.1}±{:.1} ms, camera {:.1} ms, read-out {:.1}±{:.1} ms, shake {:.2} px roll {:.2} px, lens {:.3?} k1 ±{:.3}, arm {:.2},{:.2}±{:.2} m, \
             sigma heading {:.2} tilt {:.2} deg, walks rate {:.2}/{:.2} gust {:.2} thrust {:.2} targets {} pixels {:.2?} {:.2} tags {}, colour velocity {:.2} heading {:.2}",
            own.heading_bias.to_degrees(),
            cov.sigma(own::HEADING_BIAS, 0).to_degrees(),
            self.core.state.tilt[0].felt,
            self.core.state.tilt[0].slope(),
            own.tilt_gain,
            cov.sigma(own::TILT_GAIN, 0),
            own.tilt_error.x.to_degrees(),
            own.tilt_error.y.to_degrees(),
            cov.sigma(own::TILT_ERROR, 0).to_degrees(),
            own.tilt_bias.x.to_degrees(),
            own.tilt_bias.y.to_degrees(),
            cov.sigma(own::TILT_BIAS, 0).to_degrees(),
            own.trim.x.to_degrees(),
            own.trim.y.to_degrees(),
            cov.sigma(own::TRIM, 0).to_degrees(),
            own.wind.x,
            own.wind.y,
            cov.sigma(own::WIND, 0),
            own.drag_per_s,
            cov.sigma(own::DRAG, 0),
            own.gps_delay_s * 1e3,
            cov.sigma(own::GPS_DELAY, 0) * 1e3,
            own.velocity_delay_s * 1e3,
            cov.sigma(own::VELOCITY_DELAY, 0) * 1e3,
            own.compass_delay_s * 1e3,
            cov.sigma(own::COMPASS_DELAY, 0) * 1e3,
            self.core.state.camera_late_s * 1e3,
            own.readout_s * 1e3,
            cov.sigma(own::READOUT, 0) * 1e3,
            shake_px,
            roll_px,
            own.lens.as_slice(),
            cov.sigma(own::LENS, 0),
            own.arm.x,
            own.arm.y,
            cov.sigma(own::ARM, 0),
            l.heading_var[0].sqrt().to_degrees(),
            l.tilt_var[0].sqrt().to_degrees(),
            l.tilt_rate_q.sqrt(),
            l.yaw_rate_q.sqrt(),
            l.gust_var.sqrt(),
            l.thrust_var.sqrt(),
            targets.join(" "),
            l.marker_factor,
            l.feature_factor,
            self.core.state.tags_in_words(),
            colour(FusionSource::GpsVelocity),
            colour(FusionSource::CompassHeading)
        )
    }
}
