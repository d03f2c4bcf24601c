//! Normal equations of located edges, each weighed by how well it is placed, Cauchy's weights on top.

use nalgebra::{SMatrix, SVector};

use super::edge_points::{LANES, Lanes, Located, PARAMETERS};
use super::simd::Kernel;

pub(super) type Information = SMatrix<f64, PARAMETERS, PARAMETERS>;
pub(super) type Row = SVector<f64, PARAMETERS>;

/// Entries of a symmetric matrix of the parameters' size, row by row from the diagonal on.
const ENTRIES: usize = PARAMETERS * (PARAMETERS + 1) / 2;

/// Sums over edges, in vector registers' width.
#[derive(Clone, Debug)]
pub(super) struct Equations {
    matrix: [Lanes; ENTRIES],
    right: [Lanes; PARAMETERS],
    squares: Lanes,
    weights: Lanes,
    slopes: Lanes,
}

impl Default for Equations {
    fn default() -> Self {
        let none = [0.0; LANES];
        Self {
            matrix: [none; ENTRIES],
            right: [none; PARAMETERS],
            squares: none,
            weights: none,
            slopes: none,
        }
    }
}

impl Equations {
    /// `Σ w r rᵀ` of the edges' rows r.
    pub fn matrix(&self) -> Information {
        let mut matrix = Information::zeros();
        let mut sums = self.matrix.iter();
        for (i, j) in (0..PARAMETERS).flat_map(|i| (i..PARAMETERS).map(move |j| (i, j))) {
            matrix[(i, j)] = sums.next().map_or(0.0, total);
            matrix[(j, i)] = matrix[(i, j)];
        }
        matrix
    }

    /// `Σ w r e` of the edges' rows r and residuals e.
    pub fn right(&self) -> Row {
        Row::from_fn(|i, _| total(&self.right[i]))
    }

    /// Weighted sum of the squared residuals.
    pub fn squares(&self) -> f64 {
        total(&self.squares)
    }

    /// Mean slope of the weighted residuals over the mean weight: the factor by which Cauchy's weights reduce them.
    pub fn flattening(&self) -> f64 {
        total(&self.slopes) / total(&self.weights)
    }
}

/// The sum of all lanes, halves added to halves.
#[inline(always)]
pub(super) fn total(x: &Lanes) -> f64 {
    let mut sums = *x;
    let mut half = LANES / 2;
    while half > 0 {
        for i in 0..half {
            sums[i] += sums[i + half];
        }
        half /= 2;
    }
    f64::from(sums[0])
}

/// Weights of edges, inverse to their variance and Cauchy's in units of `spread`, and the slopes of weight times
/// residual.
#[inline(always)]
pub(super) fn weigh(edges: &Located, spread: f32) -> (Lanes, Lanes) {
    let (mut weights, mut slopes) = ([0.0; LANES], [0.0; LANES]);
    let per_spread = 0.5 / spread;
    for lane in 0..LANES {
        let normalised = edges.residual[lane] * edges.strength[lane] * per_spread;
        let square = normalised * normalised;
        let weight = edges.strength[lane] * edges.strength[lane];
        let flat = 1.0 / (1.0 + square);
        weights[lane] = weight * flat;
        slopes[lane] = weight * (1.0 - square) * flat * flat;
    }
    (weights, slopes)
}

/// Sums the equations of edges.
pub(super) struct Accumulate<'a> {
    pub located: &'a [Located],
    pub spread: f32,
    pub to: &'a mut Equations,
}

impl Kernel for Accumulate<'_> {
    #[inline(always)]
    fn run(self) {
        *self.to = Equations::default();
        for edges in self.located {
            let (weights, slopes) = weigh(edges, self.spread);
            let mut at = 0;
            for i in 0..PARAMETERS {
                let weighed: Lanes = std::array::from_fn(|lane| weights[lane] * edges.rows[i][lane]);
                add_product(&mut self.to.right[i], &weighed, &edges.residual);
                for row in &edges.rows[i..] {
                    add_product(&mut self.to.matrix[at], &weighed, row);
                    at += 1;
                }
            }
            let square: Lanes = std::array::from_fn(|lane| edges.residual[lane] * edges.residual[lane]);
            add_product(&mut self.to.squares, &weights, &square);
            add_product(&mut self.to.weights, &weights, &[1.0; LANES]);
            add_product(&mut self.to.slopes, &slopes, &[1.0; LANES]);
        }
    }
}

/// Adds a product, lane by lane.
#[inline(always)]
pub(super) fn add_product(to: &mut Lanes, a: &Lanes, b: &Lanes) {
    *to = std::array::from_fn(|lane| to[lane] + a[lane] * b[lane]);
}

/// Changes the residuals by the effect of a step of the parameters.
pub(super) struct Advance<'a> {
    pub located: &'a mut [Located],
    pub step: [f32; PARAMETERS],
}

impl Kernel for Advance<'_> {
    #[inline(always)]
    fn run(self) {
        for edges in self.located {
            for (row, step) in edges.rows.iter().zip(self.step) {
                add_product(&mut edges.residual, row, &[-step; LANES]);
            }
        }
    }
}
