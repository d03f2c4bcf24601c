//! Tilt of the compass, or of the second source of attitude: `z = k (−w₁, w₂) + b + e` with a constant bias b and a
//! slow error e. What w is depends on what the sensor measures (`kind.rs`): down in the body frame `d = Rᵀ e_D` where
//! it measures attitude, or a share k of it; against the specific force, `u = −Rᵀ f/|f|`, where it measures that. In
//! steady flight the two are the same; only acceleration parts them. A sensor of unknown kind is taken as one that
//! tells attitude, with an error e that covers the others.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, SMatrix, Vector2, Vector3};

use windhover_base::geo::skew;
use windhover_base::msg::{Disposition, FusionSource};

use super::compass::{SAMPLE_GAIN_S, set_delay};
use super::{Aid, counted};
use crate::blocks::own;
use crate::core::Core;
use crate::fitted::blend_noise;
use crate::force::{D_WIND, Force};
use crate::kind::Felt;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::own::{Own, PLACES, SECOND};
use crate::state::State;

/// Down in the body frame as the sensor of the compass (0) or of the second source of attitude (1) has it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TiltReading<const WHICH: usize> {
    pub(crate) down: Vector3<f64>,
}

/// Signs of down's first two components in pitch and roll.
const SIGNS: [f64; 2] = [-1.0, 1.0];

/// Limits of the fitted variance, as factors on that configured.
const LIMITS: (f64, f64) = (0.25, 400.0);

impl<const WHICH: usize> Aid for TiltReading<WHICH> {
    const SOURCE: FusionSource =
        if WHICH == SECOND { FusionSource::AttitudeTilt } else { FusionSource::CompassTilt };

    fn linearise(&self, state: &State, _models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let (own, places, errors) = (&state.own, &PLACES[WHICH], state.own.errors_of(WHICH));
        let gain = errors.tilt_gain;
        z.begin(2);
        let (felt, turned) = match state.tilt[WHICH].felt {
            Felt::Force => set_force(own, gain, z),
            Felt::Undecided | Felt::Attitude | Felt::Share => set_down(own, gain, z),
        };
        z.block(places.tilt_gain, &Vector2::from_fn(|i, _| SIGNS[i] * felt[i]));
        z.block(places.tilt_bias, &Matrix2::identity());
        z.block(places.tilt_error, &Matrix2::identity());
        for (i, sign) in SIGNS.into_iter().enumerate() {
            let error = errors.tilt_bias[i] + errors.tilt_error[i];
            z.residual[i] = sign * (self.down[i] - gain * felt[i]) - error;
            z.noise[i][i] = state.learnt.tilt_var[WHICH];
        }
        set_delay(z, WHICH, own, &turned);
        Ok(())
    }
}

/// Writes what down in the body frame depends on, and gives it with the derivative of the reading by attitude.
fn set_down(own: &Own, gain: f64, z: &mut Measurement) -> (Vector3<f64>, Matrix2x3<f64>) {
    let body_from_ned: Matrix3<f64> = own.rotation().transpose();
    let turned = in_reading(gain, &(body_from_ned * skew(&Vector3::z())));
    z.block(own::ATTITUDE, &turned);
    (body_from_ned.column(2).into_owned(), turned)
}

/// Writes what the direction against the specific force depends on, and gives it with the derivative by attitude:
/// `∂u = −(I − u uᵀ)/|f| Rᵀ (∂f + f × ∂δ)`.
fn set_force(own: &Own, gain: f64, z: &mut Measurement) -> (Vector3<f64>, Matrix2x3<f64>) {
    let force = Force::of(own);
    let size = force.ned.norm().max(LEAST_FORCE);
    let body_from_ned: Matrix3<f64> = own.rotation().transpose();
    let felt = -(body_from_ned * force.ned) / size;
    let d_force = (felt * felt.transpose() - Matrix3::identity()) / size * body_from_ned;
    let turned = in_reading(gain, &(d_force * (force.d_attitude + skew(&force.ned))));
    z.block(own::ATTITUDE, &turned);
    z.block(own::VELOCITY, &in_reading(gain, &(d_force * -own.drag_per_s)));
    z.block(own::GUST, &in_reading(gain, &(d_force * D_WIND)));
    z.block(own::THRUST, &in_reading(gain, &(d_force * force.d_thrust)));
    z.block(own::WIND, &in_reading(gain, &(d_force * D_WIND)));
    z.block(own::TRIM, &in_reading(gain, &(d_force * force.d_trim)));
    z.block(own::DRAG, &in_reading(gain, &(d_force * force.d_drag)));
    (felt, turned)
}

/// A force smaller than this has no direction, m/s²: nothing flies so for long.
const LEAST_FORCE: f64 = 1.0;

/// The derivative of a reading from that of the direction it reads.
fn in_reading<const N: usize>(gain: f64, d: &SMatrix<f64, 3, N>) -> SMatrix<f64, 2, N> {
    SMatrix::from_fn(|i, j| gain * SIGNS[i] * d[(i, j)])
}

impl<const WHICH: usize> TiltReading<WHICH> {
    /// Fuses it. While no marker is seen, the second one in a row outside the gate shows a helicopter that turns faster
    /// than was thought: it is no outlier. After too many the sensor is trusted less.
    pub(crate) fn fuse(&self, core: &mut Core) {
        if !core.expect_aid(self) {
            return;
        }
        core.wake_own(core.state.rejections.tilt[WHICH]);
        let outcome = core.fuse_gated(Self::SOURCE);
        if core.teaches(&outcome) {
            let start = core.learning.start.tilt_var[WHICH];
            let gain = 0.5 * SAMPLE_GAIN_S / core.learning.over_s;
            let limits = (LIMITS.0 * start, LIMITS.1 * start);
            let value = &mut core.state.learnt.tilt_var[WHICH];
            for (residual, innovation_var) in core.z.residual.into_iter().zip(outcome.innovation_var).take(2)
            {
                blend_noise(value, 1.0, residual, innovation_var, gain, limits);
            }
        }
        let state = &mut core.state;
        state.rejections.tilt[WHICH] = counted(state.rejections.tilt[WHICH], outcome.ratio);
        if state.rejections.tilt[WHICH] >= 6 * core.restart_after {
            state.rejections.tilt[WHICH] = 0;
            state.learnt.tilt_var[WHICH] *= 16.0;
        }
    }
}
