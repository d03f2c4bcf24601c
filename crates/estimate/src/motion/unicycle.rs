//! A vehicle that rolls and may turn on the spot: tracks, or wheels driven on each side.

use super::VehicleMotion;

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
}
