//! Corners of a decoded tag to a few hundredths of a pixel, with their covariance: every edge between its
//! dark and light cells, not only the border, takes part in one fit.
//!
//! Model, with ξ, η ∈ [−1, 1] across the border square, q = ξ a + η b and d(q) = (d₁ e − d₂ o, −d₁ o − d₂ e),
//! e = q₁² − q₂², o = 2 q₁ q₂: `p = H(ξ, η) + (|q|² − 2) (c + k q) + d(q)`: a homography and what a lens with radial
//! distortion adds to it over a small part of the image. With a point's place P off the optical axis that is
//! `κ |P|² P`; to third order about a tag's middle what is no homography is `κ |q|² (P + q)`, and as lengths shrink
//! more along P than across, |q|² of the image has a part besides that of the tag: the twist d, which with H and c
//! makes up every quadratic. a and b are half the tag's sides in the image over their mean length, so that the bow c
//! and the barrel k change nothing at a square's corners; all are held near nought by what a wide lens does. Beside a
//! cell that is one wide, blur lets an edge appear nearer the other cell; by how much is one more unknown for edges
//! along ξ and one for those along η. Where white is over-exposed, light spreads from every light cell over its dark
//! neighbours: all edges are nearer the dark by the last unknown. Gauss–Newton on distances along edge normals, each weighed by how well its edge
//! is placed, Cauchy's weights on top.

use nalgebra::{Cholesky, Const, Vector2};

use super::edge_points::{Locate, Located, PARAMETERS};
use super::equations::{Accumulate, Advance, Equations, Information, Row, weigh};
use super::family::Family;
use super::pixel_fit::{FOCUS, PixelFit};
use super::quad::{Quad, distance};
use super::simd::Simd;
use super::tag_edges::{MOST_BLOCKS, TagEdges};
use super::tag_model::{FLOOR_PX, Model, PIXELS_FLOOR_PX, Refined};
use super::windows::{WIDEST_CELL, Windows};
use windhover_base::msg::ImageView;

/// Curvature that a wide lens gives a tag's middle lines, 1/px: 2·0.18 r over a focal length of 1000 px, where it
/// distorts by 0.18 r², is 10⁻⁴ to 2·10⁻⁴ on the way to the rim.
const LENS_CURVATURE: f64 = 1.5e-4;

/// How far a wide lens bends a tag's sides outwards, over the third power of half their length, 1/px²: 0.3 r² at a
/// focal length of 1000 px.
const LENS_BARREL: f64 = 3e-7;

/// What a wide lens twists a tag by, over the square of half its length, 1/px: of the bow, the difference between
/// what it shrinks lengths by along the radius and across, a third where it shrinks them by 5 and 15 %.
const LENS_TWIST: f64 = 2.5e-5;

/// Parameters after the homography's eight, which have a prior at zero with given sigmas.
const HELD: usize = PARAMETERS - 8;

/// Share of the errors, in blocks, that the fit absorbs for each parameter.
const TAKEN_UP: f64 = 0.375;

/// Most that a neighbouring cell's nearness shifts an edge, in cells: the sigma of its prior at zero.
const NARROW_SHIFT: f64 = 0.1;

/// How far light spreads over the edges of cells, in cells, where white is over-exposed or ink has run: the sigma of
/// its prior at zero.
const SPREAD: f64 = 0.1;

/// Error that neighbouring cells leave on all edges of one direction alike, their shift being fitted: pixels, at a
/// blur of one pixel and one pixel a cell (it grows with the square of the blur and falls with the cube of the cell),
/// and a share of the shift. From generated tags: `proof_of_what_neighbouring_cells_leave`.
const NEIGHBOURS: f64 = 1.2;
const SHIFT_ERROR: f64 = 0.3;

/// The round that moves no corner farther than this is the last, pixels: another would move them by a twentieth of it.
const SETTLED_PX: f64 = 0.08;
const MOST_ROUNDS: usize = 10;

/// Steps of the fit between looking for edges and looking again: at most so many, or one no corner is moved further
/// by, pixels.
const MOST_STEPS: usize = 4;
const LEAST_STEP_PX: f64 = 0.005;

/// Share of the edges between a tag's cells that are seen where the fit is right. Where fewer are seen and windows
/// reach from cell to cell, edges were confused with neighbouring ones: blur is then wider than a cell, and corners are
/// wrong by this part of a cell (the same proof).
const ENOUGH_SEEN: f64 = 0.93;
const MISTAKEN: f64 = 0.25;

/// Widest cells of tags whose corners are those of the pixels, pixels: of wider ones edges are as good, and quicker.
const WIDEST_OF_PIXELS: f64 = 4.0;

/// Most rounds that lead up to the fit to pixels.
const MOST_APPROACHES: usize = 3;

/// Fewest edge points.
const LEAST_EDGES: usize = 24;

/// Finds edges and fits them; keeps its buffers.
#[derive(Clone, Debug)]
pub(super) struct Refiner {
    simd: Simd,
    edges: TagEdges,
    located: Vec<Located>,
    equations: Equations,
    pixels: PixelFit,
}

impl Refiner {
    pub fn new(simd: Simd) -> Self {
        let (edges, equations) = (TagEdges::default(), Equations::default());
        Self { simd, edges, located: Vec::new(), equations, pixels: PixelFit::new(simd) }
    }

    /// Refines corners given in the tag's own order: those of small tags by their pixels, if these are those of the tag in
    /// one light, others by their edges. `None` where too few edges are seen or the fit moves away from the given corners.
    /// Where white `spreads`, the distance is fitted too. `noise` is that of a pixel, grey levels.
    pub fn refine(
        &mut self,
        image: ImageView<'_>,
        corners: &Quad,
        (family, id): (&Family, u32),
        spreads: bool,
        noise: f64,
    ) -> Option<Refined> {
        let is_small = f64::from(edge_of(corners)) < WIDEST_OF_PIXELS * family.width as f64;
        let of_pixels =
            if is_small && !spreads { self.of_pixels(image, corners, (family, id), noise) } else { None };
        of_pixels.or_else(|| self.of_edges(image, corners, (family, id), spreads))
    }

    /// Refines corners by the pixels, started where a half of the edges are.
    fn of_pixels(
        &mut self,
        image: ImageView<'_>,
        corners: &Quad,
        (family, id): (&Family, u32),
        noise: f64,
    ) -> Option<Refined> {
        let edge = f64::from(edge_of(corners));
        let cell = edge / family.width as f64;
        let start = Model::of_corners(corners, false)?;
        self.edges.place(family, id, cell);
        let held = held(0.5 * edge, cell);
        let mut model = start;
        let blurs = match self.approach(image, &mut model, family.width, held) {
            Some(windows) => windows.blurs_squared().map(f64::sqrt),
            None => {
                model = start;
                [FOCUS; 2]
            }
        };
        let (model, covariance) = self.pixels.fit(image, (&model, blurs, &held), (family, id), noise)?;
        // How far the corners have moved does not matter: what the pixels show is the tag.
        model.result(&covariance, [0.0; 2], PIXELS_FLOOR_PX)
    }

    /// Refines corners by the edges.
    fn of_edges(
        &mut self,
        image: ImageView<'_>,
        corners: &Quad,
        (family, id): (&Family, u32),
        spreads: bool,
    ) -> Option<Refined> {
        let edge = edge_of(corners);
        let cell = f64::from(edge) / family.width as f64;
        let mut model = Model::of_corners(corners, spreads)?;
        self.edges.place(family, id, cell);
        let held = held(0.5 * f64::from(edge), cell);
        let (covariance, windows) = self.fit(image, &mut model, family.width, held)?;
        let (pitches, blurs) = (model.pitches(family.width), windows.blurs_squared());
        let seen = self.count() as f64 / self.edges.count() as f64;
        let mistaken = if seen < ENOUGH_SEEN && cell < WIDEST_CELL { MISTAKEN } else { 0.0 };
        let common = [0, 1].map(|k| {
            let pitch = pitches[k];
            let left =
                (NEIGHBOURS * blurs[k] / pitch.powi(3)).powi(2) + (SHIFT_ERROR * model.shift(k)).powi(2);
            left.min((0.2 * pitch).powi(2)) + (mistaken * pitch).powi(2)
        });
        let refined = model.result(&covariance, common, FLOOR_PX)?;
        is_near(&refined, corners, cell).then_some(refined)
    }

    /// Moves a model near the edges, with a half of them in wide windows.
    fn approach(
        &mut self,
        image: ImageView<'_>,
        model: &mut Model,
        cells: usize,
        held: [f64; HELD],
    ) -> Option<Windows> {
        let mut windows = Windows::default();
        for _ in 0..MOST_APPROACHES {
            let pitches = model.pitches(cells);
            windows.half = windows.halves(pitches, true);
            self.locate(image, model, windows.half, 2);
            if self.count() < LEAST_EDGES {
                return None;
            }
            self.normalise();
            let (before, spread) = (*model, self.spread());
            self.settle(model, held, spread)?;
            windows.sharpness = self.sharpness();
            if !windows.widen() && model.moved(&before) < 0.1 * pitches[0].min(pitches[1]) {
                break;
            }
        }
        Some(windows)
    }

    /// Moves a model to where the edges are; the covariance of its parameters.
    ///
    /// First with few points and wide windows, until the corners are nearly right; then with all, in windows as narrow
    /// as the blur allows: in a window narrower than a smear, edges stay where the search begins.
    fn fit(
        &mut self,
        image: ImageView<'_>,
        model: &mut Model,
        cells: usize,
        held: [f64; HELD],
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
            last = Some(self.settle(model, held, spread)?);
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

    /// Moves a model to fit the located edges, whose places are not searched again.
    fn settle(&mut self, model: &mut Model, held: [f64; HELD], spread: f64) -> Option<Solved> {
        let mut last = None;
        for _ in 0..MOST_STEPS {
            let solved = self.solve(model, held, spread)?;
            let before = *model;
            model.theta += solved.step;
            let step = std::array::from_fn(|k| solved.step[k] as f32);
            self.simd.run(Advance { located: &mut self.located, step });
            last = Some(solved);
            if model.moved(&before) < LEAST_STEP_PX {
                break;
            }
        }
        last
    }

    fn locate(&mut self, image: ImageView<'_>, model: &Model, half: [f32; 2], every: usize) {
        let Self { edges, located, .. } = self;
        self.simd.run(Locate { points: &edges.points, located, image, model: model.narrow(), half, every });
    }

    /// Number of located edges.
    fn count(&self) -> usize {
        self.located.iter().map(|l| l.count).sum()
    }

    /// Makes strengths relative to their mean. Strong edges are located better, up to the point where noise no longer
    /// matters.
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

    fn solve(&mut self, model: &Model, held: [f64; HELD], spread: f64) -> Option<Solved> {
        let count = self.count() as f64;
        let sums = &mut self.equations;
        self.simd.run(Accumulate { located: &self.located, spread: spread as f32, to: sums });
        let variance = sums.squares() / (count - 8.0);
        let mut information = sums.matrix();
        let mut right = sums.right();
        let holds = held.map(|sigma| variance.max(1e-4) / (sigma * sigma));
        for (k, hold) in (PARAMETERS - HELD..PARAMETERS).zip(holds) {
            information[(k, k)] += hold;
            right[k] -= hold * model.theta[k];
        }
        let information = information.cholesky()?;
        let step = information.solve(&right);
        let flattening = sums.flattening();
        step.iter().all(|s| s.is_finite()).then_some(Solved { step, information, holds, flattening })
    }

    /// Covariance of the parameters: of M-estimates, with errors that are alike within a block. How much more
    /// they err together than each by itself is one number, from the blocks' pulls `g` on the parameters:
    /// `λ = Σ gᵀ A⁻¹ g / p`, p being how many parameters the image tells, which counts noise and whatever else the
    /// model leaves over; the covariance is `λ A⁻¹ / ρ²`, ρ being how much Cauchy's weights flatten the residuals.
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
        let inverse = solved.information.inverse();
        // The number of parameters that the image determines: of those with a prior, the share that does not come from
        // the prior.
        let held =
            solved.holds.iter().zip(PARAMETERS - HELD..).map(|(hold, k)| hold * inverse[(k, k)]).sum::<f64>();
        let determined = PARAMETERS as f64 - held;
        // The fit absorbs some of it, most in the corners.
        let lambda = sum / determined / (1.0 - TAKEN_UP * determined / blocks).max(0.5);
        let flattening = solved.flattening.clamp(0.4, 1.0);
        (blocks > 4.0).then(|| inverse * (lambda / (flattening * flattening)))
    }
}

/// Mean length of the sides, pixels.
fn edge_of(corners: &Quad) -> f32 {
    (0..4).map(|i| distance(corners[i], corners[(i + 1) % 4])).sum::<f32>() / 4.0
}

/// Whether refined corners are those that were given, but for an error in placing them.
fn is_near(refined: &Refined, corners: &Quad, cell: f64) -> bool {
    let moved = (0..4).map(|i| {
        (refined.corners[i] - Vector2::new(f64::from(corners[i][0]), f64::from(corners[i][1]))).norm()
    });
    moved.fold(0.0, f64::max) < (1.5 * cell).max(2.0)
}

/// Sigmas of the priors at zero of the parameters after the homography's, for a tag with this half side and these
/// cells, pixels.
fn held(half: f64, cell: f64) -> [f64; HELD] {
    let (bow, barrel) = (LENS_CURVATURE * half.powi(2) / 2.0, LENS_BARREL * half.powi(3));
    let (twist, shift) = (LENS_TWIST * half.powi(2), NARROW_SHIFT * cell);
    [bow, bow, barrel, twist, twist, shift, shift, SPREAD * cell]
}

/// One step of the fit.
struct Solved {
    step: Row,
    information: Cholesky<f64, Const<PARAMETERS>>,
    /// The part of the information that comes from the priors.
    holds: [f64; HELD],
    flattening: f64,
}

#[cfg(test)]
mod tests;
