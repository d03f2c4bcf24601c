//! Accelerometers: `z = Rᵀ f + b` with the force f of `force.rs`, body axes, mean of a block of samples (`inertial.rs`).

use nalgebra::{Matrix3, Vector3};

use windhover_base::geo::skew;
use windhover_base::msg::{Disposition, FusionSource};

use super::Aid;
use crate::blocks::own;
use crate::core::Core;
use crate::fitted::blend_factor;
use crate::force::{D_WIND, Force};
use crate::measurement::Measurement;
use crate::models::Models;
use crate::state::State;

/// Specific force in the body frame, m/s².
#[derive(Clone, Copy, Debug)]
pub(crate) struct SpecificForce(pub(crate) Vector3<f64>);

/// Blocks that the fitted noise remembers: ten seconds.
const SAMPLES: f64 = 100.0;
/// Limits of the factor on its variance: what vibrates is not white, so little is made of a small residual.
const FACTORS: (f64, f64) = (0.25, 25.0);

impl Aid for SpecificForce {
    const SOURCE: FusionSource = FusionSource::ImuForce;

    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let own = &state.own;
        let force = Force::of(own);
        let body_from_ned: Matrix3<f64> = own.rotation().transpose();
        z.begin(3);
        z.block(own::ATTITUDE, &(body_from_ned * (force.d_attitude + skew(&force.ned))));
        z.block(own::VELOCITY, &(body_from_ned * -own.drag_per_s));
        z.block(own::GUST, &(body_from_ned * D_WIND));
        z.block(own::THRUST, &(body_from_ned * force.d_thrust));
        z.block(own::WIND, &(body_from_ned * D_WIND));
        z.block(own::TRIM, &(body_from_ned * force.d_trim));
        z.block(own::DRAG, &(body_from_ned * force.d_drag));
        z.block(own::FORCE_BIAS, &Matrix3::identity());
        let residual = self.0 - body_from_ned * force.ned - own.force_bias;
        for i in 0..3 {
            z.residual[i] = residual[i];
            z.noise[i][i] = models.force_var * state.learnt.force_factor;
        }
        Ok(())
    }
}

impl SpecificForce {
    /// Fuses it.
    pub(crate) fn fuse(&self, core: &mut Core) {
        let Some(outcome) = core.fuse_aid(self) else { return };
        if core.teaches(&outcome) {
            blend_factor(&mut core.state.learnt.force_factor, outcome.misfit, SAMPLES, FACTORS);
        }
    }
}
