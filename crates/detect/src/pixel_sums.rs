//! Normal equations of a tag's pixels with Cauchy's weights, and how blocks of pixels pull at the parameters.

use nalgebra::{SMatrix, SVector};

use super::edge_points::{LANES, Lanes};
use super::equations::{add_product, total};
use super::pixel_model::{NarrowState, Pixels, Shown, UNKNOWNS};
use super::pixel_patterns::Patterns;
use super::simd::{Kernel, Simd};

/// Entries of the symmetric matrix, row by row from the diagonal on.
const ENTRIES: usize = UNKNOWNS * (UNKNOWNS + 1) / 2;

/// Width of the bins of residuals, grey levels, and their number.
const BIN: f32 = 0.25;
const BINS: usize = 160;

/// Blocks of a tag.
const MOST_BLOCKS: usize = 36;

/// Sums over pixels, in vector registers' width.
#[derive(Clone, Debug)]
pub(super) struct Sums {
    matrix: [Lanes; ENTRIES],
    right: [Lanes; UNKNOWNS],
    weights: Lanes,
    slopes: Lanes,
    pub sizes: Sizes,
}

impl Default for Sums {
    fn default() -> Self {
        let none = [0.0; LANES];
        let (matrix, right) = ([none; ENTRIES], [none; UNKNOWNS]);
        Self { matrix, right, weights: none, slopes: none, sizes: Sizes([0; BINS]) }
    }
}

impl Sums {
    /// `Σ w r rᵀ` of the pixels' rows r.
    pub fn matrix(&self) -> SMatrix<f64, UNKNOWNS, UNKNOWNS> {
        let mut matrix = SMatrix::zeros();
        let mut sums = self.matrix.iter();
        for (i, j) in (0..UNKNOWNS).flat_map(|i| (i..UNKNOWNS).map(move |j| (i, j))) {
            matrix[(i, j)] = sums.next().map_or(0.0, total);
            matrix[(j, i)] = matrix[(i, j)];
        }
        matrix
    }

    /// `Σ w r e` of the pixels' rows r and residuals e.
    pub fn right(&self) -> SVector<f64, UNKNOWNS> {
        SVector::from_fn(|i, _| total(&self.right[i]))
    }

    /// How much Cauchy's weights flatten the residuals.
    pub fn flattening(&self) -> f64 {
        f64::clamp(total(&self.slopes) / total(&self.weights), 0.4, 1.0)
    }

    #[inline(always)]
    fn add(&mut self, rows: &[Lanes; UNKNOWNS], residual: &Lanes, weights: &Lanes) {
        let mut at = 0;
        for i in 0..UNKNOWNS {
            let weighed: Lanes = std::array::from_fn(|lane| weights[lane] * rows[i][lane]);
            add_product(&mut self.right[i], &weighed, residual);
            for row in &rows[i..] {
                add_product(&mut self.matrix[at], &weighed, row);
                at += 1;
            }
        }
    }
}

/// How many residuals are of each size.
#[derive(Clone, Debug)]
pub(super) struct Sizes([u32; BINS]);

impl Sizes {
    #[inline(always)]
    fn add(&mut self, residual: &Lanes, count: usize) {
        let mut bins = [0u32; LANES];
        for lane in 0..LANES {
            let bin = residual[lane].abs() * (1.0 / BIN);
            bins[lane] = (if bin < BINS as f32 - 1.0 { bin } else { BINS as f32 - 1.0 }) as u32;
        }
        bins[..count].iter().for_each(|&bin| self.0[bin as usize] += 1);
    }

    /// Share of the residuals that are larger, grey levels.
    pub fn beyond(&self, size: f64) -> f64 {
        let from = ((size / f64::from(BIN)) as usize).min(BINS - 1);
        let all = self.0.iter().sum::<u32>().max(1);
        f64::from(self.0[from..].iter().sum::<u32>()) / f64::from(all)
    }

    /// Robust spread of the residuals, grey levels.
    pub fn spread(&self) -> f64 {
        let half = self.0.iter().sum::<u32>() / 2;
        let mut below = 0;
        let bin = self.0.iter().position(|n| {
            below += n;
            below > half
        });
        let median = f64::from(BIN) * (bin.unwrap_or(BINS) as f64 + 0.5);
        (1.4826 * median).max(0.5)
    }
}

/// `Σ w r e` of each block of pixels.
#[derive(Clone, Debug)]
pub(super) struct Pulls {
    pub blocks: [[f32; UNKNOWNS]; MOST_BLOCKS],
}

impl Default for Pulls {
    fn default() -> Self {
        Self { blocks: [[0.0; UNKNOWNS]; MOST_BLOCKS] }
    }
}

/// Sums the equations of pixels, or the pulls of their blocks.
pub(super) struct Accumulate<'a> {
    pub state: &'a NarrowState,
    pub patterns: &'a Patterns,
    pub pixels: &'a [Pixels],
    pub shown: &'a mut Shown,
    /// 1 over the residual at which a weight is a half.
    pub per_spread: f32,
    pub sums: &'a mut Sums,
    pub pulls: &'a mut Pulls,
}

impl Accumulate<'_> {
    /// With three cells a side under a pixel's blur where it is narrow, else with five.
    pub fn run_on(self, simd: Simd, is_narrow: bool, is_last: bool) {
        match (is_narrow, is_last) {
            (true, false) => simd.run(Pass::<3, false>(self)),
            (true, true) => simd.run(Pass::<3, true>(self)),
            (false, false) => simd.run(Pass::<5, false>(self)),
            (false, true) => simd.run(Pass::<5, true>(self)),
        }
    }
}

/// With `N` cells a side; the last one sums pulls.
struct Pass<'a, const N: usize, const LAST: bool>(Accumulate<'a>);

impl<const N: usize, const LAST: bool> Kernel for Pass<'_, N, LAST> {
    #[inline(always)]
    fn run(self) {
        let Accumulate { state, patterns, pixels, shown, per_spread, sums, pulls } = self.0;
        if LAST {
            *pulls = Pulls::default();
            (sums.weights, sums.slopes, sums.sizes) = ([0.0; LANES], [0.0; LANES], Sizes([0; BINS]));
        } else {
            *sums = Sums::default();
        }
        for some in pixels {
            shown.show::<N>(state, patterns, some);
            let mut weights = [0.0; LANES];
            for lane in 0..LANES {
                let r = shown.residual[lane] * per_spread;
                weights[lane] = some.used[lane] / (1.0 + r * r);
                sums.weights[lane] += weights[lane];
                sums.slopes[lane] += weights[lane] * (2.0 * weights[lane] - 1.0);
            }
            sums.sizes.add(&shown.residual, some.count);
            if !LAST {
                sums.add(&shown.rows, &shown.residual, &weights);
                continue;
            }
            for lane in 0..some.count {
                let pull = weights[lane] * shown.residual[lane];
                let to = &mut pulls.blocks[usize::from(some.block[lane])];
                to.iter_mut().zip(&shown.rows).for_each(|(to, row)| *to += pull * row[lane]);
            }
        }
    }
}
