//! What markers and ground features have in common: a point of the world in the image, through lens, mount and pose.

use nalgebra::{Matrix2, Matrix2x3, Vector2, Vector3};

use windhover_base::geo::skew;

use crate::blocks::{TARGET, own};
use crate::matrix::Grid;
use crate::measurement::{Columns, Measurement};
use crate::models::Models;
use crate::own::Own;

/// A point of the world in the image, with its derivatives.
pub(crate) struct PointView {
    pub(crate) px: Vector2<f64>,
    /// ∂px/∂(point in NED).
    pub(crate) d_point: Matrix2x3<f64>,
    /// ∂px/∂(attitude error).
    pub(crate) d_attitude: Matrix2x3<f64>,
}

/// Projects a point given in NED.
pub(crate) fn view(own: &Own, models: &Models, point: &Vector3<f64>) -> Option<PointView> {
    let from_us = point - own.position;
    let camera_from_ned = models.camera_from_body * own.rotation().transpose();
    let in_camera = camera_from_ned * from_us - models.camera_from_body * models.camera_at;
    let seen = models.camera.project(&in_camera)?;
    let d_point = seen.d_point * camera_from_ned;
    Some(PointView { px: seen.px, d_point, d_attitude: d_point * skew(&from_us) })
}

/// A point of a target in NED, and ∂point/∂(north, east, heading).
pub(crate) fn target_point(
    mean: &[f64; TARGET],
    models: &Models,
    point: &Vector3<f64>,
) -> (Vector3<f64>, [Vector3<f64>; 3]) {
    let [north, east, heading, ..] = *mean;
    let (s, c) = heading.sin_cos();
    let [slope_n, slope_e] = models.ground.slope(north, east);
    let down = models.ground.down_m(north, east);
    let turned = Vector3::new(c * point.x - s * point.y, s * point.x + c * point.y, point.z);
    let derivatives = [
        Vector3::new(1.0, 0.0, slope_n),
        Vector3::new(0.0, 1.0, slope_e),
        Vector3::new(-turned.y, turned.x, 0.0),
    ];
    (turned + Vector3::new(north, east, down), derivatives)
}

/// When the row of a point is exposed against the middle of its frame, and how it moves through the picture.
///
/// A row at the share `s` of the frame's height, −½ at the top, is exposed `τ = s r` after the middle one, with `r` from the
/// first row to the last. So a point appears at `π(x) + τ π̇(x)`: over some milliseconds its way through the picture is
/// straight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Moment {
    /// `τ`, s.
    pub(crate) after_s: f64,
    /// `π̇`, px/s.
    flow: Vector2<f64>,
}

impl Moment {
    /// Of a point that moves with this velocity (NED), seen at `px`.
    pub(crate) fn of(
        own: &Own,
        models: &Models,
        view: &PointView,
        velocity: &Vector3<f64>,
        px: &Vector2<f64>,
    ) -> Self {
        let share = px.y / (models.image_px.1 - 1.0) - 0.5;
        let flow = view.d_point * (velocity - own.velocity) + view.d_attitude * (own.rotation() * own.rate);
        Self { after_s: share * models.readout_s, flow }
    }
}

/// The columns of a measurement of pixels that concern the camera: its pose and motion.
#[derive(Clone, Copy)]
pub(crate) struct CameraColumns {
    position: Columns<3>,
    velocity: Columns<3>,
    attitude: Columns<3>,
    rate: Columns<3>,
}

impl CameraColumns {
    /// Adds them to a measurement.
    pub(crate) fn touch(z: &mut Measurement) -> Self {
        Self {
            position: z.touch(own::POSITION),
            velocity: z.touch(own::VELOCITY),
            attitude: z.touch(own::ATTITUDE),
            rate: z.touch(own::RATE),
        }
    }

    /// Writes point `i`, seen at `px`, with what concerns the camera.
    pub(crate) fn set_point(
        self,
        z: &mut Measurement,
        i: usize,
        px: &Vector2<f64>,
        own: &Own,
        view: &PointView,
        moment: &Moment,
        noise: &Matrix2<f64>,
    ) {
        let residual = px - view.px - moment.flow * moment.after_s;
        let after_s = moment.after_s;
        z.set(2 * i, self.position, &-view.d_point);
        z.set(2 * i, self.velocity, &(view.d_point * -after_s));
        z.set(2 * i, self.attitude, &view.d_attitude);
        z.set(2 * i, self.rate, &(view.d_attitude * own.rotation() * after_s));
        for r in 0..2 {
            z.residual[2 * i + r] = residual[r];
            for c in 0..2 {
                z.noise[2 * i + r][2 * i + c] = noise[(r, c)];
            }
        }
    }
}

/// What the linear model leaves out of a pixel while tilt is hardly known, px²: a tilt error δ bends
/// the image by up to `f δ²`. It dies out as tilt gets known (0.3 px at 1°, 0.03 px at 0.3°).
pub(crate) fn curvature_px2(cov: &Grid, models: &Models) -> f64 {
    let (north, east) = (own::ATTITUDE.column(0), own::ATTITUDE.column(1));
    let tilt_var = cov.at(north, north) + cov.at(east, east);
    (models.camera.fx * tilt_var).powi(2)
}

/// Noise of pixels is fitted where tilt is known: what the linear model leaves out is this part of it.
pub(crate) const LITTLE_CURVATURE: f64 = 0.2;

/// Limits of a factor on the variance of pixels: from a tenth of the sigma assumed to five times as much.
pub(crate) const FACTORS: (f64, f64) = (0.01, 25.0);
