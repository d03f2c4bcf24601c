//! Corners of a decoded tag to a few hundredths of a pixel, with their covariance: every edge between its
//! dark and light cells, not only the border, takes part in one fit.
//!
//! Model, with ξ, η ∈ [−1, 1] across the border square: `p = H(ξ, η) + (|q|² − 2) (c + k q)`, q = ξ a + η b: a
//! homography and what a lens with radial distortion adds to it over a small part of the image. With a point's
//! place P off the optical axis that is `κ |P|² P`; to third order about a tag's middle what is no homography is
//! `κ |q|² (P + q)`. a and b are half the tag's sides in the image over their mean length, so that the bow c and
//! the barrel k change nothing at a square's corners; they are held near nought by what a wide lens
//! does. Gauss–Newton on distances along edge normals, each weighed by how well its edge is placed, Cauchy's
//! weights on top.

use nalgebra::{Cholesky, Const, Matrix2, SMatrix, Vector2};

use super::edge_points::{EdgePoint, Locate, Located, NarrowModel, PARAMETERS};
use super::equations::{Accumulate, Advance, Equations, Information, Row, weigh};
use super::family::Family;
use super::homography::Homography;
use super::quad::{Quad, distance};
use super::simd::Simd;
use super::windows::{WIDEST_CELL, Windows};
use crate::msg::ImageView;

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

/// Curvature that a wide lens gives a tag's middle lines, 1/px: 2·0.18 r over a focal length of 1000 px, where it
/// distorts by 0.18 r², is 10⁻⁴ to 2·10⁻⁴ on the way to the rim.
const LENS_CURVATURE: f64 = 1.5e-4;

/// What a wide lens bends a tag's sides outwards by, over the third power of half their length, 1/px²: 0.3 r² at a
/// focal length of 1000 px.
const LENS_BARREL: f64 = 3e-7;

/// Cells on a side of a block: the errors of edges that near each other are alike, for they share pixels.
const BLOCK: usize = 2;

/// Blocks of the largest grid, and how many blocks' worth the fit takes up of the errors it is made from.
const MOST_BLOCKS: usize = 32;
const TAKEN_UP: f64 = 3.0;

/// Error that neighbouring cells put on all edges of one direction alike, pixels, at a blur of one pixel and one
/// pixel a cell: it grows with the square of the blur and falls with the cube of the cell. Measured on generated
/// tags.
const NEIGHBOURS: f64 = 3.6;

/// What stays of an edge's error when noise is averaged away: sampling, neighbouring cells, print. Pixels.
const FLOOR_PX: f64 = 0.02;

/// A step that moves no corner further is the last, pixels: each is about a third of the one before.
const SETTLED_PX: f64 = 0.02;
const MOST_ROUNDS: usize = 10;
const MOST_STEPS: usize = 4;

/// Share of the edges between a tag's cells that are seen where the fit is right. Where fewer are and windows reach
/// from cell to cell, edges were taken for their neighbours: blur is wider than a cell then, and corners are wrong
/// by so much of one, measured on generated tags.
const ENOUGH_SEEN: f64 = 0.93;
const MISTAKEN: f64 = 0.25;

/// Fewest edge points.
const LEAST_EDGES: usize = 24;

/// Finds edges and fits them; keeps its buffers.
#[derive(Clone, Debug)]
pub(super) struct Refiner {
    simd: Simd,
    /// On edges crossed along ξ, and along η.
    points: [Vec<EdgePoint>; 2],
    located: Vec<Located>,
    equations: Equations,
    /// Whether the tag's cells, its ring included, are light, row by row.
    lights: Vec<bool>,
}

impl Refiner {
    pub fn new(simd: Simd) -> Self {
        Self {
            simd,
            points: [Vec::new(), Vec::new()],
            located: Vec::new(),
            equations: Equations::default(),
            lights: Vec::new(),
        }
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
        let half = 0.5 * f64::from(edge);
        let (bow, barrel) = (LENS_CURVATURE * half.powi(2) / 2.0, LENS_BARREL * half.powi(3));
        let (covariance, windows) = self.fit(image, &mut model, family.width, [bow, bow, barrel])?;
        let (pitches, blurs) = (model.pitches(family.width), windows.blurs_squared());
        let seen = self.count() as f64 / self.points.iter().map(Vec::len).sum::<usize>() as f64;
        let mistaken = if seen < ENOUGH_SEEN && cell < WIDEST_CELL { MISTAKEN } else { 0.0 };
        let neighbours = [0, 1].map(|k| {
            let pitch = pitches[k];
            (NEIGHBOURS * blurs[k] / pitch.powi(3)).min(0.2 * pitch).hypot(mistaken * pitch)
        });
        let refined = model.result(&covariance, neighbours)?;
        let moved = (0..4).map(|i| {
            (refined.corners[i] - Vector2::new(f64::from(corners[i][0]), f64::from(corners[i][1]))).norm()
        });
        (moved.fold(0.0, f64::max) < (1.5 * cell).max(2.0)).then_some(refined)
    }

    /// Moves a model to where the edges are; the covariance of its parameters.
    ///
    /// First with few points and wide windows, until the corners are nearly right; then with all, in windows as
    /// narrow as the blur allows: in one narrower than a smear, edges stay where they are put.
    fn fit(
        &mut self,
        image: ImageView<'_>,
        model: &mut Model,
        cells: usize,
        bends: [f64; 3],
    ) -> Option<(Information, Windows)> {
        let mut windows = Windows::default();
        let (mut coarse, mut settled, mut spread) = (true, false, 0.0);
        let mut last = None;
        for round in 0..MOST_ROUNDS {
            let pitches = model.pitches(cells);
            windows.half = windows.halves(pitches, coarse);
            self.locate(image, model, windows.half, if coarse { 2 } else { 1 });
            if self.count() < LEAST_EDGES {
                return None;
            }
            self.normalise();
            if !settled {
                spread = self.spread();
            }
            let before = *model;
            last = Some(self.settle(model, bends, spread)?);
            let moved = model.moved(&before);
            windows.sharpness = self.sharpness();
            if windows.widen() && round + 2 < MOST_ROUNDS {
                settled = false;
                continue;
            }
            if !coarse && moved < SETTLED_PX {
                break;
            }
            settled = moved < 0.1;
            let nearly = 0.1 * pitches[0].min(pitches[1]);
            if coarse && (moved < nearly || round + 6 >= MOST_ROUNDS) {
                coarse = false;
                windows.narrow();
            }
        }
        Some((self.covariance(&last?, spread)?, windows))
    }

    /// Moves a model to where the located edges have it, their places left as they are.
    fn settle(&mut self, model: &mut Model, bends: [f64; 3], spread: f64) -> Option<Solved> {
        let mut last = None;
        for _ in 0..MOST_STEPS {
            let solved = self.solve(model, bends, spread)?;
            let before = *model;
            model.theta += solved.step;
            let step = std::array::from_fn(|k| solved.step[k] as f32);
            self.simd.run(Advance { located: &mut self.located, step });
            last = Some(solved);
            if model.moved(&before) < 0.25 * SETTLED_PX {
                break;
            }
        }
        last
    }

    /// Points along every edge between cells of different colour.
    fn place_points(&mut self, family: &Family, id: u32, cell: f64) {
        self.points.iter_mut().for_each(Vec::clear);
        let w = family.width as i32;
        let per_cell = (cell / 1.4).clamp(2.0, 4.0) as usize;
        self.lights.clear();
        let around = (-1..=w).flat_map(|y| (-1..=w).map(move |x| (x, y)));
        self.lights.extend(around.map(|(x, y)| family.is_light(id, x, y) == Some(true)));
        let light = |x: i32, y: i32| self.lights[((y + 1) * (w + 2) + x + 1) as usize];
        let scale = 2.0 / w as f32;
        let blocks = w as usize / BLOCK + 1;
        let block = |x: usize, y: usize| (x / BLOCK * blocks + y / BLOCK) as u8;
        // Upright edges, left of cell (x, y), and level ones, above cell (y, x).
        for (y, x, upright) in (0..w).flat_map(|y| (0..=w).flat_map(move |x| [(y, x, true), (y, x, false)])) {
            let cell = |x: i32| if upright { light(x, y) } else { light(y, x) };
            let (before, after) = (cell(x - 1), cell(x));
            if before == after {
                continue;
            }
            let light = if after { 1.0 } else { -1.0 };
            let across = x as f32 * scale - 1.0;
            let (x, y) = (x as usize, y as usize);
            for k in 0..per_cell {
                let along = (y as f32 + (k as f32 + 0.5) / per_cell as f32) * scale - 1.0;
                match upright {
                    true => self.points[0].push(EdgePoint { xi: across, eta: along, light, block: block(x, y) }),
                    false => self.points[1].push(EdgePoint { xi: along, eta: across, light, block: block(y, x) }),
                }
            }
        }
    }

    fn locate(&mut self, image: ImageView<'_>, model: &Model, half: [f32; 2], every: usize) {
        let Self { points, located, .. } = self;
        self.simd.run(Locate { points, located, image, model: model.narrow(), half, every });
    }

    /// How many edges are located.
    fn count(&self) -> usize {
        self.located.iter().map(|l| l.count).sum()
    }

    /// Makes strengths relative to their mean. Strong edges are located better, up to the point where noise no
    /// longer tells.
    fn normalise(&mut self) {
        let mean = self.located.iter().flat_map(|l| l.strength).sum::<f32>() / self.count() as f32;
        for strength in self.located.iter_mut().flat_map(|l| &mut l.strength) {
            *strength = (*strength / mean).min(1.5);
        }
    }

    /// Mean sharpness of the edges crossed along ξ and along η.
    fn sharpness(&self) -> [f64; 2] {
        let mut sums = [(0.0f32, 1e-3f32); 2];
        for l in &self.located {
            sums[l.axis].0 += l.sharpness.iter().sum::<f32>();
            sums[l.axis].1 += l.count as f32;
        }
        sums.map(|(sum, count)| f64::from(sum / count))
    }

    /// Robust spread of the residuals of edges of mean strength, pixels.
    fn spread(&self) -> f64 {
        let mut histogram = [0u32; 100];
        for (residual, strength) in
            self.located.iter().flat_map(|l| l.residual.iter().zip(&l.strength)).filter(|(_, s)| **s > 0.0)
        {
            histogram[((residual.abs() * strength * 32.0) as usize).min(99)] += 1;
        }
        let (mut below, mut median, all) = (0, 2.0, histogram.iter().sum::<u32>());
        for (bin, count) in histogram.iter().enumerate() {
            below += count;
            if 2 * below >= all {
                median = (bin as f64 + 0.5) / 32.0;
                break;
            }
        }
        (1.4826 * median).max(0.08)
    }

    fn solve(&mut self, model: &Model, bends: [f64; 3], spread: f64) -> Option<Solved> {
        let sums = &mut self.equations;
        self.simd.run(Accumulate { located: &self.located, spread: spread as f32, to: sums });
        let count = self.located.iter().map(|l| l.count).sum::<usize>() as f64;
        let variance = sums.squares() / (count - 8.0);
        let mut information = sums.matrix();
        let mut right = sums.right();
        for (k, bend) in (8..PARAMETERS).zip(bends) {
            let hold = variance.max(1e-4) / (bend * bend);
            information[(k, k)] += hold;
            right[k] -= hold * model.theta[k];
        }
        let information = information.cholesky()?;
        let step = information.solve(&right);
        let flattening = sums.flattening();
        step.iter().all(|s| s.is_finite()).then_some(Solved { step, information, flattening })
    }

    /// Covariance of the parameters: of M-estimates, with errors that are alike within a block. How much more
    /// they err together than each by itself is one number, from the blocks' pulls `g` on the parameters:
    /// `λ = Σ gᵀ A⁻¹ g / p`, which counts noise and whatever else the model leaves over; the covariance is
    /// `λ A⁻¹ / ρ²`, ρ being how much Cauchy's weights flatten the residuals.
    fn covariance(&self, solved: &Solved, spread: f64) -> Option<Information> {
        let mut pulls = [[0.0f32; PARAMETERS]; MOST_BLOCKS];
        for l in &self.located {
            let (weights, _) = weigh(l, spread as f32);
            for (lane, weight) in weights.into_iter().enumerate() {
                let pull = weight * l.residual[lane];
                let to = &mut pulls[usize::from(l.block[lane])];
                to.iter_mut().zip(&l.rows).for_each(|(to, row)| *to += pull * row[lane]);
            }
        }
        let (mut sum, mut blocks) = (0.0, 0.0f64);
        for pull in pulls.iter().filter(|b| b.iter().any(|x| *x != 0.0)) {
            let mut pull = Row::from_fn(|i, _| f64::from(pull[i]));
            solved.information.l_dirty().solve_lower_triangular_mut(&mut pull);
            sum += pull.norm_squared();
            blocks += 1.0;
        }
        // The fit takes up some of it, most in the corners. Bow and barrel are held: eight are free.
        let lambda = sum / 8.0 / (1.0 - TAKEN_UP / blocks).max(0.5);
        let flattening = solved.flattening.clamp(0.4, 1.0);
        (blocks > 4.0).then(|| solved.information.inverse() * (lambda / (flattening * flattening)))
    }
}

/// One step of the fit.
struct Solved {
    step: Row,
    information: Cholesky<f64, Const<PARAMETERS>>,
    flattening: f64,
}

/// Homography in ξ, η (row by row, last entry 1), the bow and the barrel.
#[derive(Clone, Copy, Debug)]
struct Model {
    theta: Row,
    /// Half sides over the root mean square of their lengths: a and b.
    sides: [Vector2<f64>; 2],
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
        let side = |a: usize, b: usize| Vector2::new(wide[b][0] - wide[a][0], wide[b][1] - wide[a][1]);
        let sides = [side(0, 1) + side(3, 2), side(0, 3) + side(1, 2)];
        let length = (0.5 * (sides[0].norm_squared() + sides[1].norm_squared())).sqrt();
        Some(Self { theta, sides: sides.map(|s| s / length.max(1e-9)), origin: origin.into() })
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
        let q = self.sides[0] * xi + self.sides[1] * eta;
        let far = q.norm_squared() - 2.0;
        let p = Vector2::new(u, v) + (Vector2::new(t[8], t[9]) + q * t[10]) * far;
        #[rustfmt::skip]
        let jacobian = SMatrix::<f64, 2, PARAMETERS>::from_row_slice(&[
            xi * w, eta * w, w, 0.0, 0.0, 0.0, -u * xi * w, -u * eta * w, far, 0.0, far * q.x,
            0.0, 0.0, 0.0, xi * w, eta * w, w, -v * xi * w, -v * eta * w, 0.0, far, far * q.y,
        ]);
        (p, jacobian)
    }

    fn narrow(&self) -> NarrowModel {
        NarrowModel {
            theta: std::array::from_fn(|i| self.theta[i] as f32),
            sides: self.sides.map(|a| [a.x as f32, a.y as f32]),
            origin: [self.origin.x as f32, self.origin.y as f32],
        }
    }

    /// Width of a cell across its edges, for edges crossed along ξ and along η, at the tag's middle, pixels.
    fn pitches(&self, width: usize) -> [f64; 2] {
        let t = &self.theta;
        let (d_xi, d_eta) = (
            Vector2::new(t[0] - t[2] * t[6], t[3] - t[5] * t[6]),
            Vector2::new(t[1] - t[2] * t[7], t[4] - t[5] * t[7]),
        );
        let area = (d_xi.x * d_eta.y - d_xi.y * d_eta.x).abs() * 2.0 / width as f64;
        [area / d_eta.norm().max(1e-9), area / d_xi.norm().max(1e-9)]
    }

    /// Corners and centre with their covariances; `neighbours` are errors common to all edges along ξ and η.
    fn result(&self, covariance: &Information, neighbours: [f64; 2]) -> Option<Refined> {
        let axes = self.sides.map(|s| s / s.norm().max(1e-9));
        let common = (0..2).map(|i| axes[i] * axes[i].transpose() * neighbours[i].powi(2));
        let floor = common.fold(Matrix2::identity() * FLOOR_PX.powi(2), |sum, c| sum + c);
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
