//! Dense row-major storage with the few operations the filter needs; nothing here allocates once made.

#![expect(clippy::needless_range_loop, reason = "matrix arithmetic reads by its indices")]

use nalgebra::SMatrix;

use super::blocks::Block;

/// Rows of equal length in one block.
#[derive(Clone, PartialEq, Debug, Default)]
pub(crate) struct Grid {
    cols: usize,
    data: Vec<f64>,
}

impl Grid {
    pub(crate) fn zeros(rows: usize, cols: usize) -> Self {
        Self { cols, data: vec![0.0; rows * cols] }
    }

    pub(crate) fn rows(&self) -> usize {
        self.data.len().checked_div(self.cols).unwrap_or(0)
    }

    pub(crate) fn row(&self, i: usize) -> &[f64] {
        &self.data[i * self.cols..(i + 1) * self.cols]
    }

    pub(crate) fn row_mut(&mut self, i: usize) -> &mut [f64] {
        &mut self.data[i * self.cols..(i + 1) * self.cols]
    }

    pub(crate) fn at(&self, i: usize, j: usize) -> f64 {
        self.data[i * self.cols + j]
    }

    pub(crate) fn add(&mut self, i: usize, j: usize, value: f64) {
        self.data[i * self.cols + j] += value;
    }

    pub(crate) fn set(&mut self, i: usize, j: usize, value: f64) {
        self.data[i * self.cols + j] = value;
    }

    /// Variance of one state.
    pub(crate) fn var(&self, state: Block<1>) -> f64 {
        self.at(state.column(0), state.column(0))
    }

    /// Standard deviation of component `i` of a block.
    pub(crate) fn sigma<const N: usize>(&self, block: Block<N>, i: usize) -> f64 {
        self.at(block.column(i), block.column(i)).max(0.0).sqrt()
    }

    /// The entries in the rows of one block and the columns of another.
    pub(crate) fn block<const N: usize, const M: usize>(
        &self,
        rows: Block<N>,
        columns: Block<M>,
    ) -> SMatrix<f64, N, M> {
        SMatrix::from_fn(|i, j| self.at(rows.column(i), columns.column(j)))
    }

    /// Adds to a block's own part.
    pub(crate) fn add_square<const N: usize>(&mut self, block: Block<N>, value: &SMatrix<f64, N, N>) {
        for i in 0..N {
            for j in 0..N {
                self.add(block.column(i), block.column(j), value[(i, j)]);
            }
        }
    }

    /// Adds to the diagonal of some columns, as far as they go.
    pub(crate) fn add_to_diagonal(&mut self, columns: std::ops::Range<usize>, values: &[f64]) {
        for (i, value) in columns.zip(values) {
            self.add(i, i, *value);
        }
    }

    /// Adds to a block's diagonal.
    pub(crate) fn add_diagonal<const N: usize>(&mut self, block: Block<N>, value: &[f64; N]) {
        for (i, value) in value.iter().enumerate() {
            self.add(block.column(i), block.column(i), *value);
        }
    }

    /// Adds to the part that two blocks have in common, on both sides of the diagonal.
    pub(crate) fn add_mixed<const N: usize, const M: usize>(
        &mut self,
        rows: Block<N>,
        columns: Block<M>,
        value: &SMatrix<f64, N, M>,
    ) {
        for i in 0..N {
            for j in 0..M {
                self.add(rows.column(i), columns.column(j), value[(i, j)]);
                self.add(columns.column(j), rows.column(i), value[(i, j)]);
            }
        }
    }

    /// Sets a block's diagonal.
    pub(crate) fn set_diagonal<const N: usize>(&mut self, block: Block<N>, value: &[f64; N]) {
        for (i, value) in value.iter().enumerate() {
            self.set(block.column(i), block.column(i), *value);
        }
    }

    pub(crate) fn fill(&mut self, value: f64) {
        self.data.fill(value);
    }

    /// `row[to] += a row[from]`, `from` before `to`.
    #[inline(always)]
    pub(crate) fn add_row(&mut self, to: usize, a: f64, from: usize) {
        let (head, tail) = self.data.split_at_mut(to * self.cols);
        axpy(&mut tail[..self.cols], a, &head[from * self.cols..(from + 1) * self.cols]);
    }

    /// `row[to] += a row[from]`, whichever comes first.
    #[inline(always)]
    pub(crate) fn add_row_from(&mut self, to: usize, a: f64, from: usize) {
        let (low, high) = (to.min(from), to.max(from));
        let (head, tail) = self.data.split_at_mut(high * self.cols);
        let (low, high) = (&mut head[low * self.cols..][..self.cols], &mut tail[..self.cols]);
        if to < from { axpy(low, a, high) } else { axpy(high, a, low) }
    }

    /// Carries a covariance over to errors that are sheared.
    #[inline(always)]
    pub(crate) fn shear(&mut self, shear: &Shear) {
        if !shear.some {
            return;
        }
        for (to, factor) in shear.by.iter().enumerate().filter(|(_, factor)| **factor != 0.0) {
            self.add_row_from(to, *factor, shear.from);
        }
        self.shear_columns(shear);
    }

    /// Carries rows over to errors that are sheared.
    #[inline(always)]
    pub(crate) fn shear_columns(&mut self, shear: &Shear) {
        self.data.chunks_exact_mut(self.cols).for_each(|row| shear.carry(row));
    }

    /// Copies without allocating where the sizes match.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.cols = other.cols;
        self.data.clone_from(&other.data);
    }

    /// Transposes a square grid in place.
    pub(crate) fn transpose(&mut self) {
        for i in 0..self.cols {
            for j in 0..i {
                self.data.swap(i * self.cols + j, j * self.cols + i);
            }
        }
    }

    /// Forgets everything about some states: their rows and columns of a square grid.
    pub(crate) fn forget<const N: usize>(&mut self, block: Block<N>) {
        for i in block.range() {
            self.row_mut(i).fill(0.0);
        }
        self.forget_columns(block);
    }

    /// Sets columns to zero.
    pub(crate) fn forget_columns<const N: usize>(&mut self, block: Block<N>) {
        for i in 0..self.rows() {
            self.row_mut(i)[block.range()].fill(0.0);
        }
    }
}

/// `y += a x`
#[inline(always)]
pub(crate) fn axpy(y: &mut [f64], a: f64, x: &[f64]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y += a * x;
    }
}

/// Multiples of one state's error that are added to those of others.
#[derive(Clone, Debug)]
pub(crate) struct Shear {
    /// The state whose error is added.
    from: usize,
    /// How much of it each state gets; the state itself none.
    by: Vec<f64>,
    /// Whether any state gets some.
    some: bool,
}

impl Shear {
    /// Of `n` states none gets any.
    pub(crate) fn none(n: usize) -> Self {
        Self { from: 0, by: vec![0.0; n], some: false }
    }

    /// Begins anew with another state whose error is added.
    pub(crate) fn begin(&mut self, from: usize) {
        self.from = from;
        self.by.fill(0.0);
        self.some = false;
    }

    /// Gives a state some of it.
    pub(crate) fn give(&mut self, to: usize, factor: f64) {
        debug_assert!(to != self.from);
        self.by[to] = factor;
        self.some |= factor != 0.0;
    }

    /// Carries a row over, as far as it goes.
    #[inline(always)]
    pub(crate) fn carry(&self, row: &mut [f64]) {
        let error = row[self.from];
        if self.some && error != 0.0 {
            axpy(row, error, &self.by);
        }
    }
}

/// `row −= Σ yᵢ wᵢ`
#[inline(always)]
pub(crate) fn subtract_rows<const M: usize>(row: &mut [f64], y: &[f64; M], w: &[&[f64]; M]) {
    let w = w.map(|w| &w[..row.len()]);
    for (j, x) in row.iter_mut().enumerate() {
        for i in 0..M {
            *x -= y[i] * w[i][j];
        }
    }
}

/// Most components of one measurement.
pub(crate) const MAX_MEASURED: usize = 8;

/// A small square matrix.
pub(crate) type Small = [[f64; MAX_MEASURED]; MAX_MEASURED];

/// Lower Cholesky factor in place of the leading `m` rows; `false` where not positive definite.
pub(crate) fn cholesky(s: &mut Small, m: usize) -> bool {
    for i in 0..m {
        for j in 0..=i {
            let mut sum = s[i][j];
            for k in 0..j {
                sum -= s[i][k] * s[j][k];
            }
            if i == j {
                if !(sum > 0.0 && sum.is_finite()) {
                    return false;
                }
                s[i][i] = sum.sqrt();
            } else {
                s[i][j] = sum / s[j][j];
            }
        }
    }
    true
}

/// Solves `L y = b` in place.
#[inline(always)]
pub(crate) fn forward(l: &Small, b: &mut [f64]) {
    for i in 0..b.len() {
        for k in 0..i {
            b[i] -= l[i][k] * b[k];
        }
        b[i] /= l[i][i];
    }
}

/// The value that a chi-square variable of `m` degrees stays below with probability `p`, by the
/// Wilson–Hilferty approximation (good to 1 % here).
pub(crate) fn chi_square_quantile(p: f64, m: usize) -> f64 {
    let k = 2.0 / (9.0 * m as f64);
    m as f64 * (1.0 - k + normal_quantile(p) * k.sqrt()).powi(3)
}

/// Normal quantile for `p` ≥ 0.5 (Abramowitz and Stegun 26.2.23, error below 4.5e-4).
fn normal_quantile(p: f64) -> f64 {
    let t = (-2.0 * (1.0 - p).ln()).sqrt();
    t - (2.515_517 + t * (0.802_853 + t * 0.010_328))
        / (1.0 + t * (1.432_788 + t * (0.189_269 + t * 0.001_308)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_match_tables() {
        for (p, m, want) in [(0.99, 2, 9.210), (0.999, 8, 26.12), (0.95, 3, 7.815)] {
            let got = chi_square_quantile(p, m);
            assert!((got / want - 1.0).abs() < 0.015, "{p} {m}: {got} for {want}");
        }
    }

    #[test]
    fn cholesky_solves_and_refuses() {
        let mut s = [[0.0; MAX_MEASURED]; MAX_MEASURED];
        (s[0][0], s[1][0], s[0][1], s[1][1]) = (4.0, 2.0, 2.0, 3.0);
        assert!(cholesky(&mut s, 2));
        let mut b = [0.0; MAX_MEASURED];
        (b[0], b[1]) = (2.0, 5.0);
        forward(&s, &mut b[..2]);
        // L = [2 0; 1 √2], so y = (1, 4/√2).
        assert!((b[0] - 1.0).abs() < 1e-12 && (b[1] - 4.0 / 2f64.sqrt()).abs() < 1e-12);
        let mut singular = [[0.0; MAX_MEASURED]; MAX_MEASURED];
        assert!(!cholesky(&mut singular, 2));
    }
}
