//! What the filter makes of what its sensors are found to be: of the tilt sensor (`kind.rs`), and of the quality of fixes.

use nalgebra::{Vector2, Vector3};

use windhover_base::msg::FixKind;
use windhover_base::time::MonoTime;

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

/// What the error of a fix by codes reaches at its best, one sigma, m: corrections of satellites leave so much.
const CODE_M: f64 = 0.5;

/// Which kind of RTK a fix is of, if any.
fn is_rtk(fix: FixKind) -> Option<FixKind> {
    (fix >= FixKind::RtkFloat).then_some(fix)
}

impl Senses {
    /// Takes the slow errors of tilt readings from what the sensors are found to feel.
    pub(crate) fn of_tilt(&mut self, tilt: &[TiltWatch; 2]) {
        (self.tilt_error_var, self.tilt_error_tau_s) = tilt[COMPASS].reading_error();
        (self.second_error_var, self.second_error_tau_s) = tilt[SECOND].reading_error();
    }

    /// Takes variances of bias and noise from the quality of a fix, and from the errors the receiver states, if any:
    /// `stated_m`, one sigma. These replace what is configured, down to what a fix of its kind reaches.
    pub(crate) fn of_fix(
        &mut self,
        fix: FixKind,
        stated_m: Option<Vector3<f64>>,
        fitted: f64,
        models: &Models,
    ) {
        let (bias_m, noise_m) = match fix {
            FixKind::RtkFixed => RTK_FIXED_M,
            FixKind::RtkFloat => RTK_FLOAT_M,
            FixKind::None | FixKind::TwoD | FixKind::ThreeD => (f64::INFINITY, f64::INFINITY),
        };
        let share = (bias_m.powi(2) / models.gps_bias_var.x).min(1.0);
        let usual = models.gps_bias_var * share;
        let reached = usual.map(|var| var.min(CODE_M.powi(2)));
        let bias = stated_m.map_or(usual, |stated| stated.component_mul(&stated).sup(&reached));
        self.fix = fix;
        self.gps_bias_var = (bias * fitted).into();
        // What is noisier as a whole is noisier from fix to fix.
        self.gps_noise_var = models.gps_noise_var.min(noise_m.powi(2)) * (bias.x / usual.x).max(1.0);
    }

    /// Begins with a bias that may be all it is said to be.
    pub(crate) fn hold_bias(&mut self, t: MonoTime) {
        (self.gps_bias_held_var, self.gps_bias_held_at) = (self.gps_bias_var, t);
    }

    /// Follows what the receiver says of its errors; by how much the bias may have grown at once, m². What it was before
    /// fades as the filter's own bias does, so that figures which go up and down add nothing.
    fn follow_bias(&mut self, t: MonoTime, tau_s: f64) -> [f64; 3] {
        let fade = (-2.0 * (t - self.gps_bias_held_at).s().max(0.0) / tau_s).exp();
        self.gps_bias_held_at = t;
        std::array::from_fn(|i| {
            let (stated, held) = (self.gps_bias_var[i], &mut self.gps_bias_held_var[i]);
            let before = stated + (*held - stated) * fade;
            *held = before.max(stated);
            *held - before
        })
    }
}

impl Core {
    /// Appearance at the quality of a fix: where its kind changes, the receiver's error is another one; where it is said to be
    /// larger, it may have grown.
    pub(crate) fn sense_fix(&mut self, fix: FixKind, stated_m: Option<Vector3<f64>>) {
        let (state, models) = (&mut self.state, &self.models);
        let (before, t) = (state.senses, state.t);
        state.senses.of_fix(fix, stated_m, state.learnt.receiver.factor(), models);
        let bias_var = state.senses.gps_bias_var;
        if is_rtk(fix) != is_rtk(before.fix) && bias_var != before.gps_bias_var {
            state.senses.hold_bias(t);
            state.own.gps_bias = Vector3::zeros();
            state.renew(own::GPS_BIAS, &bias_var);
        } else {
            let grown = state.senses.follow_bias(t, models.tau.gps_bias_s);
            state.cov.add_diagonal(own::GPS_BIAS, &grown);
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
        let (fitted, modelled) = (self.learnt.tilt_error_var, self.senses.tilt_error_var);
        self.learnt.tilt_error_var = if self.is_blind() { modelled } else { fitted.min(modelled) };
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
        let readings = || self.tilt.iter().filter_map(|watch| Some((watch, watch.last_down()?)));
        let Some((watch, down)) = readings().find(|(w, _)| !undecided(w)).or(readings().next()) else {
            return;
        };
        let ahead = self.own.rotation().column(0);
        let (attitude, var) = (watch.attitude(ahead.y.atan2(ahead.x), &down), watch.tilt_var());
        self.own.ned_from_body = attitude;
        let level: Block<2> = own::ATTITUDE.part(0);
        self.renew(level, &[var; 2]);
    }
}

#[cfg(test)]
mod tests {
    use windhover_base::time::Span;

    use super::*;

    #[test]
    fn a_bias_that_is_said_to_be_larger_grows_once() {
        let mut senses = Senses { gps_bias_var: [1.0; 3], ..Senses::default() };
        let mut t = MonoTime::from_ns(1_000_000_000_000);
        senses.hold_bias(t);
        let mut grown = 0.0;
        for fix in 0..500 {
            t += Span::from_s(0.2);
            senses.gps_bias_var = [if fix % 2 == 0 { 1.4 } else { 1.0 }; 3];
            grown += senses.follow_bias(t, 100.0)[0];
        }
        // 0.4 at once, and what fades in between.
        assert!((0.4..1.0).contains(&grown), "{grown}");
        senses.gps_bias_var = [100.0; 3];
        assert!(
            senses.follow_bias(t, 100.0)[1] > 98.0,
            "a receiver that loses its satellites is believed at once"
        );
        senses.gps_bias_var = [1.0; 3];
        assert_eq!(senses.follow_bias(t, 100.0), [0.0; 3], "what grew does not vanish");
        senses.gps_bias_var = [50.0; 3];
        assert_eq!(senses.follow_bias(t, 100.0), [0.0; 3], "it is still that large");
    }
}
