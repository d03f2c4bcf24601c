//! Corners of a decoded tag to a few hundredths of a pixel, with their covariance: every edge between its
//! dark and light cells, not only the border, takes part in one fit.
//!
//! Model, with ξ, η ∈ [−1, 1] across the border square: `p = H(ξ, η) + c₁ (η² − 1) x̂ + c₂ (ξ² − 1) ŷ`, a
//! homography and two bows, which is what a lens does to the straight sides of a large tag; x̂, ŷ are the
//! tag's axes in the image. The bows vanish at the corners and are held near nought by what a wide lens
//! does. Gauss–Newton on distances along edge normals, Cauchy weights.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::family::Family;
use super::homography::Homography;
use super::quad::{Quad, bilinear, distance};
use crate::msg::ImageView;

const PARAMETERS: usize = 10;

type Information = SMatrix<f64, PARAMETERS, PARAMETERS>;
type Row = SVector<f64, PARAMETERS>;

/// A refined tag.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Refined {
    pub corners: [Vector2<f64>; 4],
    pub corner_cov: [Matrix2<f64>; 4],
    pub center: Vector2<f64>,
    pub center_cov: Matrix2<f64>,
}

/// A point on an edge between a dark and a light cell.
#[derive(Clone, Copy, PartialEq, Debug)]
struct EdgePoint {
    xi: f64,
    eta: f64,
    /// From dark to light in tag coordinates.
    light: [f64; 2],
}

/// One located edge: `residual` px along the normal, ∂/∂parameters, weight.
#[derive(Clone, Copy, Debug)]
struct Located {
    row: Row,
    residual: f64,
    strength: f64,
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

/// Finds edges and fits them; keeps its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Refiner {
    points: Vec<EdgePoint>,
    located: Vec<Located>,
}

impl Refiner {
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
            self.locate(image, &model, half, if round == 0 { 2 } else { 1 });
            if self.located.len() < 24 {
                return None;
            }
            let spread = self.spread();
            let (step, info, var) = self.solve(&model, bow, spread)?;
            model.theta += step;
            (information, variance) = (info, var);
            if round > 0 && step.rows(0, 6).amax() < 0.005 {
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
        let light = |x: i32, y: i32| family.is_light(id, x, y);
        let scale = 2.0 / f64::from(w);
        for y in 0..w {
            for x in 0..=w {
                if let (Some(a), Some(b)) = (light(x - 1, y), light(x, y))
                    && a != b
                {
                    for k in 0..per_cell {
                        let t = (k as f64 + 0.5) / per_cell as f64;
                        let sign = if b { 1.0 } else { -1.0 };
                        let along = (f64::from(y) + t) * scale - 1.0;
                        self.points.push(EdgePoint {
                            xi: f64::from(x) * scale - 1.0,
                            eta: along,
                            light: [sign, 0.0],
                        });
                    }
                }
                if let (Some(a), Some(b)) = (light(y, x - 1), light(y, x))
                    && a != b
                {
                    for k in 0..per_cell {
                        let t = (k as f64 + 0.5) / per_cell as f64;
                        let sign = if b { 1.0 } else { -1.0 };
                        let along = (f64::from(y) + t) * scale - 1.0;
                        self.points.push(EdgePoint {
                            xi: along,
                            eta: f64::from(x) * scale - 1.0,
                            light: [0.0, sign],
                        });
                    }
                }
            }
        }
    }

    fn locate(&mut self, image: ImageView<'_>, model: &Model, half: f64, every: usize) {
        self.located.clear();
        for point in self.points.iter().step_by(every) {
            let (p, jacobian) = model.at(point.xi, point.eta);
            // The normal of the edge in the image: across the direction in which it runs.
            let (d_xi, d_eta) = model.directions(point.xi, point.eta);
            let along = d_eta * point.light[0] - d_xi * point.light[1];
            let towards = d_xi * point.light[0] + d_eta * point.light[1];
            let length = along.norm();
            if !(length > 1e-9) {
                continue;
            }
            let mut n = Vector2::new(-along.y, along.x) / length;
            if n.dot(&towards) < 0.0 {
                n = -n;
            }
            if let Some((offset, strength)) = edge_offset(image, p, n, half) {
                let row: Row = jacobian.tr_mul(&n);
                self.located.push(Located { row, residual: offset, strength });
            }
        }
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
        let mut information = Information::zeros();
        let mut right = Row::zeros();
        let (mut sum, mut weights) = (0.0, 0.0);
        let mean = self.located.iter().map(|l| l.strength).sum::<f64>() / self.located.len() as f64;
        for l in &self.located {
            let normalised = l.residual / (2.0 * spread);
            // Strong edges are located better, up to the point where noise no longer tells.
            let weight = (l.strength / mean).min(1.5) / (1.0 + normalised * normalised);
            for i in 0..PARAMETERS {
                let scaled = weight * l.row[i];
                (0..=i).for_each(|j| information[(i, j)] += scaled * l.row[j]);
            }
            right.axpy(weight * l.residual, &l.row, 1.0);
            sum += weight * l.residual * l.residual;
            weights += weight;
        }
        let variance = sum / weights * self.located.len() as f64 / (self.located.len() as f64 - 8.0);
        information.fill_upper_triangle_with_lower_triangle();
        for k in 8..PARAMETERS {
            let hold = variance.max(1e-4) / (bow * bow);
            information[(k, k)] += hold;
            right[k] -= hold * model.theta[k];
        }
        let step = information.cholesky()?.solve(&right);
        step.iter().all(|s| s.is_finite()).then_some((step, information, variance))
    }
}

/// Homography in ξ, η (row by row, last entry 1), and the two bows.
#[derive(Clone, Copy, Debug)]
struct Model {
    theta: Row,
    axes: [Vector2<f64>; 2],
}

impl Model {
    fn of_corners(corners: &Quad) -> Option<Self> {
        let wide = corners.map(|p| p.map(f64::from));
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
        Some(Self { theta, axes: [unit(0, 1), unit(0, 3)] })
    }

    /// Pixel of a tag point and ∂pixel/∂parameters.
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

    /// Images of the directions of ξ and η.
    fn directions(&self, xi: f64, eta: f64) -> (Vector2<f64>, Vector2<f64>) {
        let t = &self.theta;
        let w = 1.0 / (t[6] * xi + t[7] * eta + 1.0);
        let (u, v) = ((t[0] * xi + t[1] * eta + t[2]) * w, (t[3] * xi + t[4] * eta + t[5]) * w);
        let d_xi = Vector2::new(t[0] - u * t[6], t[3] - v * t[6]) * w + self.axes[1] * (2.0 * t[9] * xi);
        let d_eta = Vector2::new(t[1] - u * t[7], t[4] - v * t[7]) * w + self.axes[0] * (2.0 * t[8] * eta);
        (d_xi, d_eta)
    }

    fn result(&self, information: &Information, variance: f64, cell: f64) -> Option<Refined> {
        let shared = SHARED * (1.0 + (SHARED_CELL / cell).powi(3));
        let covariance = information.cholesky()?.inverse() * (variance * shared);
        let neighbours = (NEIGHBOURS / cell.powi(3)).min(0.25);
        let floor = Matrix2::identity() * (FLOOR_PX * FLOOR_PX + neighbours * neighbours);
        let at = |xi: f64, eta: f64| {
            let (p, jacobian) = self.at(xi, eta);
            (p, jacobian * covariance * jacobian.transpose() + floor)
        };
        let corners = [at(-1.0, -1.0), at(1.0, -1.0), at(1.0, 1.0), at(-1.0, 1.0)];
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

/// Where along `n` from `p` the image steps up, pixels, and how strongly: the centre of mass of the
/// gradient under a biweight window of half width `half`, which follows the centre it finds. A blurred edge is
/// symmetric, and so is the window: the centre is not biased by where the search began.
fn edge_offset(image: ImageView<'_>, p: Vector2<f64>, n: Vector2<f64>, half: f64) -> Option<(f64, f64)> {
    const MOST: usize = 16;
    let spacing = (half * 0.25).max(0.5);
    let reach = ((half * 1.5 / spacing).ceil() as usize).min(MOST / 2 - 1);
    let count = 2 * reach + 1;
    let far = p + n * (reach as f64 * spacing);
    let near = p - n * (reach as f64 * spacing);
    let inside = |q: Vector2<f64>| {
        q.x >= 0.0 && q.y >= 0.0 && q.x <= (image.width - 1) as f64 && q.y <= (image.height - 1) as f64
    };
    if !(inside(far) && inside(near)) {
        return None;
    }
    let (start, step) = ([near.x as f32, near.y as f32], [(n.x * spacing) as f32, (n.y * spacing) as f32]);
    let mut gradients = [0.0f32; MOST];
    let mut before = bilinear(image, start);
    for (k, gradient) in gradients.iter_mut().enumerate().take(count - 1) {
        let along = (k + 1) as f32;
        let value = bilinear(image, [start[0] + along * step[0], start[1] + along * step[1]]);
        *gradient = value - before;
        before = value;
    }
    let (half, spacing) = (half as f32, spacing as f32);
    let (mut center, mut mass) = (0.0, 0.0);
    for _ in 0..3 {
        let (mut first, mut sum) = (0.0, 0.0);
        for (k, gradient) in gradients.iter().enumerate().take(count - 1) {
            let d = (k as f32 + 0.5 - reach as f32) * spacing - center;
            let taper = (1.0 - (d / half) * (d / half)).max(0.0);
            first += gradient * taper * taper * d;
            sum += gradient * taper * taper;
        }
        if !(sum > 3.0) {
            return None;
        }
        center += (first / sum).clamp(-0.5 * half, 0.5 * half);
        mass = sum;
        if center.abs() > 0.6 * half {
            return None;
        }
    }
    Some((f64::from(center), f64::from(mass)))
}
