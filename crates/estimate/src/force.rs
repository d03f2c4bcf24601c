//! What pushes the helicopter, over its mass: `f = a_T + (d_w + d_g, 0) − c v` in NED.
//!
//! Thrust points against `b = R (ε1, ε2, 1)` and its vertical part carries the weight whatever the tilt:
//! `a_T = −(g + s) b / b_D`, which is g tan of the tilt across and no more than the excess s along the vertical. (Thrust of
//! constant size would be g sin: 15 % less at 30°.) Drag c counts against the ground; what the wind adds to it is the
//! slow force d_w, so that no product of two unknowns enters.

use nalgebra::{Matrix3, Matrix3x2, Vector3};

use windhover_base::geo::skew;

use super::own::{GRAVITY, Own};

/// A thrust that points farther down than this, as b_D, is taken as one at this: nothing flies so.
const LEAST_UPRIGHT: f64 = 0.3;

/// Specific force with its derivatives.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Force {
    /// In NED, m/s².
    pub(crate) ned: Vector3<f64>,
    /// ∂f/∂(attitude error).
    pub(crate) d_attitude: Matrix3<f64>,
    /// ∂f/∂(trim).
    pub(crate) d_trim: Matrix3x2<f64>,
    /// ∂f/∂(thrust excess).
    pub(crate) d_thrust: Vector3<f64>,
    /// ∂f/∂(drag).
    pub(crate) d_drag: Vector3<f64>,
}

/// ∂f/∂(wind) and ∂f/∂(gust).
pub(crate) const D_WIND: Matrix3x2<f64> = Matrix3x2::new(1.0, 0.0, 0.0, 1.0, 0.0, 0.0);

impl Force {
    /// At a state.
    pub(crate) fn of(own: &Own) -> Self {
        let r = own.rotation();
        let b = r.column(2) + r.column(0) * own.trim.x + r.column(1) * own.trim.y;
        let upright = b.z.max(LEAST_UPRIGHT);
        let direction = b / upright;
        let size = -(GRAVITY + own.thrust);
        let mut along = Matrix3::identity();
        along.column_mut(2).axpy(-1.0, &direction, 1.0);
        let d_b = along * (size / upright);
        let across = Vector3::new(own.wind.x + own.gust.x, own.wind.y + own.gust.y, 0.0);
        Self {
            ned: direction * size + across - own.velocity * own.drag_per_s,
            d_attitude: d_b * -skew(&b),
            d_trim: d_b * r.fixed_columns::<2>(0),
            d_thrust: -direction,
            d_drag: -own.velocity,
        }
    }

    /// What the turning of the helicopter changes of it, NED, m/s³: `∂f/∂(attitude error) · R ω`.
    pub(crate) fn jerk(&self, own: &Own) -> Vector3<f64> {
        self.d_attitude * (own.ned_from_body * own.rate)
    }

    /// Acceleration in NED.
    pub(crate) fn acceleration(&self) -> Vector3<f64> {
        self.ned + Vector3::new(0.0, 0.0, GRAVITY)
    }
}
