//! A linearised measurement: innovation, the blocks of its Jacobian, noise.

use nalgebra::SMatrix;

use super::blocks::Block;
use super::matrix::{MAX_MEASURED, Small};

/// Most state columns one measurement touches.
pub(crate) const MAX_COLUMNS: usize = 44;

/// `r = H δx + noise` of `m` components that touches few columns.
#[derive(Clone, Debug)]
pub(crate) struct Measurement {
    /// Number of components.
    pub(crate) m: usize,
    columns: usize,
    column: [usize; MAX_COLUMNS],
    h: [[f64; MAX_COLUMNS]; MAX_MEASURED],
    /// Innovation.
    pub(crate) residual: [f64; MAX_MEASURED],
    /// Noise covariance.
    pub(crate) noise: Small,
    /// Whether what the linear model leaves out makes too much of the noise to fit the noise from it.
    pub(crate) unsettled: bool,
}

/// `N` columns that a measurement touches: where a block of the error state stands in its Jacobian.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Columns<const N: usize>(usize);

impl<const N: usize> Columns<N> {
    /// Where component `i` stands.
    pub(crate) const fn place(self, i: usize) -> usize {
        debug_assert!(i < N);
        self.0 + i
    }
}

impl Default for Measurement {
    fn default() -> Self {
        Self {
            m: 0,
            columns: 0,
            column: [0; MAX_COLUMNS],
            h: [[0.0; MAX_COLUMNS]; MAX_MEASURED],
            residual: [0.0; MAX_MEASURED],
            noise: [[0.0; MAX_MEASURED]; MAX_MEASURED],
            unsettled: false,
        }
    }
}

impl Measurement {
    /// Empties it for `m` components.
    pub(crate) fn begin(&mut self, m: usize) {
        *self = Self { m, ..Self::default() };
    }

    /// Adds the columns of a block. A block is added once.
    pub(crate) fn touch<const N: usize>(&mut self, block: Block<N>) -> Columns<N> {
        let first = self.columns;
        for i in 0..N {
            self.column[first + i] = block.column(i);
        }
        self.columns += N;
        Columns(first)
    }

    /// Writes ∂(components from `row` on)/∂block; rows beyond the last component are left out.
    pub(crate) fn set<const M: usize, const N: usize>(
        &mut self,
        row: usize,
        columns: Columns<N>,
        d: &SMatrix<f64, M, N>,
    ) {
        for i in 0..M.min(self.m - row) {
            for k in 0..N {
                self.h[row + i][columns.place(k)] = d[(i, k)];
            }
        }
    }

    /// Adds a block with its derivative of all components.
    pub(crate) fn block<const M: usize, const N: usize>(&mut self, block: Block<N>, d: &SMatrix<f64, M, N>) {
        let columns = self.touch(block);
        self.set(0, columns, d);
    }

    /// ∂component/∂(column of the error state): zero of a column that is not touched.
    pub(crate) fn derivative(&self, component: usize, column: usize) -> f64 {
        let place = self.columns().iter().position(|c| *c == column);
        place.map_or(0.0, |place| self.h[component][place])
    }

    /// Raises the noise by a factor on its variance.
    pub(crate) fn scale_noise(&mut self, factor: f64) {
        self.noise.iter_mut().flatten().for_each(|x| *x *= factor);
    }

    /// A component's derivatives, by [`Self::columns`].
    pub(crate) fn row(&self, component: usize) -> &[f64] {
        &self.h[component][..self.columns]
    }

    /// The columns of the error state that it touches.
    pub(crate) fn columns(&self) -> &[usize] {
        &self.column[..self.columns]
    }

    /// Whether innovation and derivatives are numbers.
    pub(crate) fn is_finite(&self) -> bool {
        (0..self.m).all(|i| self.residual[i].is_finite() && self.row(i).iter().all(|x| x.is_finite()))
    }
}
