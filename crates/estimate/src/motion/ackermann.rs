//! A car: it rolls, and turns only as it rolls.

use super::VehicleMotion;

/// Steepest wheel angle of a car-like vehicle, rad: 40° is at the upper end of what is built.
const MAX_STEER: f64 = 0.7;

/// A vehicle with steered front wheels.
#[derive(Clone, Debug)]
pub(crate) struct Ackermann {
    /// 1/m, of the tightest turn; `None` where the wheelbase is not known.
    max_curvature: Option<f64>,
}

impl Ackermann {
    pub(super) fn new(wheelbase_m: f64) -> Self {
        Self { max_curvature: (wheelbase_m > 0.0).then(|| MAX_STEER.tan() / wheelbase_m) }
    }
}

impl VehicleMotion for Ackermann {
    fn moves(&self) -> bool {
        true
    }

    fn tightest_turn(&self) -> Option<f64> {
        self.max_curvature
    }

    /// Half the tightest turn as one sigma, changing over a second; a thousandth of a radian a second at rest.
    fn most_yaw_rate_q(&self, speed2: f64) -> Option<f64> {
        self.max_curvature.map(|curvature| 2.0 * (0.5 * curvature).powi(2) * speed2 + 1e-6)
    }
}
