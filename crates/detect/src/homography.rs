//! Plane-to-image homographies of a tag.

use super::quad::{Point, Quad};

/// Maps tag coordinates (x, y) to pixels: `[u v 1] ~ H [x y 1]`, row by row, last entry 1.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Homography(pub [f64; 9]);

impl Homography {
    /// Takes the square with corners (0, 0), (s, 0), (s, s), (0, s) to four points (Heckbert 1989,
    /// §2.2.3). `None` where three of them lie on a line.
    pub fn of_square(s: f64, corners: &[[f64; 2]; 4]) -> Option<Self> {
        let [p0, p1, p2, p3] = *corners;
        let (d1, d2) = ([p1[0] - p2[0], p1[1] - p2[1]], [p3[0] - p2[0], p3[1] - p2[1]]);
        let sum = [p0[0] - p1[0] + p2[0] - p3[0], p0[1] - p1[1] + p2[1] - p3[1]];
        let det = d1[0] * d2[1] - d2[0] * d1[1];
        if !(det.abs() > 1e-9) {
            return None;
        }
        let g = (sum[0] * d2[1] - d2[0] * sum[1]) / det;
        let h = (d1[0] * sum[1] - sum[0] * d1[1]) / det;
        let row = |k: usize| [p1[k] - p0[k] + g * p1[k], p3[k] - p0[k] + h * p3[k], p0[k]];
        let (u, v) = (row(0), row(1));
        Some(Self([u[0] / s, u[1] / s, u[2], v[0] / s, v[1] / s, v[2], g / s, h / s, 1.0]))
    }

    /// The pixel of a tag point.
    pub fn apply(&self, x: f64, y: f64) -> [f64; 2] {
        let m = &self.0;
        let w = 1.0 / (m[6] * x + m[7] * y + m[8]);
        [(m[0] * x + m[1] * y + m[2]) * w, (m[3] * x + m[4] * y + m[5]) * w]
    }
}

/// A quadrilateral in double precision.
pub(super) fn wide(quad: &Quad) -> [[f64; 2]; 4] {
    quad.map(|p| p.map(f64::from))
}

/// A point in single precision.
pub(super) fn narrow(p: [f64; 2]) -> Point {
    p.map(|c| c as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_go_to_corners() {
        let corners = [[10.0, 11.0], [55.0, 14.0], [60.0, 70.0], [5.0, 48.0]];
        let h = Homography::of_square(8.0, &corners).expect("a quadrilateral");
        for (corner, (x, y)) in corners.iter().zip([(0.0, 0.0), (8.0, 0.0), (8.0, 8.0), (0.0, 8.0)]) {
            let p = h.apply(x, y);
            assert!((p[0] - corner[0]).hypot(p[1] - corner[1]) < 1e-9);
        }
        assert_eq!(Homography::of_square(8.0, &[[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]), None);
    }
}
