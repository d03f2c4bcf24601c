//! A vehicle that rolls and may turn on the spot: tracks, or wheels driven on each side.

use super::{Intensities, VehicleMotion, rolling};
use crate::blocks::{TARGET, TargetBlock};
use crate::matrix::Grid;

/// No bound on the yaw rate.
#[derive(Clone, Debug)]
pub(crate) struct Unicycle;

impl VehicleMotion for Unicycle {
    fn moves(&self) -> bool {
        true
    }

    fn most_yaw_rate_q(&self, _speed2: f64) -> Option<f64> {
        None
    }

    fn advance(&self, mean: &mut [f64; TARGET], dt: f64) {
        rolling::advance(mean, dt);
    }

    fn carry(
        &self,
        mean: &[f64; TARGET],
        dt: f64,
        at: TargetBlock,
        grids: &mut dyn Iterator<Item = &mut Grid>,
    ) {
        rolling::carry(mean, dt, at, grids);
    }

    fn add_noise(&self, mean: &[f64; TARGET], dt: f64, walks: Intensities, at: TargetBlock, p: &mut Grid) {
        rolling::add_noise(mean, dt, walks, at, p);
    }
}
