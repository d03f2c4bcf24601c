//! Gyros: `z = ω + b`, body axes, mean of a block of samples (`inertial.rs`).

use nalgebra::{Matrix3, Vector3};

use windhover_base::msg::{Disposition, FusionSource};

use super::{Aid, counted};
use crate::blocks::own;
use crate::core::Core;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::state::State;

/// Rates of turn in the body frame, rad/s.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rate(pub(crate) Vector3<f64>);

impl Aid for Rate {
    const SOURCE: FusionSource = FusionSource::ImuRate;

    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        z.begin(3);
        z.block(own::RATE, &Matrix3::identity());
        z.block(own::RATE_BIAS, &Matrix3::identity());
        let residual = self.0 - state.own.rate - state.own.rate_bias;
        for i in 0..3 {
            z.residual[i] = residual[i];
            z.noise[i][i] = models.rate_var;
        }
        Ok(())
    }
}

impl Rate {
    /// Fuses it. The second one in a row outside the gate shows a helicopter that turns faster than was thought.
    pub(crate) fn fuse(&self, core: &mut Core) {
        if !core.expect_aid(self) {
            return;
        }
        core.wake_own(core.state.rejections.rate);
        let outcome = core.fuse_gated(Self::SOURCE);
        let rejections = &mut core.state.rejections;
        rejections.rate = counted(rejections.rate, outcome.ratio);
    }
}
