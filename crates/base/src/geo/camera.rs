//! The pinhole camera with Brown's distortion, as OpenCV and the MATLAB toolbox define it.

use nalgebra::{Matrix2, Matrix2x3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// Intrinsic parameters. Pixel (0, 0) is the centre of the top-left pixel.
///
/// With `x = X/Z`, `y = Y/Z`, `r² = x² + y²`:
/// `xd = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)`,
/// `yd = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y`,
/// `u = fx (xd + skew · yd) + cx`, `v = fy yd + cy` (Brown 1966; Bouguet's toolbox, `skew` is its α).
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
    /// k1, k2, p1, p2, k3.
    #[serde(default)]
    pub distortion: [f64; 5],
    /// Bouguet's α: the skew of the pixel axes.
    #[serde(default)]
    pub skew: f64,
}

/// A projected point with its derivative.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Projection {
    /// Pixel (u, v).
    pub px: Vector2<f64>,
    /// ∂(u, v)/∂(X, Y, Z) in the camera frame.
    pub d_point: Matrix2x3<f64>,
}

impl CameraModel {
    /// Distorted normalised coordinates of undistorted ones, and the derivative.
    pub fn distort(&self, m: Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
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

    /// Undistorted normalised coordinates of distorted ones: Newton's method from the distorted point. `None` where it
    /// does not converge (beyond the radius at which the polynomial folds).
    pub fn undistort(&self, distorted: Vector2<f64>) -> Option<Vector2<f64>> {
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

    #[test]
    fn derivatives_match_differences() {
        let camera = paper_camera();
        let point = Vector3::new(2.1, -1.4, 6.0);
        let at = camera.project(&point).expect("in front");
        for axis in 0..3 {
            let mut moved = point;
            moved[axis] += 1e-6;
            let difference = (camera.project(&moved).expect("in front").px - at.px) / 1e-6;
            assert!((difference - at.d_point.column(axis)).norm() < 1e-3);
        }
    }

    #[test]
    fn behind_the_camera_is_nothing() {
        assert!(paper_camera().project(&Vector3::new(0.0, 0.0, -1.0)).is_none());
        assert!(paper_camera().project(&Vector3::new(0.0, 0.0, f64::NAN)).is_none());
    }
}
