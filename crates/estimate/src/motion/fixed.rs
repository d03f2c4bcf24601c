//! `static`: a marker that lies where it lies, surveyed.

use super::{Intensities, VehicleMotion};
use crate::blocks::{TARGET, TargetBlock};
use crate::matrix::Grid;

/// No motion at all.
#[derive(Clone, Debug)]
pub(crate) struct Fixed;

impl VehicleMotion for Fixed {
    fn moves(&self) -> bool {
        false
    }

    fn most_yaw_rate_q(&self, _speed2: f64) -> Option<f64> {
        None
    }

    fn advance(&self, _mean: &mut [f64; TARGET], _dt: f64) {}

    fn carry(
        &self,
        _mean: &[f64; TARGET],
        _dt: f64,
        _at: TargetBlock,
        _grids: &mut dyn Iterator<Item = &mut Grid>,
    ) {
    }

    fn add_noise(
        &self,
        _mean: &[f64; TARGET],
        _dt: f64,
        _walks: Intensities,
        _at: TargetBlock,
        _p: &mut Grid,
    ) {
    }
}
