//! GPS velocity: `z = v + R (ω × l) − a (τ + τᵥ) + j (½ τ² + τ τᵥ + τᵥ²)`, with the antenna at l, acceleration a and jerk j
//! (`force.rs`), the delay τ of positions, and the time constant τᵥ of a first-order low-pass that the receiver applies to velocity:
//! the series of `exp(−s τ) / (1 + s τᵥ)` to second order.
//!
//! The second order matters where a receiver filters over some tenths of a second: jerk comes of the helicopter's turning, so
//! that what is left out is correlated with what the camera and the compass show (0.3 s: NEES of heading 2.9, with it 1.6).

use nalgebra::{Matrix3, Vector3};

use windhover_base::geo::skew;
use windhover_base::msg::{Disposition, FusionSource, MisfitCause};

use super::{Aid, counted};
use crate::blocks::own;
use crate::core::Core;
use crate::fitted::blend_factor;
use crate::force::{D_WIND, Force};
use crate::measurement::Measurement;
use crate::models::Models;
use crate::state::State;

/// The antenna's velocity as the receiver has it, NED, m/s.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GpsVelocity {
    pub(crate) ned_mps: Vector3<f64>,
    pub(crate) has_down: bool,
    /// One-sigma as the receiver puts it; what is configured holds where that is more.
    pub(crate) sigma_mps: Option<Vector3<f64>>,
}

/// Fixes the fitted noise of the receiver remembers: ten seconds at 5 Hz.
pub(super) const SAMPLES: f64 = 50.0;
/// Limits of the factor on the variance of the receiver's noise. What it filters is not white, so little is made of a
/// small residual.
pub(super) const FACTORS: (f64, f64) = (0.25, 25.0);

/// A time constant of the receiver's low-pass below this is usual, s; and in how many of its sigmas it must be known to be
/// reported.
const LOW_PASS_S: f64 = 0.1;
const LOW_PASS_SIGMAS: f64 = 4.0;

impl Aid for GpsVelocity {
    const SOURCE: FusionSource = FusionSource::GpsVelocity;

    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let own = &state.own;
        let (delay, low_pass) = (own.gps_delay_s, own.velocity_delay_s);
        let tau = own.velocity_age_s();
        let second = 0.5 * delay * delay + low_pass * tau;
        let force = Force::of(own);
        let (acceleration, jerk) = (force.acceleration(), force.jerk(own));
        let antenna = own.antenna(&models.antenna_at);
        let expected = own.velocity_of(&antenna) - acceleration * tau + jerk * second;
        let swing = own.ned_from_body * own.rate.cross(&antenna);
        z.begin(if self.has_down { 3 } else { 2 });
        z.block(own::VELOCITY, &Matrix3::from_diagonal_element(1.0 + own.drag_per_s * tau));
        z.block(own::ATTITUDE, &(-skew(&swing) - force.d_attitude * tau));
        z.block(own::RATE, &(-own.rotation() * skew(&antenna) + force.d_attitude * own.rotation() * second));
        let d_arm = own.rotation() * skew(&own.rate);
        z.block(own::ARM, &d_arm.fixed_columns::<2>(0).into_owned());
        z.block(own::GUST, &(D_WIND * -tau));
        z.block(own::THRUST, &(force.d_thrust * -tau));
        z.block(own::WIND, &(D_WIND * -tau));
        z.block(own::TRIM, &(force.d_trim * -tau));
        z.block(own::GPS_DELAY, &(jerk * tau - acceleration));
        z.block(own::VELOCITY_DELAY, &(jerk * (delay + 2.0 * low_pass) - acceleration));
        z.block(own::DRAG, &(force.d_drag * -tau));
        let colour = state.colour_factor(Self::SOURCE);
        for i in 0..z.m {
            z.residual[i] = self.ned_mps[i] - expected[i];
            let reported_var = self.sigma_mps.map_or(0.0, |sigma| sigma[i].powi(2));
            z.noise[i][i] =
                models.gps_velocity_var.max(reported_var) * state.learnt.gps_velocity_factor * colour;
        }
        Ok(())
    }
}

impl Core {
    /// The low-pass that the receiver applies to velocity, where it is beyond doubt: its time constant, s.
    pub(crate) fn low_pass_misfit(&self) -> Option<(FusionSource, MisfitCause, f64)> {
        let (low_pass_s, sigma_s) =
            (self.state.own.velocity_delay_s, self.state.cov.sigma(own::VELOCITY_DELAY, 0));
        let beyond = low_pass_s > LOW_PASS_S.max(LOW_PASS_SIGMAS * sigma_s);
        beyond.then_some((GpsVelocity::SOURCE, MisfitCause::Filtered, low_pass_s))
    }
}

impl GpsVelocity {
    /// Fuses it; after too many outside the gate velocity is what the receiver says, and what features ride on moves.
    pub(crate) fn fuse(&self, core: &mut Core) {
        let colour = core.state.colour_factor(Self::SOURCE);
        let Some(outcome) = core.fuse_aid(self) else { return };
        core.judge_scale(&outcome);
        core.judge_antenna();
        core.note_velocity_unrest(&outcome);
        if core.teaches(&outcome) {
            blend_factor(
                &mut core.state.learnt.gps_velocity_factor,
                colour * outcome.misfit,
                SAMPLES,
                FACTORS,
            );
        }
        let state = &mut core.state;
        state.rejections.gps_velocity = counted(state.rejections.gps_velocity, outcome.ratio);
        if state.rejections.gps_velocity >= core.restart_after {
            core.distrust_ground();
            let state = &mut core.state;
            state.rejections.gps_velocity = 0;
            state.renew(own::VELOCITY, &[4.0; 3]);
            state.own.velocity = self.ned_mps;
        }
    }
}
