//! Heading of the compass, or of the second source of attitude: `z = ψ + b`, where ψ is the azimuth of the body's x axis x: for a small rotation ε about NED,
//! `δψ = ε_D − (x_N x_D ε_N + x_E x_D ε_E)/(x_N² + x_E²)`.

use nalgebra::{Matrix1, RowVector3};

use windhover_base::geo::wrap_angle;
use windhover_base::msg::{Disposition, FusionSource};

use super::compass::{SAMPLE_GAIN_S, set_delay};
use super::{Aid, counted};
use crate::blocks::own;
use crate::core::Core;
use crate::fitted::blend_noise;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::own::{PLACES, SECOND};
use crate::state::State;

/// True heading, rad, of the compass (0) or of the second source of attitude (1).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Heading<const WHICH: usize>(pub(crate) f64);

/// Limits of the fitted variance, as factors on that configured.
const LIMITS: (f64, f64) = (0.25, 36.0);

impl<const WHICH: usize> Aid for Heading<WHICH> {
    const SOURCE: FusionSource =
        if WHICH == SECOND { FusionSource::AttitudeHeading } else { FusionSource::CompassHeading };

    fn linearise(&self, state: &State, _models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let own = &state.own;
        let x = own.rotation().column(0).into_owned();
        let level2 = x.x * x.x + x.y * x.y;
        z.begin(1);
        let turned = RowVector3::new(-x.x * x.z / level2, -x.y * x.z / level2, 1.0);
        z.block(own::ATTITUDE, &turned);
        z.block(PLACES[WHICH].heading_bias, &Matrix1::new(1.0));
        z.residual[0] = wrap_angle(self.0 - x.y.atan2(x.x) - own.errors_of(WHICH).heading_bias);
        z.noise[0][0] = state.learnt.heading_var[WHICH] * state.colour_factor(Self::SOURCE);
        set_delay(z, WHICH, own, &turned);
        Ok(())
    }
}

impl<const WHICH: usize> Heading<WHICH> {
    /// Fuses it; after too many outside the gate the compass's bias is unknown again.
    pub(crate) fn fuse(&self, core: &mut Core) {
        let colour = core.state.colour_factor(Self::SOURCE);
        let Some(outcome) = core.fuse_aid(self) else { return };
        if core.teaches(&outcome) {
            let (start, residual) = (core.learning.start.heading_var[WHICH], core.z.residual[0]);
            let gain = SAMPLE_GAIN_S / core.learning.over_s;
            let limits = (LIMITS.0 * start, LIMITS.1 * start);
            let value = &mut core.state.learnt.heading_var[WHICH];
            blend_noise(value, colour, residual, outcome.innovation_var[0], gain, limits);
        }
        let state = &mut core.state;
        state.rejections.heading[WHICH] = counted(state.rejections.heading[WHICH], outcome.ratio);
        if state.rejections.heading[WHICH] >= 6 * core.restart_after {
            state.rejections.heading[WHICH] = 0;
            state.renew(PLACES[WHICH].heading_bias, &[9.0 * core.models.heading_bias_var[WHICH]]);
        }
    }
}
