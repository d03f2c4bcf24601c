//! What markers and ground features have in common: a point of the world in the image, through lens, mount and pose.

use nalgebra::{Matrix2, Matrix2x3, Matrix2x4, Matrix3, Vector2, Vector3};

use windhover_base::geo::skew;

use crate::blocks::{SHAKE, TARGET, own};
use crate::lens::d_lens;
use crate::matrix::Grid;
use crate::measurement::{Columns, Measurement};
use crate::models::Models;
use crate::own::Own;
use crate::state::State;

/// A point of the world in the image, with its derivatives.
pub(crate) struct PointView {
    pub(crate) px: Vector2<f64>,
    /// ∂px/∂(point in NED).
    pub(crate) d_point: Matrix2x3<f64>,
    /// ∂px/∂(attitude error).
    pub(crate) d_attitude: Matrix2x3<f64>,
    /// ∂px/∂(errors of the lens).
    pub(crate) d_lens: Matrix2x4<f64>,
}

/// Projects a point given in NED.
pub(crate) fn view(own: &Own, models: &Models, point: &Vector3<f64>) -> Option<PointView> {
    let from_us = point - own.position;
    let camera_from_ned = models.camera_from_body * own.rotation().transpose();
    let in_camera = camera_from_ned * from_us - models.camera_from_body * models.camera_at;
    let lens = models.lens(own);
    let seen = lens.project(&in_camera)?;
    let d_lens = d_lens(&lens, &(in_camera.xy() / in_camera.z));
    let d_point = seen.d_point * camera_from_ned;
    Some(PointView { px: seen.px, d_point, d_attitude: d_point * skew(&from_us), d_lens })
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
    /// `s`.
    share: f64,
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
        Self { after_s: share * own.whole_readout_s(models.readout_s), share, flow }
    }
}

/// The columns of a measurement of pixels that concern the camera: its pose and motion.
#[derive(Clone, Copy)]
pub(crate) struct CameraColumns {
    position: Columns<3>,
    velocity: Columns<3>,
    attitude: Columns<3>,
    rate: Columns<3>,
    lens: Columns<4>,
    readout: Columns<1>,
    shake: Option<Columns<SHAKE>>,
}

impl CameraColumns {
    /// Adds them to a measurement.
    pub(crate) fn touch(z: &mut Measurement, state: &State) -> Self {
        Self {
            position: z.touch(own::POSITION),
            velocity: z.touch(own::VELOCITY),
            attitude: z.touch(own::ATTITUDE),
            rate: z.touch(own::RATE),
            lens: z.touch(own::LENS),
            readout: z.touch(own::READOUT),
            shake: state.shake.is_open().then(|| z.touch(state.layout().shake())),
        }
    }

    /// Writes point `i`, seen at `px`, with what concerns the camera; `curvature` is what the linear model leaves out.
    #[expect(clippy::too_many_arguments, reason = "what is seen, from where, and how well")]
    pub(crate) fn set_point(
        self,
        z: &mut Measurement,
        i: usize,
        px: &Vector2<f64>,
        (state, models): (&State, &Models),
        view: &PointView,
        moment: &Moment,
        noise: &Matrix2<f64>,
        curvature: &Matrix2<f64>,
    ) {
        let own = &state.own;
        let mut residual = px - view.px - moment.flow * moment.after_s;
        let mut noise = *noise;
        if let Some(columns) = self.shake {
            let displaced = state.shake.displaced(models, px, moment.share);
            residual -= displaced.by_px;
            noise += displaced.noise_px2;
            z.set(2 * i, columns, &displaced.derivative);
        }
        let after_s = moment.after_s;
        z.set(2 * i, self.position, &-view.d_point);
        z.set(2 * i, self.velocity, &(view.d_point * -after_s));
        z.set(2 * i, self.attitude, &view.d_attitude);
        z.set(2 * i, self.readout, &(moment.flow * moment.share));
        z.set(2 * i, self.lens, &view.d_lens);
        z.set(2 * i, self.rate, &(view.d_attitude * own.rotation() * after_s));
        for r in 0..2 {
            z.residual[2 * i + r] = residual[r];
            for c in 0..2 {
                z.noise[2 * i + r][2 * i + c] = noise[(r, c)] + curvature[(r, c)];
            }
        }
        z.unsettled |= curvature.trace() > LITTLE_CURVATURE * (noise.trace() + curvature.trace());
    }
}

/// What the linear model leaves out of pixels while tilt is hardly known.
///
/// Along tilt errors δ₁, δ₂ about north and east a pixel is off by `½ Σ qᵢⱼ δᵢ δⱼ`, with the second derivatives q of its
/// projection. Of errors with variances p₁, p₂ this has the second moment
/// `¼ (3 p₁² q₁₁q₁₁ᵀ + 3 p₂² q₂₂q₂₂ᵀ + p₁p₂ (4 q₁₂q₁₂ᵀ + q₁₁q₂₂ᵀ + q₂₂q₁₁ᵀ))`, which is added to the pixel's noise. It grows
/// with the angle off the optical axis, and dies out as tilt gets known. The lens's distortion is left out of it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Curvature {
    /// The axes of north and east in the camera frame.
    axes: [Vector3<f64>; 2],
    /// Variances of the tilt errors about them, rad².
    var: [f64; 2],
    camera_from_ned: Matrix3<f64>,
    focal_px: f64,
}

impl Curvature {
    /// At a state.
    pub(crate) fn of(cov: &Grid, own: &Own, models: &Models) -> Self {
        let camera_from_ned = models.camera_from_body * own.rotation().transpose();
        let columns = [own::ATTITUDE.column(0), own::ATTITUDE.column(1)];
        Self {
            axes: [camera_from_ned.column(0).into_owned(), camera_from_ned.column(1).into_owned()],
            var: columns.map(|column| cov.at(column, column)),
            camera_from_ned,
            focal_px: models.camera.fx,
        }
    }

    /// The second moment at a point given in NED from the camera, px².
    pub(crate) fn noise_px2(&self, from_camera: &Vector3<f64>) -> Matrix2<f64> {
        let at = self.camera_from_ned * from_camera;
        let ray = at / at.z;
        let ([a, b], [p, q]) = (self.axes, self.var);
        let along = |first: &Vector3<f64>, second: &Vector3<f64>| self.second_derivative(&ray, first, second);
        let (aa, ab, bb) = (along(&a, &a), along(&a, &b), along(&b, &b));
        let square = |one: &Vector2<f64>, other: &Vector2<f64>| one * other.transpose();
        let mixed = square(&ab, &ab) * 4.0 + square(&aa, &bb) + square(&bb, &aa);
        (square(&aa, &aa) * (3.0 * p * p) + square(&bb, &bb) * (3.0 * q * q) + mixed * (p * q)) * 0.25
    }

    /// `∂²π/∂α∂β` of a ray (x, y, 1) that is turned by α and β about two axes.
    fn second_derivative(
        &self,
        ray: &Vector3<f64>,
        first: &Vector3<f64>,
        second: &Vector3<f64>,
    ) -> Vector2<f64> {
        let (by_first, by_second) = (first.cross(ray), second.cross(ray));
        let by_both = (first.cross(&by_second) + second.cross(&by_first)) * 0.5;
        let (s, t) = (by_first.z, by_second.z);
        let bent = by_both.xy() - by_first.xy() * t - by_second.xy() * s;
        (bent + ray.xy() * (2.0 * s * t - by_both.z)) * self.focal_px
    }
}

/// Noise of pixels is fitted where tilt is known: what the linear model leaves out is this part of it.
const LITTLE_CURVATURE: f64 = 0.2;

/// Limits of a factor on the variance of pixels: from a tenth of the sigma assumed to five times as much.
pub(crate) const FACTORS: (f64, f64) = (0.01, 25.0);

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;

    #[test]
    fn second_derivatives_of_a_pixel_are_those_of_its_projection() {
        // A camera that looks down and somewhat ahead.
        let camera_from_ned = Rotation3::from_euler_angles(0.3, -0.2, 0.7).matrix().transpose();
        let axes = [camera_from_ned.column(0).into_owned(), camera_from_ned.column(1).into_owned()];
        let curvature = Curvature { axes, var: [1e-4; 2], camera_from_ned, focal_px: 600.0 };
        let ray = Vector3::new(0.4, -0.3, 1.0);
        let seen = |a: f64, b: f64| {
            let turned = Rotation3::new(axes[0] * a + axes[1] * b) * ray;
            turned.xy() / turned.z * 600.0
        };
        let h = 1e-4;
        let second = |a: (f64, f64), b: (f64, f64)| {
            let at = |s: f64, t: f64| seen((s * a.0 + t * b.0) * h, (s * a.1 + t * b.1) * h);
            (at(1.0, 1.0) - at(1.0, -1.0) - at(-1.0, 1.0) + at(-1.0, -1.0)) / (4.0 * h * h)
        };
        for (i, j) in [(0, 0), (0, 1), (1, 1)] {
            let unit = |k: usize| if k == 0 { (1.0, 0.0) } else { (0.0, 1.0) };
            let found = curvature.second_derivative(&ray, &axes[i], &axes[j]);
            let right = second(unit(i), unit(j));
            assert!((found - right).norm() < 1e-3 * (1.0 + right.norm()), "{i} {j}: {found:?} {right:?}");
        }
    }

    #[test]
    fn the_noise_of_curvature_is_the_second_moment_of_what_is_left_out() {
        let camera_from_ned = Matrix3::identity();
        let axes = [Vector3::x(), Vector3::y()];
        let var = [4e-4, 1e-4];
        let curvature = Curvature { axes, var, camera_from_ned, focal_px: 600.0 };
        let point = Vector3::new(3.0, -2.0, 10.0);
        let ray = point / point.z;
        let (aa, ab, bb) = (
            curvature.second_derivative(&ray, &axes[0], &axes[0]),
            curvature.second_derivative(&ray, &axes[0], &axes[1]),
            curvature.second_derivative(&ray, &axes[1], &axes[1]),
        );
        // The mean over a normal distribution, by Gauss–Hermite points of order three in both errors.
        let points = [(0.0, 2.0 / 3.0), (3f64.sqrt(), 1.0 / 6.0), (-3f64.sqrt(), 1.0 / 6.0)];
        let mut moment = Matrix2::zeros();
        for (s, weight_s) in points {
            for (t, weight_t) in points {
                let (a, b) = (s * var[0].sqrt(), t * var[1].sqrt());
                let left_out = (aa * a * a + bb * b * b) * 0.5 + ab * a * b;
                moment += left_out * left_out.transpose() * (weight_s * weight_t);
            }
        }
        let found = curvature.noise_px2(&point);
        assert!((found - moment).norm() < 1e-9 * moment.norm(), "{found} {moment}");
    }
}
