//! Corners of a decoded tag to a few hundredths of a pixel, with their covariance: every edge between its
//! dark and light cells, not only the border, takes part in one fit.
//!
//! Model, with ξ, η ∈ [−1, 1] across the border square: `p = H(ξ, η) + c₁ (η² − 1) x̂ + c₂ (ξ² − 1) ŷ`, a
//! homography and two bows, which is what a lens does to the straight sides of a large tag; x̂, ŷ are the
//! tag's axes in the image. The bows vanish at the corners and are held near nought by what a wide lens
//! does. Gauss–Newton on distances along edge normals, Cauchy weights.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::edge_points::{EdgePoint, Locate, Located, NarrowModel, PADDED, PARAMETERS};
use super::family::Family;
use super::homography::Homography;
use super::quad::{Quad, distance};
use super::simd::Simd;
use crate::msg::ImageView;

type Information = SMatrix<f64, PARAMETERS, PARAMETERS>;
type Row = SVector<f64, PARAMETERS>;

/// Where the corners are in ξ and η.
const CORNERS: [(f64, f64); 4] = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];

/// A refined tag.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Refined {
    pub corners: [Vector2<f64>; 4],
    pub corner_cov: [Matrix2<f64>; 4],
    pub center: Vector2<f64>,
    pub center_cov: Matrix2<f64>,
}

/// Curvature that a wide lens gives straight lines, 1/px: 0.18 r² distortion at a focal length of 1000 px
/// gives 2·10⁻⁴ to 6·10⁻⁴ towards the rim.
const LENS_CURVATURE: f64 = 3e-4;

/// Neighbouring points share pixels, so that their errors are alike: independent points are fewer by this,
/// and by more where blur reaches from cell to cell, below about `SHARED_CELL` pixels a cell. Measured on
/// generated tags.
const SHARED: f64 = 1.7;
const SHARED_CELL: f64 = 4.0;

/// Error that neighbouring cells put on an edge, pixels at one pixel a cell: blur brings them in where cells
/// are small, and with the cube of their size it is gone. Measured on generated tags.
const NEIGHBOURS: f64 = 4.5;

/// What stays of an edge's error when noise is averaged away: sampling, neighbouring cells, print. Pixels.
const FLOOR_PX: f64 = 0.02;

/// A step that moves no corner further is the last, pixels: each is about a third of the one before.
const SETTLED_PX: f64 = 0.02;

/// Weights that follow residuals make each step about a third too short.
const OVERSTEP: f64 = 1.4;

/// Finds edges and fits them; keeps its buffers.
#[derive(Clone, Debug)]
pub(super) struct Refiner {
    simd: Simd,
    points: Vec<EdgePoint>,
    located: Vec<Located>,
    /// Whether the tag's cells, its ring included, are light, row by row.
    lights: Vec<bool>,
}

impl Refiner {
    pub fn new(simd: Simd) -> Self {
        Self { simd, points: Vec::new(), located: Vec::new(), lights: Vec::new() }
    }

    /// Refines corners given in the tag's own order; `None` where too few edges are seen or the fit leaves
    /// what was given.
    pub fn refine(
        &mut self,
        image: ImageView<'_>,
        corners: &Quad,
        family: &Family,
        id: u32,
    ) -> Option<Refined> {
        let edge = (0..4).map(|i| distance(corners[i], corners[(i + 1) % 4])).sum::<f32>() / 4.0;
        let cell = f64::from(edge) / family.width as f64;
        self.place_points(family, id, cell);
        let mut model = Model::of_corners(corners)?;
        let bow = LENS_CURVATURE * f64::from(edge).powi(2) / 8.0;
        let mut information = Information::zeros();
        let mut variance = 0.0;
        for round in 0..6 {
            let half = if round == 0 { (0.7 * cell).clamp(1.5, 6.0) } else { (0.5 * cell).clamp(1.25, 4.0) };
            self.locate(image, &model, half as f32, if round == 0 { 2 } else { 1 });
            if self.located.len() < 24 {
                return None;
            }
            let spread = self.spread();

            let (step, info, var) = self.solve(&model, bow, spread)?;
            let before = model;
            model.theta += step * if round == 0 { 1.0 } else { OVERSTEP };
            (information, variance) = (info, var);
            if round > 0 && model.moved(&before) < SETTLED_PX {
                break;
            }
        }
        let refined = model.result(&information, variance, cell)?;
        let moved = (0..4).map(|i| {
            (refined.corners[i] - Vector2::new(f64::from(corners[i][0]), f64::from(corners[i][1]))).norm()
        });
        (moved.fold(0.0, f64::max) < (1.5 * cell).max(2.0)).then_some(refined)
    }

    /// Points along every edge between cells of different colour.
    fn place_points(&mut self, family: &Family, id: u32, cell: f64) {
        self.points.clear();
        let w = family.width as i32;
        let per_cell = (cell / 1.4).clamp(2.0, 4.0) as usize;
        self.lights.clear();
        let around = (-1..=w).flat_map(|y| (-1..=w).map(move |x| (x, y)));
        self.lights.extend(around.map(|(x, y)| family.is_light(id, x, y) == Some(true)));
        let light = |x: i32, y: i32| self.lights[((y + 1) * (w + 2) + x + 1) as usize];
        let scale = 2.0 / w as f32;
        for y in 0..w {
            for x in 0..=w {
                let edge = x as f32 * scale - 1.0;
                let (upright, level) = ((light(x - 1, y), light(x, y)), (light(y, x - 1), light(y, x)));
                for k in 0..per_cell {
                    let along = (y as f32 + (k as f32 + 0.5) / per_cell as f32) * scale - 1.0;
                    let sign = |to: bool| if to { 1.0 } else { -1.0 };
                    if upright.0 != upright.1 {
                        self.points.push(EdgePoint { xi: edge, eta: along, light: [sign(upright.1), 0.0] });
                    }
                    if level.0 != level.1 {
                        self.points.push(EdgePoint { xi: along, eta: edge, light: [0.0, sign(level.1)] });
                    }
                }
            }
        }
    }

    fn locate(&mut self, image: ImageView<'_>, model: &Model, half: f32, every: usize) {
        let Self { points, located, .. } = self;
        self.simd.run(Locate { points, located, image, model: model.narrow(), half, every });
    }

    /// Robust spread of the residuals, pixels.
    fn spread(&self) -> f64 {
        let mut histogram = [0u32; 64];
        for l in &self.located {
            histogram[((l.residual.abs() * 32.0) as usize).min(63)] += 1;
        }
        let (mut below, mut median) = (0, 2.0);
        for (bin, count) in histogram.iter().enumerate() {
            below += count;
            if 2 * below as usize >= self.located.len() {
                median = (bin as f64 + 0.5) / 32.0;
                break;
            }
        }
        (1.4826 * median).max(0.08)
    }

    fn solve(&self, model: &Model, bow: f64, spread: f64) -> Option<(Row, Information, f64)> {
        let mut sums = [[0.0f32; PADDED]; PARAMETERS];
        let mut rights = [0.0f32; PADDED];
        let (mut sum, mut weights) = (0.0, 0.0);
        let count = self.located.len() as f32;
        let mean = self.located.iter().map(|l| l.strength).sum::<f32>() / count;
        for l in &self.located {
            let normalised = l.residual / (2.0 * spread as f32);
            // Strong edges are located better, up to the point where noise no longer tells.
            let weight = (l.strength / mean).min(1.5) / (1.0 + normalised * normalised);
            for (sums, r) in sums.iter_mut().zip(l.row) {
                add_scaled(sums, weight * r, &l.row);
            }
            add_scaled(&mut rights, weight * l.residual, &l.row);
            sum += weight * l.residual * l.residual;
            weights += weight;
        }
        let variance = f64::from(sum / weights * count / (count - 8.0));
        let mut information = Information::from_fn(|i, j| f64::from(sums[i.min(j)][i.max(j)]));
        let mut right = Row::from_fn(|i, _| f64::from(rights[i]));
        for k in 8..PARAMETERS {
            let hold = variance.max(1e-4) / (bow * bow);
            information[(k, k)] += hold;
            right[k] -= hold * model.theta[k];
        }
        let step = information.cholesky()?.solve(&right);
        step.iter().all(|s| s.is_finite()).then_some((step, information, variance))
    }
}

#[inline(always)]
fn add_scaled(to: &mut [f32; PADDED], factor: f32, row: &[f32; PADDED]) {
    to.iter_mut().zip(row).for_each(|(to, r)| *to += factor * r);
}

/// Homography in ξ, η (row by row, last entry 1), and the two bows.
#[derive(Clone, Copy, Debug)]
struct Model {
    theta: Row,
    axes: [Vector2<f64>; 2],
    /// Of the pixels meant here: near the tag, so that the parameters are of one size.
    origin: Vector2<f64>,
}

impl Model {
    fn of_corners(corners: &Quad) -> Option<Self> {
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
        let unit = |a: usize, b: usize| {
            let d = Vector2::new(wide[b][0] - wide[a][0], wide[b][1] - wide[a][1]);
            d / d.norm().max(1e-9)
        };
        Some(Self { theta, axes: [unit(0, 1), unit(0, 3)], origin: origin.into() })
    }

    /// How far a corner is from where another model has it, at most.
    fn moved(&self, other: &Self) -> f64 {
        let moved = |(x, y): (f64, f64)| (self.at(x, y).0 - other.at(x, y).0).norm();
        CORNERS.into_iter().map(moved).fold(0.0, f64::max)
    }

    /// Pixel of a tag point, from the origin, and ∂pixel/∂parameters.
    fn at(&self, xi: f64, eta: f64) -> (Vector2<f64>, SMatrix<f64, 2, PARAMETERS>) {
        let t = &self.theta;
        let w = 1.0 / (t[6] * xi + t[7] * eta + 1.0);
        let (u, v) = ((t[0] * xi + t[1] * eta + t[2]) * w, (t[3] * xi + t[4] * eta + t[5]) * w);
        let (bow_x, bow_y) = (eta * eta - 1.0, xi * xi - 1.0);
        let (x, y) = (self.axes[0], self.axes[1]);
        let p = Vector2::new(u, v) + x * (t[8] * bow_x) + y * (t[9] * bow_y);
        #[rustfmt::skip]
        let jacobian = SMatrix::<f64, 2, PARAMETERS>::from_row_slice(&[
            xi * w, eta * w, w, 0.0, 0.0, 0.0, -u * xi * w, -u * eta * w, x.x * bow_x, y.x * bow_y,
            0.0, 0.0, 0.0, xi * w, eta * w, w, -v * xi * w, -v * eta * w, x.y * bow_x, y.y * bow_y,
        ]);
        (p, jacobian)
    }

    fn narrow(&self) -> NarrowModel {
        NarrowModel {
            theta: std::array::from_fn(|i| self.theta[i] as f32),
            axes: self.axes.map(|a| [a.x as f32, a.y as f32]),
            origin: [self.origin.x as f32, self.origin.y as f32],
        }
    }

    fn result(&self, information: &Information, variance: f64, cell: f64) -> Option<Refined> {
        let shared = SHARED * (1.0 + (SHARED_CELL / cell).powi(3));
        let covariance = information.cholesky()?.inverse() * (variance * shared);
        let neighbours = (NEIGHBOURS / cell.powi(3)).min(0.25);
        let floor = Matrix2::identity() * (FLOOR_PX * FLOOR_PX + neighbours * neighbours);
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
