//! The camera: Brown's distortion as OpenCV and the MATLAB toolbox define it, and fisheye lenses after Kannala and Brandt.

use nalgebra::{Matrix2, Matrix2x3, Vector2, Vector3};
use serde::{Deserialize, Deserializer, Serialize, de::Error};

/// How a lens departs from a pinhole.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LensModel {
    /// A polynomial of the tangent of the angle off the axis, with decentring: for lenses that keep lines nearly straight.
    #[default]
    Brown,
    /// A polynomial of the angle itself (OpenCV's `fisheye`, "equidistant", Kannala and Brandt 2006).
    Fisheye,
}

/// Intrinsic parameters. Pixel (0, 0) is the centre of the top-left pixel.
///
/// With `x = X/Z`, `y = Y/Z`, `r² = x² + y²`. Brown:
/// `xd = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)`,
/// `yd = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y`.
/// Fisheye, `θ = atan r`: `xd = x θd / r`, `yd = y θd / r`, `θd = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`.
/// Both: `u = fx (xd + skew · yd) + cx`, `v = fy yd + cy` (Brown 1966; Kannala and Brandt 2006; Bouguet's toolbox, `skew`
/// is its α).
///
/// ```
/// use windhover_base::geo::CameraModel;
/// use nalgebra::Vector3;
///
/// let camera = CameraModel { fx: 1000.0, fy: 1000.0, cx: 640.0, cy: 512.0, ..CameraModel::UNIT };
/// let seen = camera.project(&Vector3::new(1.0, -0.5, 10.0)).expect("it is in front of the camera");
/// assert_eq!((seen.px.x, seen.px.y), (740.0, 462.0));
/// let ray = camera.normalised(seen.px).expect("the lens has a ray for it");
/// assert!((ray.x - 0.1).abs() < 1e-12 && (ray.y + 0.05).abs() < 1e-12);
/// assert!(camera.project(&Vector3::new(0.0, 0.0, -1.0)).is_none());
/// ```
#[derive(Clone, Copy, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraModel {
    /// Focal length along u, pixels.
    pub fx: f64,
    /// Focal length along v, pixels.
    pub fy: f64,
    /// Principal point u, pixels.
    pub cx: f64,
    /// Principal point v, pixels.
    pub cy: f64,
    /// What the distortion's terms mean.
    #[serde(default)]
    pub model: LensModel,
    /// k1, k2, p1, p2, k3; of a fisheye k1, k2, k3, k4 and zero. Configured as four terms or five.
    #[serde(default, deserialize_with = "four_or_five")]
    pub distortion: [f64; 5],
    /// Bouguet's α: the skew of the pixel axes.
    #[serde(default)]
    pub skew: f64,
}

/// OpenCV lists four terms of a fisheye, and four or five of Brown's model.
fn four_or_five<'de, D: Deserializer<'de>>(from: D) -> Result<[f64; 5], D::Error> {
    let terms = Vec::<f64>::deserialize(from)?;
    match terms[..] {
        [a, b, c, d] => Ok([a, b, c, d, 0.0]),
        [a, b, c, d, e] => Ok([a, b, c, d, e]),
        _ => Err(D::Error::invalid_length(terms.len(), &"four terms or five")),
    }
}

/// Farthest off the axis that a fisheye's rays count, radians: rays are given as tangents.
const FARTHEST_RAD: f64 = 1.55;

/// A projected point with its derivative.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Projection {
    /// Pixel (u, v).
    pub px: Vector2<f64>,
    /// ∂(u, v)/∂(X, Y, Z) in the camera frame.
    pub d_point: Matrix2x3<f64>,
}

impl CameraModel {
    /// A pinhole whose pixels are normalised coordinates.
    pub const UNIT: Self =
        Self { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, model: LensModel::Brown, distortion: [0.0; 5], skew: 0.0 };

    /// Distorted normalised coordinates of undistorted ones, and the derivative.
    pub fn distort(&self, m: Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        match self.model {
            LensModel::Brown => self.distort_brown(m),
            LensModel::Fisheye => self.distort_fisheye(m),
        }
    }

    fn distort_brown(&self, m: Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let (x, y) = (m.x, m.y);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let d_radial = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3));
        let distorted = Vector2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let cross = x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y;
        let jacobian = Matrix2::new(
            radial + x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        (distorted, jacobian)
    }

    fn distort_fisheye(&self, m: Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let r = m.norm();
        if r < 1e-7 {
            return (m, Matrix2::identity());
        }
        let (bent, slope) = self.bent_angle(r.atan());
        let scale = bent / r;
        // ∂θd/∂r is the slope over 1 + r².
        let along = slope / (1.0 + r * r);
        (m * scale, Matrix2::identity() * scale + m * m.transpose() * ((along - scale) / (r * r)))
    }

    /// The fisheye's θd of an angle θ, and its slope.
    fn bent_angle(&self, angle: f64) -> (f64, f64) {
        let [k1, k2, k3, k4, _] = self.distortion;
        let t = angle * angle;
        let bent = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))));
        (bent, 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4))))
    }

    /// Undistorted normalised coordinates of distorted ones: Newton's method from the distorted
    /// point. `None` where it does not settle (beyond the radius at which the polynomial folds).
    pub fn undistort(&self, distorted: Vector2<f64>) -> Option<Vector2<f64>> {
        match self.model {
            LensModel::Brown => self.undistort_brown(distorted),
            LensModel::Fisheye => self.undistort_fisheye(distorted),
        }
    }

    fn undistort_brown(&self, distorted: Vector2<f64>) -> Option<Vector2<f64>> {
        let mut m = distorted;
        for _ in 0..20 {
            let (at, jacobian) = self.distort(m);
            let step = jacobian.try_inverse()? * (distorted - at);
            m += step;
            if step.norm_squared() < 1e-24 {
                // A root beyond the fold is not a solution: the map must keep its orientation.
                let ok = jacobian.determinant() > 0.0 && jacobian[(0, 0)] > 0.0;
                return ok.then_some(m);
            }
            if !(m.norm_squared() < 1e4) {
                return None;
            }
        }
        None
    }

    /// Newton's method for the angle.
    fn undistort_fisheye(&self, distorted: Vector2<f64>) -> Option<Vector2<f64>> {
        let wanted = distorted.norm();
        if wanted < 1e-7 {
            return Some(distorted);
        }
        let mut angle = wanted.min(FARTHEST_RAD);
        for _ in 0..30 {
            let (bent, slope) = self.bent_angle(angle);
            if !(slope > 0.0) {
                return None;
            }
            let step = (wanted - bent) / slope;
            angle += step;
            if !(0.0..2.0 * FARTHEST_RAD).contains(&angle) {
                return None;
            }
            if step.abs() < 1e-13 {
                return (angle < FARTHEST_RAD).then(|| distorted * (angle.tan() / wanted));
            }
        }
        None
    }

    /// Pixel of normalised undistorted coordinates, and the derivative.
    pub fn pixel_of(&self, m: Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let (d, jacobian) = self.distort(m);
        let k = Matrix2::new(self.fx, self.fx * self.skew, 0.0, self.fy);
        (k * d + Vector2::new(self.cx, self.cy), k * jacobian)
    }

    /// Normalised undistorted coordinates `[u v]` of a pixel; the ray is `[u v 1]` (paper eq. 1).
    pub fn normalised(&self, px: Vector2<f64>) -> Option<Vector2<f64>> {
        let yd = (px.y - self.cy) / self.fy;
        let xd = (px.x - self.cx) / self.fx - self.skew * yd;
        self.undistort(Vector2::new(xd, yd))
    }

    /// Projects a point in the camera frame; `None` where it is not in front of the camera or lies
    /// beyond the fold of the distortion polynomial.
    pub fn project(&self, point: &Vector3<f64>) -> Option<Projection> {
        if !(point.z > 1e-6) {
            return None;
        }
        let (iz, m) = (1.0 / point.z, Vector2::new(point.x / point.z, point.y / point.z));
        let (px, d_m) = self.pixel_of(m);
        let unfolded = self.distort(m).1.determinant() > 0.0;
        let d_norm = Matrix2x3::new(iz, 0.0, -m.x * iz, 0.0, iz, -m.y * iz);
        (unfolded && px.iter().all(|x| x.is_finite())).then(|| Projection { px, d_point: d_m * d_norm })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paper_camera() -> CameraModel {
        CameraModel {
            model: LensModel::Brown,
            fx: 1019.52796,
            fy: 1022.12290,
            cx: 645.66333,
            cy: 527.72943,
            distortion: [-0.17892, 0.13875, -0.00128, 0.00560, 0.0],
            skew: 0.001,
        }
    }

    #[test]
    fn every_pixel_goes_there_and_back() {
        let camera = paper_camera();
        for u in (0..1280).step_by(91) {
            for v in (0..1024).step_by(93) {
                let px = Vector2::new(f64::from(u), f64::from(v));
                let m = camera.normalised(px).expect("inside the frame");
                assert!((camera.pixel_of(m).0 - px).norm() < 1e-9, "{px}");
            }
        }
    }

    /// Of some 150° across the frame.
    fn fisheye() -> CameraModel {
        CameraModel {
            fx: 480.0,
            fy: 478.0,
            model: LensModel::Fisheye,
            distortion: [-0.012, 0.004, -0.006, 0.001, 0.0],
            ..paper_camera()
        }
    }

    #[test]
    fn every_pixel_of_a_fisheye_goes_there_and_back() {
        let camera = fisheye();
        for u in (0..1280).step_by(91) {
            for v in (0..1024).step_by(93) {
                let px = Vector2::new(f64::from(u), f64::from(v));
                // Corners of the frame are more than a right angle off the axis.
                let Some(m) = camera.normalised(px) else { continue };
                assert!((camera.pixel_of(m).0 - px).norm() < 1e-7, "{px}");
            }
        }
        let off_axis = camera.normalised(Vector2::new(1200.0, 520.0)).expect("inside the frame");
        assert!(off_axis.x > 1.9, "{off_axis}");
    }

    #[test]
    fn a_fisheye_is_that_of_opencv() {
        let camera = CameraModel {
            fx: 300.0,
            fy: 310.0,
            cx: 320.0,
            cy: 240.0,
            model: LensModel::Fisheye,
            distortion: [-0.01, 0.0, 0.0, 0.0, 0.0],
            skew: 0.0,
        };
        let r = 0.5f64.hypot(0.3);
        let angle = r.atan();
        let bent = angle - 0.01 * angle.powi(3);
        let px = camera.project(&Vector3::new(0.5, -0.3, 1.0)).expect("in front").px;
        let expected = Vector2::new(320.0 + 300.0 * 0.5 / r * bent, 240.0 - 310.0 * 0.3 / r * bent);
        assert!((px - expected).norm() < 1e-9, "{px}");
    }

    #[test]
    fn derivatives_match_differences() {
        let points =
            [Vector3::new(2.1, -1.4, 6.0), Vector3::new(9.1, 3.4, 6.0), Vector3::new(1e-9, 0.0, 6.0)];
        for (camera, point) in [paper_camera(), fisheye()]
            .into_iter()
            .flat_map(|c| points.map(|p| (c, p)))
            .filter(|(c, p)| c.model == LensModel::Fisheye || p.x < 9.0)
        {
            let at = camera.project(&point).expect("in front");
            for axis in 0..3 {
                let mut moved = point;
                moved[axis] += 1e-6;
                let difference = (camera.project(&moved).expect("in front").px - at.px) / 1e-6;
                assert!((difference - at.d_point.column(axis)).norm() < 1e-3, "{point} along {axis}");
            }
        }
    }

    #[test]
    fn behind_the_camera_is_nothing() {
        assert!(paper_camera().project(&Vector3::new(0.0, 0.0, -1.0)).is_none());
        assert!(paper_camera().project(&Vector3::new(0.0, 0.0, f64::NAN)).is_none());
    }
}
