//! What the filter makes of what its sensors are found to be: of the tilt sensor (`kind.rs`), and of the quality of fixes.

use nalgebra::{Vector2, Vector3};

use windhover_base::msg::FixKind;

use super::blocks::{Block, own};
use super::core::Core;
use super::kind::{Felt, TiltWatch};
use super::models::Models;
use super::own::{COMPASS, PLACES, SECOND, Senses};
use super::state::State;

/// Bias and noise of fixes by carrier phases, one sigma, m: of known whole cycles, and of unknown ones. Where less is
/// configured, that holds.
const RTK_FIXED_M: (f64, f64) = (0.05, 0.03);
const RTK_FLOAT_M: (f64, f64) = (0.3, 0.1);

impl Senses {
    /// Takes the slow errors of tilt readings from what the sensors are found to feel.
    pub(crate) fn of_tilt(&mut self, tilt: &[TiltWatch; 2]) {
        (self.tilt_error_var, self.tilt_error_tau_s) = tilt[COMPASS].reading_error();
        (self.second_error_var, self.second_error_tau_s) = tilt[SECOND].reading_error();
    }

    /// Takes variances of bias and noise from the quality of a fix.
    pub(crate) fn of_fix(&mut self, fix: FixKind, models: &Models) {
        let (bias_m, noise_m) = match fix {
            FixKind::RtkFixed => RTK_FIXED_M,
            FixKind::RtkFloat => RTK_FLOAT_M,
            FixKind::None | FixKind::TwoD | FixKind::ThreeD => (f64::INFINITY, f64::INFINITY),
        };
        let share = (bias_m.powi(2) / models.gps_bias_var.x).min(1.0);
        self.fix = fix;
        self.gps_bias_var = (models.gps_bias_var * share).into();
        self.gps_noise_var = models.gps_noise_var.min(noise_m.powi(2));
    }
}

impl Core {
    /// Looks at the quality of a fix: where it changes, the receiver's error is another one.
    pub(crate) fn sense_fix(&mut self, fix: FixKind) {
        let (state, models) = (&mut self.state, &self.models);
        let before = state.senses;
        state.senses.of_fix(fix, models);
        if state.senses.gps_bias_var != before.gps_bias_var {
            state.own.gps_bias = Vector3::zeros();
            let bias_var = state.senses.gps_bias_var;
            state.renew(own::GPS_BIAS, &bias_var);
        }
    }

    /// Shows the receiver's velocity to what watches the tilt sensors, and follows what that decides.
    pub(crate) fn watch_tilt(&mut self, velocity: Vector2<f64>) {
        if self.at_truth {
            return;
        }
        let state = &mut self.state;
        for which in [COMPASS, SECOND] {
            if state.tilt[which].velocity(state.t, velocity) {
                state.feel_anew(which);
            }
        }
        state.sense();
    }
}

impl State {
    /// Takes the slow errors' intensities from what the sensors are found to be.
    pub(crate) fn sense(&mut self) {
        self.senses.of_tilt(&self.tilt);
        let (fitted, told) = (self.learnt.tilt_error_var, self.senses.tilt_error_var);
        self.learnt.tilt_error_var = if self.is_blind() { told } else { fitted.min(told) };
    }

    /// A tilt sensor feels something else than was thought: its errors start anew, and tilt too where nothing but the
    /// sensor tells it. Heading and all else stay.
    fn feel_anew(&mut self, which: usize) {
        if which == COMPASS {
            self.learnt.tilt_error_var = f64::INFINITY;
        }
        self.sense();
        let watch = self.tilt[which];
        if which == COMPASS {
            self.own.tilt_gain = watch.share;
            self.own.tilt_error = Vector2::zeros();
        } else {
            self.own.second.tilt_gain = watch.share;
            self.own.second.tilt_error = Vector2::zeros();
        }
        if self.is_blind() {
            self.read_tilt();
        }
        let places = &PLACES[which];
        let (error_var, _) = watch.reading_error();
        self.renew(places.tilt_error, &[error_var; 2]);
        self.renew(places.tilt_gain, &[watch.share_sigma.powi(2)]);
        self.rejections.tilt[which] = 0;
        self.past_motion.in_use = false;
    }

    /// Reads tilt off the sensor whose meaning is known best, anew.
    fn read_tilt(&mut self) {
        let undecided = |watch: &&TiltWatch| watch.felt == Felt::Undecided;
        let heard = || self.tilt.iter().filter_map(|watch| Some((watch, watch.last_down()?)));
        let Some((watch, down)) = heard().find(|(w, _)| !undecided(w)).or(heard().next()) else { return };
        let ahead = self.own.rotation().column(0);
        let (attitude, var) = (watch.attitude(ahead.y.atan2(ahead.x), &down), watch.tilt_var());
        self.own.ned_from_body = attitude;
        let level: Block<2> = own::ATTITUDE.part(0);
        self.renew(level, &[var; 2]);
    }
}
