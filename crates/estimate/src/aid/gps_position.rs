//! GPS position: `z = p + R l + b − vₐ τ + ½ a τ²`, with the velocity vₐ of the antenna at l and the delay τ. Where tags have
//! shown the ground to lie lower than configured (`height.rs`), heights are less by that.
//!
//! Left out of the Jacobian, since it is small beside a fix's metre of noise (`jacobians.rs` holds the bounds): what
//! τ and ½ τ² make of attitude and trim (0.25 m/rad), rate (0.12 m per rad/s), forces (0.01 m per m/s²) and drag
//! (0.09 m per 1/s), and ½ τ² c of velocity (0.5 %), at 0.15 s, 8 m/s, 1 rad/s and 0.8 m of lever arm.

use nalgebra::{Matrix3, Vector3};

use windhover_base::geo::skew;
use windhover_base::msg::{Disposition, FusionSource};

use super::{Aid, counted, gps_velocity};
use crate::blocks::own;
use crate::core::Core;
use crate::fitted::blend_factor;
use crate::force::Force;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::state::State;

/// The antenna's position as the receiver has it, NED, m.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GpsPosition {
    pub(crate) ned_m: Vector3<f64>,
    pub(crate) has_height: bool,
}

/// Variance of height over that of the other two: satellites are only above.
const HEIGHT_FACTOR: f64 = 4.0;

impl Aid for GpsPosition {
    const SOURCE: FusionSource = FusionSource::GpsPosition;

    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let own = &state.own;
        let antenna = own.antenna(&models.antenna_at);
        let arm = own.ned_from_body * antenna;
        let velocity = own.velocity_of(&antenna);
        let tau = own.gps_delay_s;
        let acceleration = Force::of(own).acceleration();
        let expected = own.position + arm + own.gps_bias - velocity * tau + acceleration * (0.5 * tau * tau);
        let noise_var = state.senses.gps_noise_var * state.learnt.gps_factor;
        z.begin(if self.has_height { 3 } else { 2 });
        z.block(own::POSITION, &Matrix3::identity());
        z.block(own::VELOCITY, &Matrix3::from_diagonal_element(-tau));
        z.block(own::ATTITUDE, &-skew(&arm));
        let d_arm = own.rotation() * (Matrix3::identity() - skew(&own.rate) * tau);
        z.block(own::ARM, &d_arm.fixed_columns::<2>(0).into_owned());
        z.block(own::GPS_BIAS, &Matrix3::identity());
        z.block(own::GPS_DELAY, &(-velocity + acceleration * tau));
        for i in 0..z.m {
            let lower_m = if i == 2 { state.ground_lower_m } else { 0.0 };
            z.residual[i] = self.ned_m[i] - lower_m - expected[i];
            z.noise[i][i] = noise_var * if i == 2 { HEIGHT_FACTOR } else { 1.0 };
        }
        Ok(())
    }
}

impl GpsPosition {
    /// Fuses it; after too many outside the gate the receiver has jumped (`anchor.rs`).
    pub(crate) fn fuse(&self, core: &mut Core) {
        if !core.expect_aid(self) {
            return;
        }
        let error = core.receiver_error();
        let outcome = core.fuse_gated(Self::SOURCE);
        if core.teaches(&outcome) {
            let factor = &mut core.state.learnt.gps_factor;
            blend_factor(factor, outcome.misfit, gps_velocity::SAMPLES, gps_velocity::FACTORS);
        }
        let rejections = &mut core.state.rejections;
        rejections.gps_position = counted(rejections.gps_position, outcome.ratio);
        let before = std::mem::replace(&mut rejections.gps_error, error);
        if rejections.gps_position >= core.restart_after {
            core.follow_jump(self, &before);
        }
    }
}
