//! Where the points of a tag are in the image, as a function of some parameters.

use nalgebra::{Matrix2, SMatrix, Vector2};

use super::edge_points::{NarrowModel, PARAMETERS};
use super::equations::{Information, Row};
use super::homography::Homography;
use super::quad::Quad;

/// Where the corners are in ξ and η.
const CORNERS: [(f64, f64); 4] = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];

/// The first parameter that moves edges and not the tag.
const SHIFTS: usize = 13;

/// A refined tag.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Refined {
    pub corners: [Vector2<f64>; 4],
    pub corner_cov: [Matrix2<f64>; 4],
    pub center: Vector2<f64>,
    pub center_cov: Matrix2<f64>,
}

/// Part of an edge's error that remains when noise is averaged out: sampling, neighbouring cells, print. Pixels.
pub(super) const FLOOR_PX: f64 = 0.02;
/// The same of a fit to pixels, whose model includes neighbouring cells and sampling.
pub(super) const PIXELS_FLOOR_PX: f64 = 0.004;

/// Homography in ξ, η (row by row, last entry 1), the bow, the barrel, the twist, the shifts of edges and
/// the spread of light.
#[derive(Clone, Copy, Debug)]
pub(super) struct Model {
    pub theta: Row,
    /// Half sides over the root mean square of their lengths: a and b.
    sides: [Vector2<f64>; 2],
    /// Origin of the pixel coordinates used here: near the tag, so that the parameters have similar size.
    origin: Vector2<f64>,
    /// Whether light spreads from white cells.
    spreads: bool,
}

impl Model {
    pub fn of_corners(corners: &Quad, spreads: bool) -> Option<Self> {
        let origin = [0, 1].map(|k| corners.iter().map(|p| f64::from(p[k])).sum::<f64>() / 4.0);
        let wide = corners.map(|p| [f64::from(p[0]) - origin[0], f64::from(p[1]) - origin[1]]);
        // A square from 0 to 2, moved by one.
        let h = Homography::of_square(2.0, &wide)?.0;
        let moved = [h[2] + h[0] + h[1], h[5] + h[3] + h[4], 1.0 + h[6] + h[7]];
        if !(moved[2].abs() > 1e-9) {
            return None;
        }
        let s = 1.0 / moved[2];
        let mut theta = Row::zeros();
        let entries =
            [h[0] * s, h[1] * s, moved[0] * s, h[3] * s, h[4] * s, moved[1] * s, h[6] * s, h[7] * s];
        theta.rows_mut(0, 8).copy_from_slice(&entries);
        let side = |a: usize, b: usize| Vector2::new(wide[b][0] - wide[a][0], wide[b][1] - wide[a][1]);
        let sides = [side(0, 1) + side(3, 2), side(0, 3) + side(1, 2)];
        let length = (0.5 * (sides[0].norm_squared() + sides[1].norm_squared())).sqrt();
        Some(Self { theta, sides: sides.map(|s| s / length.max(1e-9)), origin: origin.into(), spreads })
    }

    /// Largest distance between a corner and the same corner of another model.
    pub fn moved(&self, other: &Self) -> f64 {
        let moved = |(x, y): (f64, f64)| (self.at(x, y).0 - other.at(x, y).0).norm();
        CORNERS.into_iter().map(moved).fold(0.0, f64::max)
    }

    /// Pixel of a tag point, from the origin, and ∂pixel/∂parameters.
    fn at(&self, xi: f64, eta: f64) -> (Vector2<f64>, SMatrix<f64, 2, PARAMETERS>) {
        let t = &self.theta;
        let w = 1.0 / (t[6] * xi + t[7] * eta + 1.0);
        let (u, v) = ((t[0] * xi + t[1] * eta + t[2]) * w, (t[3] * xi + t[4] * eta + t[5]) * w);
        let q = self.sides[0] * xi + self.sides[1] * eta;
        let far = q.norm_squared() - 2.0;
        let (even, odd) = (q.x * q.x - q.y * q.y, 2.0 * q.x * q.y);
        let twist = Vector2::new(t[11] * even - t[12] * odd, -t[11] * odd - t[12] * even);
        let p = Vector2::new(u, v) + (Vector2::new(t[8], t[9]) + q * t[10]) * far + twist;
        #[rustfmt::skip]
        let jacobian = SMatrix::<f64, 2, PARAMETERS>::from_row_slice(&[
            xi * w, eta * w, w, 0.0, 0.0, 0.0, -u * xi * w, -u * eta * w, far, 0.0, far * q.x, even, -odd, 0.0, 0.0, 0.0,
            0.0, 0.0, 0.0, xi * w, eta * w, w, -v * xi * w, -v * eta * w, 0.0, far, far * q.y, -odd, -even, 0.0, 0.0, 0.0,
        ]);
        (p, jacobian)
    }

    pub fn narrow(&self) -> NarrowModel {
        NarrowModel {
            theta: std::array::from_fn(|i| self.theta[i] as f32),
            sides: self.sides.map(|a| [a.x as f32, a.y as f32]),
            origin: [self.origin.x as f32, self.origin.y as f32],
            spreads: f32::from(u8::from(self.spreads)),
        }
    }

    /// Width of a cell across its edges, for edges crossed along ξ and along η, at the tag's middle, pixels.
    pub fn pitches(&self, width: usize) -> [f64; 2] {
        let t = &self.theta;
        let (d_xi, d_eta) = (
            Vector2::new(t[0] - t[2] * t[6], t[3] - t[5] * t[6]),
            Vector2::new(t[1] - t[2] * t[7], t[4] - t[5] * t[7]),
        );
        let area = (d_xi.x * d_eta.y - d_xi.y * d_eta.x).abs() * 2.0 / width as f64;
        [area / d_eta.norm().max(1e-9), area / d_xi.norm().max(1e-9)]
    }

    /// How far blur moves the visible edges beside cells that are one wide towards the other cell, for edges crossed
    /// along ξ (0) or η (1), pixels.
    pub fn shift(&self, axis: usize) -> f64 {
        self.theta[SHIFTS + axis]
    }

    /// The same without shifts of edges.
    pub fn without_shifts(&self) -> Self {
        let mut model = *self;
        model.theta.rows_mut(SHIFTS, PARAMETERS - SHIFTS).fill(0.0);
        model
    }

    /// Half sides over the root mean square of their lengths.
    pub fn sides(&self) -> [Vector2<f64>; 2] {
        self.sides
    }

    /// The pixel of a tag point.
    pub fn pixel(&self, xi: f64, eta: f64) -> Vector2<f64> {
        self.at(xi, eta).0 + self.origin
    }

    /// Where the pixel coordinates of the parameters begin.
    pub fn origin(&self) -> Vector2<f64> {
        self.origin
    }

    /// Corners and centre with their covariances; `common` are variances that all edges crossed along ξ and all those
    /// along η share, px², `floor_px` is an error that no other term contains.
    pub fn result(&self, covariance: &Information, common: [f64; 2], floor_px: f64) -> Option<Refined> {
        let axes = self.sides.map(|s| s / s.norm().max(1e-9));
        let shared = (0..2).map(|i| axes[i] * axes[i].transpose() * common[i]);
        let floor = shared.fold(Matrix2::identity() * floor_px.powi(2), |sum, c| sum + c);
        let at = |xi: f64, eta: f64| {
            let (p, jacobian) = self.at(xi, eta);
            (p + self.origin, jacobian * covariance * jacobian.transpose() + floor)
        };
        let corners = CORNERS.map(|(x, y)| at(x, y));
        let (center, center_cov) = at(0.0, 0.0);
        let finite = corners.iter().all(|c| c.0.iter().chain(c.1.iter()).all(|x| x.is_finite()));
        finite.then(|| Refined {
            corners: corners.map(|c| c.0),
            corner_cov: corners.map(|c| c.1),
            center,
            center_cov,
        })
    }
}
