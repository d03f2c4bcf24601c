//! Geo-positioning: where the ray through a pixel meets the ground (paper eq. 1–25, corrected).

use nalgebra::{Matrix2, Matrix3, Rotation3, SMatrix, Vector2, Vector3};

use super::{CameraModel, Ground, skew};

/// Why a pixel has no ground position.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum LocateError {
    /// The pixel is outside the range of the distortion model.
    #[error("pixel is outside the range of the distortion model")]
    OutsideModel,
    /// The ray is level or points up.
    #[error("the ray does not reach the ground")]
    AboveHorizon,
    /// The ground is farther than the limit.
    #[error("the ground there is farther away than the limit")]
    TooFar,
}

/// A point on the ground seen through a pixel.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct GroundPoint {
    /// North, east, down, metres.
    pub ned_m: Vector3<f64>,
    /// Distance from the camera, metres.
    pub slant_m: f64,
    /// Covariance of (north, east), m²; zero where none was asked for.
    pub covariance_m2: Matrix2<f64>,
}

/// One-sigma errors of the inputs of geo-positioning, for first-order covariance.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct PoseSigmas {
    /// Camera position covariance in NED, m².
    pub position_m2: Matrix3<f64>,
    /// Attitude error covariance as small rotations about the NED axes, rad².
    pub attitude_rad2: Matrix3<f64>,
    /// Pixel covariance, px².
    pub pixel_px2: Matrix2<f64>,
    /// Ground height sigma, metres.
    pub ground_m: f64,
}

/// The ground point seen at `px`.
///
/// `p_camera` is the camera's position in NED, `ned_from_camera` its attitude, `above_m` the height of the point over
/// the ground (a marker on a roof), `limit_m` the largest accepted slant range. `d = ned_from_camera [u v 1]ᵀ`, `Zc =
/// (D0 − p_D)/d_D`, `G = p + Zc d` (paper eq. 11–13, corrected).
///
/// ```
/// use windhover_base::geo::{CameraModel, Ground, ImageTop, LocateError, body_from_camera, locate};
/// use nalgebra::{Vector2, Vector3};
///
/// // A level helicopter that heads north, 10 m over level ground.
/// let camera = CameraModel { fx: 1000.0, fy: 1000.0, cx: 640.0, cy: 512.0, ..CameraModel::UNIT };
/// let ned_from_camera = body_from_camera(ImageTop::Forward, 0.0, 0.0, 0.0);
/// let (at, ground) = (Vector3::new(5.0, 0.0, -10.0), Ground::Flat { down_m: 0.0 });
/// let find = |px, limit_m| locate(&camera, &at, &ned_from_camera, px, &ground, 0.0, limit_m);
///
/// // 100 pixels right of the centre are a metre east.
/// let point = find(Vector2::new(740.0, 512.0), 100.0).expect("the ray meets the ground");
/// assert!((point.ned_m - Vector3::new(5.0, 1.0, 0.0)).norm() < 1e-9);
/// assert_eq!(find(Vector2::new(740.0, 512.0), 5.0), Err(LocateError::TooFar));
/// ```
///
/// # Errors
/// Where the pixel is outside the lens model, or its ray does not meet the ground within `limit_m`.
pub fn locate(
    camera: &CameraModel,
    p_camera: &Vector3<f64>,
    ned_from_camera: &Rotation3<f64>,
    px: Vector2<f64>,
    ground: &Ground,
    above_m: f64,
    limit_m: f64,
) -> Result<GroundPoint, LocateError> {
    let m = camera.normalised(px).ok_or(LocateError::OutsideModel)?;
    let direction = ned_from_camera * Vector3::new(m.x, m.y, 1.0);
    let depth = ground.intersect(p_camera, &direction, above_m).ok_or(LocateError::AboveHorizon)?;
    let slant_m = depth * direction.norm();
    if slant_m > limit_m {
        return Err(LocateError::TooFar);
    }
    Ok(GroundPoint { ned_m: p_camera + direction * depth, slant_m, covariance_m2: Matrix2::zeros() })
}

/// As [`locate`], with the first-order covariance of north and east.
///
/// Let `n = (∂D/∂N, ∂D/∂E, −1)` be the ground's normal, scaled so that it is also valid on a slope. A small change `δ`
/// of the ray's far end then moves the ground point by `(I − d nᵀ/(nᵀd)) δ`.
///
/// ```
/// use windhover_base::geo::{CameraModel, Ground, ImageTop, PoseSigmas, body_from_camera, locate_with_covariance};
/// use nalgebra::{Matrix2, Vector2, Vector3};
///
/// let camera = CameraModel { fx: 1000.0, fy: 1000.0, cx: 640.0, cy: 512.0, ..CameraModel::UNIT };
/// let ned_from_camera = body_from_camera(ImageTop::Forward, 0.0, 0.0, 0.0);
/// let (at, ground) = (Vector3::new(0.0, 0.0, -10.0), Ground::Flat { down_m: 0.0 });
/// // A pixel's error alone: at 10 m and 1000 px it is a centimetre.
/// let sigmas = PoseSigmas { pixel_px2: Matrix2::identity(), ..PoseSigmas::default() };
/// let px = Vector2::new(640.0, 512.0);
/// let point = locate_with_covariance(&camera, &at, &ned_from_camera, px, &ground, 0.0, 100.0, &sigmas)
///     .expect("the ray meets the ground");
/// assert!((point.covariance_m2[(0, 0)].sqrt() - 0.01).abs() < 1e-9);
/// ```
///
/// # Errors
/// Those of [`locate`].
pub fn locate_with_covariance(
    camera: &CameraModel,
    p_camera: &Vector3<f64>,
    ned_from_camera: &Rotation3<f64>,
    px: Vector2<f64>,
    ground: &Ground,
    above_m: f64,
    limit_m: f64,
    sigmas: &PoseSigmas,
) -> Result<GroundPoint, LocateError> {
    let mut point = locate(camera, p_camera, ned_from_camera, px, ground, above_m, limit_m)?;
    let ray = point.ned_m - p_camera;
    let [sn, se] = ground.slope(point.ned_m.x, point.ned_m.y);
    let normal = Vector3::new(sn, se, -1.0);
    let onto_ground = Matrix3::identity() - ray * normal.transpose() / normal.dot(&ray);
    let to_plane: SMatrix<f64, 2, 3> = onto_ground.fixed_rows::<2>(0).into_owned();

    let d_position = to_plane;
    // A small rotation ε about the NED axes moves the far end by ε × ray = −[ray]× ε.
    let d_attitude = to_plane * -skew(&ray);
    let m = camera.normalised(px).ok_or(LocateError::OutsideModel)?;
    let d_m = camera.pixel_of(m).1.try_inverse().ok_or(LocateError::OutsideModel)?;
    let depth = (ned_from_camera.inverse() * ray).z;
    let along_image = ned_from_camera.matrix().fixed_columns::<2>(0) * depth;
    let d_pixel = to_plane * along_image * d_m;
    // A ground higher by h (down smaller) shifts the point along the ray.
    let d_ground = (ray / normal.dot(&ray)).xy();

    point.covariance_m2 = d_position * sigmas.position_m2 * d_position.transpose()
        + d_attitude * sigmas.attitude_rad2 * d_attitude.transpose()
        + d_pixel * sigmas.pixel_px2 * d_pixel.transpose()
        + d_ground * d_ground.transpose() * sigmas.ground_m.powi(2);
    Ok(point)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geo::{ImageTop, LensModel, body_from_camera, ned_from_body_312, ned_from_body_321};

    fn camera() -> CameraModel {
        CameraModel {
            fx: 1019.5,
            fy: 1022.1,
            cx: 645.7,
            cy: 527.7,
            model: LensModel::Brown,
            distortion: [-0.17892, 0.13875, -0.00128, 0.0056, 0.0],
            skew: 0.0,
        }
    }

    #[test]
    fn errata_example_of_equation_12() {
        // P = (3, 4, −10), u = 0.2, level, camera axes along the body: X_G is 5.00.
        let at = locate(
            &CameraModel::UNIT,
            &Vector3::new(3.0, 4.0, -10.0),
            &ned_from_body_312(0.0, 0.0, 0.0),
            Vector2::new(0.2, 0.0),
            &Ground::Flat { down_m: 0.0 },
            0.0,
            1e3,
        )
        .expect("the ground is below");
        assert!((at.ned_m - Vector3::new(5.0, 4.0, 0.0)).norm() < 1e-12);
    }

    #[test]
    fn a_projected_point_is_found_again() {
        let ned_from_camera =
            ned_from_body_321(0.7, 0.1, -0.15) * body_from_camera(ImageTop::Left, 0.02, -0.01, 0.03);
        let p = Vector3::new(12.0, -7.0, -15.0);
        let truth = Vector3::new(13.5, -6.0, -0.55);
        let seen = camera().project(&(ned_from_camera.inverse() * (truth - p))).expect("in view");
        let at = locate(&camera(), &p, &ned_from_camera, seen.px, &Ground::Flat { down_m: 0.0 }, 0.55, 100.0)
            .expect("below");
        assert!((at.ned_m - truth).norm() < 1e-9);
    }

    #[test]
    fn the_horizon_is_refused() {
        let level = ned_from_body_321(0.0, 1.5, 0.0) * ImageTop::Forward.base();
        let p = Vector3::new(0.0, 0.0, -10.0);
        let ground = Ground::Flat { down_m: 0.0 };
        let up = locate(&camera(), &p, &level, Vector2::new(645.0, 10.0), &ground, 0.0, 1e3);
        assert_eq!(up, Err(LocateError::AboveHorizon));
    }

    #[test]
    fn covariance_matches_differences() {
        let ned_from_camera =
            ned_from_body_321(0.7, 0.1, -0.15) * body_from_camera(ImageTop::Forward, 0.0, 0.0, 0.0);
        let p = Vector3::new(0.0, 0.0, -15.0);
        let px = Vector2::new(900.0, 300.0);
        let ground = Ground::Flat { down_m: 0.0 };
        let find = |p: &Vector3<f64>, r: &Rotation3<f64>, px, h: f64| {
            locate(&camera(), p, r, px, &ground, h, 1e3).expect("below").ned_m.xy()
        };
        let base = find(&p, &ned_from_camera, px, 0.0);
        let step = 1e-6;
        let mut want = Matrix2::zeros();
        let (sp, sa, spx, sg) = (0.3, 0.01, 0.7, 0.2);
        for axis in 0..3 {
            let mut e = Vector3::zeros();
            e[axis] = step;
            let d = (find(&(p + e), &ned_from_camera, px, 0.0) - base) / step;
            want += d * d.transpose() * sp * sp;
            let turned = Rotation3::new(e) * ned_from_camera;
            let d = (find(&p, &turned, px, 0.0) - base) / step;
            want += d * d.transpose() * sa * sa;
        }
        for axis in 0..2 {
            let mut e = Vector2::zeros();
            e[axis] = step;
            let d = (find(&p, &ned_from_camera, px + e, 0.0) - base) / step;
            want += d * d.transpose() * spx * spx;
        }
        let d = (find(&p, &ned_from_camera, px, step) - base) / step;
        want += d * d.transpose() * sg * sg;
        let sigmas = PoseSigmas {
            position_m2: Matrix3::identity() * sp * sp,
            attitude_rad2: Matrix3::identity() * sa * sa,
            pixel_px2: Matrix2::identity() * spx * spx,
            ground_m: sg,
        };
        let got = locate_with_covariance(&camera(), &p, &ned_from_camera, px, &ground, 0.0, 1e3, &sigmas)
            .expect("below")
            .covariance_m2;
        assert!((got - want).norm() < 1e-4 * want.norm(), "{got} {want}");
    }
}
