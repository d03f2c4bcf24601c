//! A ground feature: one pixel of a point of the ground that stays where it is.

use nalgebra::{Matrix2, Vector2, Vector3};

use windhover_base::msg::{Disposition, FusionSource};

use super::Aid;
use super::pixel::{self, CameraColumns, Curvature, Moment};
use crate::core::Core;
use crate::fitted::blend_factor;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::state::State;
use crate::update::Outcome;

/// Where the feature in a slot of the state was seen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FeaturePixel {
    pub(crate) slot: usize,
    pub(crate) px: Vector2<f64>,
    /// As the detector has it.
    pub(crate) sigma_px: f64,
    /// By how much it may seem to have moved on the ground, one sigma, m.
    pub(crate) slack_m: f64,
}

/// Sightings the fitted noise remembers: some seconds of eight features.
const SAMPLES: f64 = 400.0;

impl Aid for FeaturePixel {
    const SOURCE: FusionSource = FusionSource::Feature;

    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let [north, east] = state.features[self.slot].mean;
        let world = Vector3::new(north, east, models.ground.down_m(north, east));
        let view = pixel::view(&state.own, models, &world).ok_or(Disposition::Invalid)?;
        let [slope_n, slope_e] = models.ground.slope(north, east);
        let known = self.sigma_px.powi(2) * models.feature_factor2;
        let noise = Matrix2::identity() * (known * state.learnt.feature_factor);
        let bent = Curvature::of(&state.cov, &state.own, models).noise_px2(&(world - state.own.position));
        let slack = view.d_point.fixed_columns::<2>(0) * self.slack_m;
        let noise = noise + slack * slack.transpose();
        z.begin(2);
        let moment = Moment::of(&state.own, models, &view, &Vector3::zeros(), &self.px);
        CameraColumns::touch(z, state).set_point(
            z,
            0,
            &self.px,
            (state, models),
            &view,
            &moment,
            &noise,
            &bent,
        );
        let north = view.d_point * Vector3::new(1.0, 0.0, slope_n);
        let east = view.d_point * Vector3::new(0.0, 1.0, slope_e);
        z.block(state.layout().feature(self.slot), &Matrix2::from_columns(&[north, east]));
        Ok(())
    }
}

impl FeaturePixel {
    /// Fuses it through the gate; `None`, without a report, where it cannot be in view.
    pub(crate) fn fuse(&self, core: &mut Core) -> Option<Outcome> {
        core.linearise(self).ok()?;
        let settled = !core.z.unsettled;
        let outcome = core.fuse_gated(Self::SOURCE);
        if settled && core.teaches(&outcome) {
            blend_factor(&mut core.state.learnt.feature_factor, outcome.misfit, SAMPLES, pixel::FACTORS);
        }
        Some(outcome)
    }
}
