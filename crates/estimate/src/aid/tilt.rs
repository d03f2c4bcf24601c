//! Compass tilt: `z = k (−d₁, d₂) + b`, where d is down in the body frame and k how much of the tilt the
//! sensor reads: 1 on the ground, little on a rotorcraft, whose tilt sensor feels specific force.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};

use windhover_base::geo::skew;
use windhover_base::msg::{Disposition, FusionSource};

use super::compass::SAMPLE_GAIN_S;
use super::{Aid, counted};
use crate::blocks::own;
use crate::core::Core;
use crate::fitted::blend_noise;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::state::State;

/// Down in the body frame as the sensor has it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TiltReading {
    pub(crate) down: Vector3<f64>,
}

/// Signs of down's first two components in pitch and roll.
const SIGNS: [f64; 2] = [-1.0, 1.0];

/// Limits of the fitted variance, as factors on that configured.
const LIMITS: (f64, f64) = (0.25, 400.0);

/// Readings over which the product of the errors of gain and tilt stays what it is: two seconds of a
/// 30 Hz compass. Its variance counts so many times, since it does not average out.
const UNTIED: f64 = 60.0;

impl Aid for TiltReading {
    const SOURCE: FusionSource = FusionSource::CompassTilt;

    fn linearise(&self, state: &State, _models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let own = &state.own;
        let body_from_ned: Matrix3<f64> = own.rotation().transpose();
        let d = body_from_ned.column(2).into_owned();
        let d_attitude = body_from_ned * skew(&Vector3::z());
        let k = own.tilt_gain;
        z.begin(2);
        z.block(own::ATTITUDE, &Matrix2x3::from_fn(|i, j| k * SIGNS[i] * d_attitude[(i, j)]));
        z.block(own::TILT_GAIN, &Vector2::from_fn(|i, _| SIGNS[i] * d[i]));
        z.block(own::TILT_BIAS, &Matrix2::identity());
        for (i, sign) in SIGNS.into_iter().enumerate() {
            z.residual[i] = sign * self.down[i] - k * sign * d[i] - own.tilt_bias[i];
            z.noise[i][i] = state.learnt.tilt_var + UNTIED * product_var(state, i, &d_attitude);
        }
        Ok(())
    }
}

impl TiltReading {
    /// Fuses it; after too many outside the gate the sensor is trusted less, and its gain unknown again.
    pub(crate) fn fuse(&self, core: &mut Core) {
        let Some(outcome) = core.fuse_aid(self) else { return };
        if core.teaches(&outcome) {
            let start = core.learning.start.tilt_var;
            let gain = 0.5 * SAMPLE_GAIN_S / core.learning.over_s;
            let limits = (LIMITS.0 * start, LIMITS.1 * start);
            let value = &mut core.state.learnt.tilt_var;
            for (residual, innovation_var) in core.z.residual.into_iter().zip(outcome.innovation_var).take(2)
            {
                blend_noise(value, residual, innovation_var, gain, limits);
            }
        }
        let state = &mut core.state;
        state.rejections.tilt = counted(state.rejections.tilt, outcome.ratio);
        if state.rejections.tilt >= 6 * core.restart_after {
            state.rejections.tilt = 0;
            state.learnt.tilt_var *= 16.0;
            state.renew(own::TILT_GAIN, &[0.25]);
        }
    }
}

/// Variance of the product of the errors of tilt gain and of `d_i`, which the linear model leaves out:
/// as long as the gain is unknown, a reading near zero does not prove that the aircraft is level.
fn product_var(state: &State, i: usize, d_attitude: &Matrix3<f64>) -> f64 {
    let attitude = state.cov.block(own::ATTITUDE, own::ATTITUDE);
    let with_gain = state.cov.block(own::ATTITUDE, own::TILT_GAIN);
    let (mut tilt_var, mut mixed) = (0.0, 0.0);
    for a in 0..3 {
        for b in 0..3 {
            tilt_var += d_attitude[(i, a)] * d_attitude[(i, b)] * attitude[(a, b)];
        }
        mixed += d_attitude[(i, a)] * with_gain[a];
    }
    (state.cov.var(own::TILT_GAIN) * tilt_var + mixed * mixed).max(0.0)
}
