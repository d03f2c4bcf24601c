//! Corners of a small tag from all of its pixels. Where cells are a few pixels wide, blur lets every edge reach into the
//! next, and edges are placed too coarsely: the tag's bits are known, and so is what each pixel should show.
//!
//! Gauss–Newton on the model of `pixel_model.rs`, started at the edges' corners, with Cauchy's weights.

use nalgebra::{Cholesky, Const, Matrix3, SMatrix, SVector};

use super::edge_points::LANES;
use super::equations::Information;
use super::family::Family;
use super::pixel_model::{BLUR, DARK, GROUND, LENS, NarrowState, Pixels, RANGE, Shown, UNKNOWNS};
use super::pixel_patterns::Patterns;
use super::pixel_sums::{Accumulate, Pulls, Sums};
use super::simd::Simd;
use super::tag_model::Model;
use windhover_base::msg::ImageView;

type Row = SVector<f64, UNKNOWNS>;
type Matrix = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// Blur of a lens in focus, a sigma in pixels, and by how much it varies.
pub(super) const FOCUS: f64 = 0.75;
const FOCUS_SIGMA: f64 = 0.7;
const LEAST_BLUR: f64 = 0.35;

/// Widest blur that is fitted, in cells, and that under which three cells on a side are enough.
const WIDEST_BLUR: f64 = 0.85;
const NARROW_BLUR: f64 = 0.42;

/// How far pixels that are used are from cells of unknown colour, in sigmas: ground is not of one level.
const CLEAR: f64 = 1.5;

/// Priors, as shares of white over black: the ground's light, and how much light changes over half a tag.
const GROUND_LEVEL: f64 = 0.4;
const GROUND_SIGMA: f64 = 0.4;
const SLOPE_SIGMA: f64 = 0.3;

/// Largest covariance of the blur's two sigmas, of their product.
const MOST_ASLANT: f64 = 0.9;

/// Largest robust spread of the residuals that a fit leaves: over the noise, or of white over black.
const MOST_NOISE: f64 = 1.25;
const MOST_LEFT: f64 = 0.035;

/// Largest share of residuals beyond so many spreads: there light is not as the model has it.
const FAR_OFF: f64 = 5.0;
const MOST_FAR_OFF: f64 = 0.004;

/// A step that moves no corner farther is the last, pixels.
const SETTLED_PX: f64 = 0.03;
const MOST_STEPS: usize = 8;

/// How far a fit may go from its start, in cells.
const FARTHEST: f64 = 0.5;

/// Share of the errors, in blocks, that the fit absorbs for each parameter.
const TAKEN_UP: f64 = 0.45;

/// Fewest pixels.
const LEAST_PIXELS: usize = 5 * UNKNOWNS;

/// As light as a pixel can be: it may be lighter.
const SATURATED: u8 = 255;

/// Blocks of a tag and its ring on a side: pixels of one block have similar errors.
const BLOCKS: usize = 6;

/// Fits tags to their pixels; keeps its buffers.
#[derive(Clone, Debug)]
pub(super) struct PixelFit {
    simd: Simd,
    patterns: Patterns,
    pixels: Vec<Pixels>,
    count: usize,
    sums: Sums,
    pulls: Pulls,
    shown: Shown,
}

/// What is being fitted.
#[derive(Clone, Copy)]
struct State {
    model: Model,
    /// Blur, light.
    rest: [f64; UNKNOWNS - BLUR],
}

/// A step of the fit, and its normal equations.
struct Solved {
    step: Row,
    information: Cholesky<f64, Const<UNKNOWNS>>,
    holds: Row,
}

impl PixelFit {
    pub fn new(simd: Simd) -> Self {
        Self {
            simd,
            patterns: Patterns::default(),
            pixels: Vec::new(),
            count: 0,
            sums: Sums::default(),
            pulls: Pulls::default(),
            shown: Shown::default(),
        }
    }

    /// Moves a model to where the pixels show the tag; its parameters' covariance. `None` where the pixels are not those of
    /// the tag in one light. `blurs` are the sigmas from which the search begins, `held` those of the lens's parameters,
    /// `noise` that of a pixel, grey levels.
    pub fn fit(
        &mut self,
        image: ImageView<'_>,
        (start, blurs, held): (&Model, [f64; 2], &[f64]),
        (family, id): (&Family, u32),
        noise: f64,
    ) -> Option<(Model, Information)> {
        self.patterns.place(family, id);
        let cells = start.pitches(family.width);
        let mut state = State { model: start.without_shifts(), rest: [0.0; UNKNOWNS - BLUR] };
        for k in 0..2 {
            state.rest[k] = blurs[k].clamp(0.5, WIDEST_BLUR * cells[k]);
        }
        self.light(image, &mut state)?;
        self.gather(image, &state)?;
        let mut spread = 0.1 * state.range();
        for step in 0..MOST_STEPS {
            self.accumulate(&state, spread)?;
            let solved = self.solve(&state, held, spread)?;
            spread = self.sums.sizes.spread();
            let before = state.model;
            state.take(&solved.step);
            let pitches = state.model.pitches(family.width);
            let is_wide = (0..2).any(|k| state.rest[k] > WIDEST_BLUR * pitches[k]);
            if is_wide || !(state.model.moved(start) < FARTHEST * cells[0].min(cells[1])) {
                return None;
            }
            // The first step was made with a spread that was only assumed.
            if step > 0 && state.model.moved(&before) < SETTLED_PX {
                return self.covariance(&state, &solved, spread, noise).map(|c| (state.model, c));
            }
        }
        None
    }

    /// Starts the light at what the middles of cells show.
    fn light(&self, image: ImageView<'_>, state: &mut State) -> Option<()> {
        // Of dark and of light cells: sum, count.
        let mut sums = [(0.0, 0.0); 2];
        let w = self.patterns.width as i32;
        for (x, y) in (0..w).flat_map(|y| (0..w).map(move |x| (x, y))) {
            let Some(is_light) = self.patterns.is_light(x, y) else { continue };
            let q = [x, y].map(|c| (f64::from(c) + 0.5) * 2.0 / f64::from(w) - 1.0);
            let p = state.model.pixel(q[0], q[1]).add_scalar(0.5);
            if p.x >= 0.0 && p.y >= 0.0 && p.x < image.width as f64 && p.y < image.height as f64 {
                let sum = &mut sums[usize::from(is_light)];
                *sum = (sum.0 + f64::from(image.row(p.y as usize)[p.x as usize]), sum.1 + 1.0);
            }
        }
        let [dark, light] = sums.map(|(sum, count)| sum / count);
        state.rest[DARK - BLUR] = dark;
        state.rest[RANGE - BLUR] = light - dark;
        state.rest[GROUND - BLUR] = GROUND_LEVEL * (light - dark);
        (light > dark).then_some(())
    }

    /// Gathers the pixels in which nothing unknown shows.
    fn gather(&mut self, image: ImageView<'_>, state: &State) -> Option<()> {
        self.pixels.clear();
        self.count = 0;
        let narrow = state.narrow()?;
        let width = f64::from(self.patterns.width);
        let cells = state.model.pitches(width as usize);
        let widest = (0..2).map(|k| state.rest[k] / cells[k]).fold(0.0, f64::max);
        let clear = (CLEAR * widest).min(1.0) as f32;
        let most = 1.0 + 2.0 / width;
        let around = [(-most, -most), (most, -most), (most, most), (-most, most)];
        let around = around.map(|(x, y)| state.model.pixel(x, y));
        let span = |k: usize, sides: usize| {
            let (low, high) = around.iter().fold((f64::MAX, f64::MIN), |m, c| (m.0.min(c[k]), m.1.max(c[k])));
            let last = sides as f64 - 1.0;
            low.ceil().clamp(0.0, last) as usize..=high.floor().clamp(0.0, last) as usize
        };
        let origin = state.model.origin();
        let (columns, most) = (span(0, image.width), most as f32);
        let per_block = BLOCKS as f32 / (2.0 * most);
        for v in span(1, image.height) {
            let line = image.row(v);
            let y = (v as f64 - origin.y) as f32;
            for u in columns.clone() {
                let x = (u as f64 - origin.x) as f32;
                let q = narrow.tag_point(x, y);
                let is_inside = q.iter().all(|c| c.abs() < most);
                if !is_inside || line[u] == SATURATED || !self.patterns.is_known(q, clear) {
                    continue;
                }
                let [column, row] = q.map(|c| (((c + most) * per_block) as usize).min(BLOCKS - 1));
                self.push([x, y], f32::from(line[u]), (row * BLOCKS + column) as u8);
            }
        }
        (self.count >= LEAST_PIXELS).then_some(())
    }

    fn push(&mut self, at: [f32; 2], seen: f32, block: u8) {
        match self.pixels.last_mut().filter(|pixels| pixels.count < LANES) {
            Some(pixels) => pixels.push(at, seen, block),
            None => self.pixels.push(Pixels::first(at, seen, block)),
        }
        self.count += 1;
    }

    fn accumulate(&mut self, state: &State, spread: f64) -> Option<()> {
        let narrow = state.narrow()?;
        let Self { simd, patterns, pixels, sums, pulls, shown, .. } = self;
        let is_narrow = state.is_narrow(patterns.width as usize);
        let per_spread = 0.4 / spread as f32;
        let kernel = Accumulate { state: &narrow, patterns, pixels, shown, per_spread, sums, pulls };
        kernel.run_on(*simd, is_narrow, false);
        Some(())
    }

    fn solve(&self, state: &State, held: &[f64], spread: f64) -> Option<Solved> {
        let (mut information, mut right) = (self.sums.matrix(), self.sums.right());
        let range = state.range().abs().max(1.0);
        let mut holds = Row::zeros();
        let mut hold = |k: usize, from: f64, sigma: f64| {
            holds[k] = (spread / sigma).powi(2);
            information[(k, k)] += holds[k];
            right[k] -= holds[k] * from;
        };
        let rest = |k: usize| state.rest[k - BLUR];
        for (k, sigma) in (LENS..BLUR).zip(held) {
            hold(k, state.model.theta[k], *sigma);
        }
        for k in BLUR..BLUR + 2 {
            hold(k, rest(k) - FOCUS, FOCUS_SIGMA);
        }
        hold(BLUR + 2, rest(BLUR + 2), FOCUS_SIGMA);
        for k in [DARK + 1, DARK + 2, RANGE + 1, RANGE + 2] {
            hold(k, rest(k), SLOPE_SIGMA * range);
        }
        hold(GROUND, rest(GROUND) - GROUND_LEVEL * range, GROUND_SIGMA * range);
        let information = information.cholesky()?;
        let step = information.solve(&right);
        step.iter().all(|s| s.is_finite()).then_some(Solved { step, information, holds })
    }

    /// Covariance of what moves the tag's points, as `refine.rs` has it of all parameters; `None` where the residuals show that the
    /// pixels are not those of the tag.
    fn covariance(&mut self, state: &State, solved: &Solved, spread: f64, noise: f64) -> Option<Information> {
        let narrow = state.narrow()?;
        let Self { simd, patterns, pixels, sums, pulls, shown, .. } = self;
        let is_narrow = state.is_narrow(patterns.width as usize);
        let per_spread = 0.4 / spread as f32;
        let kernel = Accumulate { state: &narrow, patterns, pixels, shown, per_spread, sums, pulls };
        kernel.run_on(*simd, is_narrow, true);
        let left = self.sums.sizes.spread();
        let fits = left < (MOST_NOISE * noise + 0.4).max(MOST_LEFT * state.range())
            && self.sums.sizes.beyond(FAR_OFF * left) < MOST_FAR_OFF;
        let (mut sum, mut blocks) = (0.0, 0.0);
        for pull in self.pulls.blocks.iter().filter(|p| p.iter().any(|x| *x != 0.0)) {
            let mut pull = Row::from_fn(|k, _| f64::from(pull[k]));
            solved.information.l_dirty().solve_lower_triangular_mut(&mut pull);
            sum += pull.norm_squared();
            blocks += 1.0;
        }
        let inverse: Matrix = solved.information.inverse();
        let held: f64 = (0..UNKNOWNS).map(|k| solved.holds[k] * inverse[(k, k)]).sum();
        let determined = UNKNOWNS as f64 - held;
        let lambda = sum / determined / (1.0 - TAKEN_UP * determined / blocks).max(0.4);
        let scale = lambda / self.sums.flattening().powi(2);
        let mut covariance = Information::zeros();
        let part = inverse.fixed_view::<BLUR, BLUR>(0, 0) * scale;
        covariance.fixed_view_mut::<BLUR, BLUR>(0, 0).copy_from(&part);
        (fits && blocks > 4.0).then_some(covariance)
    }
}

impl State {
    fn take(&mut self, step: &Row) {
        (0..BLUR).for_each(|k| self.model.theta[k] += step[k]);
        (BLUR..UNKNOWNS).for_each(|k| self.rest[k - BLUR] += step[k]);
        (0..2).for_each(|k| self.rest[k] = self.rest[k].max(LEAST_BLUR));
        let most = MOST_ASLANT * self.rest[0] * self.rest[1];
        self.rest[2] = self.rest[2].clamp(-most, most);
    }

    /// White over black in the tag's middle, grey levels.
    fn range(&self) -> f64 {
        self.rest[RANGE - BLUR]
    }

    fn is_narrow(&self, width: usize) -> bool {
        let cells = self.model.pitches(width);
        (0..2).all(|k| self.rest[k] < NARROW_BLUR * cells[k])
    }

    fn narrow(&self) -> Option<NarrowState> {
        let t = &self.model.theta;
        let back = Matrix3::new(t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7], 1.0).try_inverse()?;
        let theta = |k: usize| if k < BLUR { t[k] } else { self.rest[k - BLUR] };
        Some(NarrowState {
            theta: std::array::from_fn(|k| theta(k) as f32),
            sides: self.model.sides().map(|a| [a.x as f32, a.y as f32]),
            back: std::array::from_fn(|k| back[(k / 3, k % 3)] as f32),
        })
    }
}
