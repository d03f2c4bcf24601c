//! A disc on a vehicle, or a tag of which only the middle is known: one pixel.

use nalgebra::{Matrix2, Vector2, Vector3};

use windhover_base::msg::{Disposition, FusionSource};

use super::Aid;
use super::tag::{Sighting, fuse_expected, linearise_points};
use crate::core::Core;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::state::State;

/// The centre of a marker.
#[derive(Clone, Copy)]
pub(crate) struct Disc<'a> {
    pub(crate) target: usize,
    /// In the vehicle frame, m.
    pub(crate) point: &'a Vector3<f64>,
    pub(crate) center_px: &'a Vector2<f64>,
    pub(crate) cov_px2: &'a Matrix2<f64>,
}

impl Aid for Disc<'_> {
    const SOURCE: FusionSource = FusionSource::Marker;

    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let seen = Sighting { point: *self.point, d_fit: None, px: self.center_px, cov_px2: self.cov_px2 };
        linearise_points(self.target, None, std::iter::once(seen), state, models, z)
    }
}

impl Disc<'_> {
    /// Fuses it through the gate; whether it was inside. A centre has no shape to judge its noise by.
    pub(crate) fn fuse(&self, core: &mut Core) -> bool {
        core.expect_aid(self) && fuse_expected(core, self.target, 1.0)
    }
}
