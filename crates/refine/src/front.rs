//! Normal equations along time: each unknown is eliminated as soon as no later row contains it.
//!
//! The order of the unknowns is: the displacement of the frame at knot 0, knot 0, the landmarks last seen there, knot 1, …, and the constants at the end. At any
//! moment only a *front* of them is open: two neighbouring knots, the landmarks in view, the constants. Its normal
//! equations are one dense matrix, whatever the length of the flight:
//!
//! `H = [H_ee H_er; H_re H_rr]`, `L Lᵀ = H_ee`, `W = L⁻¹ H_er`, `y = L⁻¹ g_e`; then `H_rr −= Wᵀ W`, `g_r −= Wᵀ y`.
//!
//! Backward, `x_e = L⁻ᵀ (y − W x_r)`, and of the inverse of the whole matrix only the part over each front is computed
//! (selected inversion; Takahashi 1973): `G = −L⁻ᵀ W`, `P_er = G P_rr`, `P_ee = (L Lᵀ)⁻¹ + P_er Gᵀ`.

use crate::dense::{Singular, add_rows, backward, cholesky, dot, forward};

/// Layout of a front: two knots, landmarks of two components each, the displacement of a frame, the constants.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Shape {
    pub(crate) knot: usize,
    /// Most landmarks that are open at once.
    pub(crate) landmarks: usize,
    /// Components of the displacement of a frame; 0 where the camera does not shake.
    pub(crate) shake: usize,
    pub(crate) constants: usize,
}

impl Shape {
    /// Unknowns of the front.
    pub(crate) const fn len(self) -> usize {
        self.constants_at() + self.constants
    }

    /// The first unknown of knot `k`: neighbouring knots alternate.
    pub(crate) const fn knot_at(self, k: usize) -> usize {
        (k % 2) * self.knot
    }

    /// The first unknown of the landmark in a place.
    pub(crate) const fn landmark_at(self, place: usize) -> usize {
        2 * self.knot + 2 * place
    }

    /// The first component of the displacement of the frame at hand.
    pub(crate) const fn shake_at(self) -> usize {
        2 * self.knot + 2 * self.landmarks
    }

    /// The first constant.
    pub(crate) const fn constants_at(self) -> usize {
        self.shake_at() + self.shake
    }
}

/// The open normal equations `H x = g`: the lower triangle of H, row by row.
#[derive(Clone, Debug)]
pub(crate) struct Front {
    n: usize,
    h: Vec<f64>,
    g: Vec<f64>,
    /// Memory for a row of products.
    square: Vec<f64>,
}

/// The stored result of eliminated unknowns.
#[derive(Clone, Debug)]
pub(crate) struct Eliminated {
    first: usize,
    len: usize,
    /// Lower Cholesky factor, `len` × `len`.
    l: Vec<f64>,
    /// Unknowns to which it was coupled.
    rest: Vec<u16>,
    /// `L⁻¹ H_er`, `len` × `rest`.
    w: Vec<f64>,
    y: Vec<f64>,
}

impl Eliminated {
    /// By how much its solution reduces the sum of squares.
    pub(crate) fn gain(&self) -> f64 {
        self.y.iter().map(|y| y * y).sum()
    }

    /// Places of its unknowns in the front.
    pub(crate) fn range(&self) -> std::ops::Range<usize> {
        self.first..self.first + self.len
    }
}

impl Front {
    pub(crate) fn new(shape: Shape) -> Self {
        let n = shape.len();
        Self { n, h: vec![0.0; n * n], g: vec![0.0; n], square: Vec::new() }
    }

    /// Adds rows `J x ≈ r` of unit variance with a weight; `rows` has them one after the other, with one value for each
    /// of `columns`.
    pub(crate) fn add(&mut self, columns: &[usize], rows: &[f64], right: &[f64], weight: f64) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            unsafe { self.add_wide(columns, rows, right, weight) };
            return;
        }
        self.add_plain(columns, rows, right, weight);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn add_wide(&mut self, columns: &[usize], rows: &[f64], right: &[f64], weight: f64) {
        self.add_plain(columns, rows, right, weight);
    }

    #[inline(always)]
    fn add_plain(&mut self, columns: &[usize], rows: &[f64], right: &[f64], weight: f64) {
        let width = columns.len();
        let mut square = std::mem::take(&mut self.square);
        square.resize(width, 0.0);
        for (a, &i) in columns.iter().enumerate() {
            let square = &mut square[..=a];
            square.fill(0.0);
            add_rows(square, right.len(), |k| (rows[k * width + a], &rows[k * width..][..width]));
            let product: f64 = right.iter().enumerate().map(|(k, right)| rows[k * width + a] * right).sum();
            self.g[i] += weight * product;
            for (b, (&j, square)) in columns.iter().zip(square.iter()).enumerate() {
                // A column that is named twice has both mixed products in its square.
                let by = if i == j && a != b { 2.0 * weight } else { weight };
                self.h[i.max(j) * self.n + i.min(j)] += by * square;
            }
        }
        self.square = square;
    }

    /// Adds `x ≈ value` of this information to one unknown.
    pub(crate) fn add_prior(&mut self, column: usize, information: f64, value: f64) {
        self.h[column * self.n + column] += information;
        self.g[column] += information * value;
    }

    /// Adds information about an unknown with the value zero.
    pub(crate) fn hold(&mut self, column: usize, information: f64) {
        self.add_prior(column, information, 0.0);
    }

    /// Information about an unknown by itself, and its right side.
    #[cfg(test)]
    pub(crate) fn alone(&self, column: usize) -> (f64, f64) {
        (self.h[column * self.n + column], self.g[column])
    }

    /// Eliminates `len` unknowns from `first` on, their diagonal increased by a share (Marquardt 1963).
    pub(crate) fn eliminate(
        &mut self,
        first: usize,
        len: usize,
        raised: f64,
    ) -> Result<Eliminated, Singular> {
        let (n, last) = (self.n, first + len);
        let mut l = vec![0.0; len * len];
        for i in 0..len {
            l[i * len..=i * len + i].copy_from_slice(&self.h[(first + i) * n + first..][..=i]);
            l[i * len + i] *= 1.0 + raised;
        }
        cholesky(&mut l, len)?;
        let at = |i: usize, j: usize| self.h[i.max(j) * n + i.min(j)];
        let tied = |j: &usize| (first..last).any(|i| at(i, *j) != 0.0);
        let rest: Vec<usize> = (0..first).chain(last..n).filter(tied).collect();
        let width = rest.len();
        let mut w = vec![0.0; len * width];
        for i in 0..len {
            rest.iter().enumerate().for_each(|(j, column)| w[i * width + j] = at(first + i, *column));
        }
        forward(&l, len, &mut w, width);
        let mut y = self.g[first..last].to_vec();
        forward(&l, len, &mut y, 1);
        self.take_off(&rest, &w, &y);
        self.clear(first, last);
        let rest = rest.into_iter().map(|column| column as u16).collect();
        Ok(Eliminated { first, len, l, rest, w, y })
    }

    /// `H_rr −= Wᵀ W`, `g_r −= Wᵀ y`, with the widest arithmetic that the processor has.
    fn take_off(&mut self, rest: &[usize], w: &[f64], y: &[f64]) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            unsafe { self.take_off_wide(rest, w, y) };
            return;
        }
        self.take_off_plain(rest, w, y);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn take_off_wide(&mut self, rest: &[usize], w: &[f64], y: &[f64]) {
        self.take_off_plain(rest, w, y);
    }

    #[inline(always)]
    fn take_off_plain(&mut self, rest: &[usize], w: &[f64], y: &[f64]) {
        let width = rest.len();
        let mut square = vec![0.0; width];
        for (i, &column) in rest.iter().enumerate() {
            square[..=i].fill(0.0);
            add_rows(&mut square[..=i], w.len() / width.max(1), |k| {
                let row = &w[k * width..][..width];
                (row[i], row)
            });
            let h = &mut self.h[column * self.n..][..=column];
            rest[..=i].iter().zip(&square).for_each(|(j, square)| h[*j] -= square);
            self.g[column] -= w.chunks_exact(width).zip(y).map(|(row, y)| row[i] * y).sum::<f64>();
        }
    }

    fn clear(&mut self, first: usize, last: usize) {
        for i in first..self.n {
            let columns = if i < last { 0..i + 1 } else { first..last };
            self.h[i * self.n..][columns].fill(0.0);
        }
        self.g[first..last].fill(0.0);
    }
}

/// The solution, and the inverse of the normal equations, over the front in the backward pass.
#[derive(Clone, Debug)]
pub(crate) struct Back {
    n: usize,
    pub(crate) x: Vec<f64>,
    /// Covariance, row by row; entries of closed unknowns are undefined.
    p: Vec<f64>,
}

impl Back {
    pub(crate) fn new(shape: Shape) -> Self {
        let n = shape.len();
        Self { n, x: vec![0.0; n], p: vec![0.0; n * n] }
    }

    /// Covariance of two unknowns of the front.
    pub(crate) fn covariance(&self, i: usize, j: usize) -> f64 {
        self.p[i * self.n + j]
    }

    /// `a x` of a row over some columns, with the solution x.
    pub(crate) fn change(&self, columns: &[usize], a: &[f64]) -> f64 {
        columns.iter().zip(a).map(|(i, a)| a * self.x[*i]).sum()
    }

    /// `a P aᵀ` of a row over some columns.
    pub(crate) fn variance(&self, columns: &[usize], a: &[f64]) -> f64 {
        let places = (0..columns.len()).filter(|k| a[*k] != 0.0);
        let terms = places.map(|k| {
            let row = &self.p[columns[k] * self.n..][..self.n];
            let before: f64 = columns[..k].iter().zip(a).map(|(j, b)| row[*j] * b).sum();
            a[k] * (2.0 * before + a[k] * row[columns[k]])
        });
        terms.sum()
    }

    /// Opens eliminated unknowns: their solution.
    pub(crate) fn solve(&mut self, e: &Eliminated) {
        let width = e.rest.len();
        let mut x = e.y.clone();
        for (i, x) in x.iter_mut().enumerate() {
            let row = &e.w[i * width..][..width];
            *x -= e.rest.iter().zip(row).map(|(j, w)| self.x[usize::from(*j)] * w).sum::<f64>();
        }
        backward(&e.l, e.len, &mut x, 1);
        self.x[e.first..e.first + e.len].copy_from_slice(&x);
    }

    /// Opens eliminated unknowns: their solution, and their covariance with all open ones.
    pub(crate) fn solve_with_covariance(&mut self, e: &Eliminated) {
        self.solve(e);
        let (n, width) = (self.n, e.rest.len());
        // G, and L⁻ᵀ L⁻¹.
        let mut gain: Vec<f64> = e.w.iter().map(|w| -w).collect();
        backward(&e.l, e.len, &mut gain, width);
        let mut inverse = vec![0.0; e.len * e.len];
        (0..e.len).for_each(|i| inverse[i * e.len + i] = 1.0);
        forward(&e.l, e.len, &mut inverse, e.len);
        backward(&e.l, e.len, &mut inverse, e.len);
        self.open(e, &gain, &inverse);
        for i in e.first..e.first + e.len {
            for j in (0..e.first).chain(e.first + e.len..n) {
                self.p[j * n + i] = self.p[i * n + j];
            }
        }
    }

    /// Rows of the covariance of eliminated unknowns, `G P` and `(L Lᵀ)⁻¹ + G P Gᵀ`, with the widest arithmetic that the
    /// processor has.
    fn open(&mut self, e: &Eliminated, gain: &[f64], inverse: &[f64]) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            unsafe { self.open_wide(e, gain, inverse) };
            return;
        }
        self.open_plain(e, gain, inverse);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn open_wide(&mut self, e: &Eliminated, gain: &[f64], inverse: &[f64]) {
        self.open_plain(e, gain, inverse);
    }

    #[inline(always)]
    fn open_plain(&mut self, e: &Eliminated, gain: &[f64], inverse: &[f64]) {
        let (n, width) = (self.n, e.rest.len());
        let (mut row, mut tied) = (vec![0.0; n], vec![0.0; width]);
        for i in 0..e.len {
            row.fill(0.0);
            let gain_of = &gain[i * width..][..width];
            add_rows(&mut row, width, |k| (gain_of[k], &self.p[usize::from(e.rest[k]) * n..][..n]));
            tied.iter_mut().zip(&e.rest).for_each(|(tied, c)| *tied = row[usize::from(*c)]);
            for j in 0..=i {
                let covariance = inverse[i * e.len + j] + dot(&tied, &gain[j * width..][..width]);
                row[e.first + j] = covariance;
                self.p[(e.first + j) * n + e.first + i] = covariance;
            }
            let own = e.first + i + 1..e.first + e.len;
            self.p[(e.first + i) * n..][..own.start].copy_from_slice(&row[..own.start]);
            self.p[(e.first + i) * n + own.end..][..n - own.end].copy_from_slice(&row[own.end..]);
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    /// Twelve knots of three unknowns, each with two of its frame, landmarks that appear and disappear, two constants: the same
    /// result as the dense equations.
    #[test]
    fn solution_and_covariances_are_those_of_the_dense_equations() {
        let shape = Shape { knot: 3, landmarks: 2, shake: 2, constants: 2 };
        let knots = 12;
        let spans = [(0, 4, 0), (2, 9, 1), (5, 11, 0)];
        let total = 5 * knots + 2 * spans.len() + 2;
        let of_landmark = |i: usize| 5 * knots + 2 * i;
        let constants = total - 2;
        let mut seed = 1u64;
        let mut random = move || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (seed >> 33) as f64 / f64::from(1u32 << 31) - 0.5
        };
        let mut h = DMatrix::<f64>::zeros(total, total);
        let mut g = DVector::<f64>::zeros(total);
        let (mut front, mut done) = (Front::new(shape), Vec::new());
        for k in 0..knots {
            let mut add = |front: &mut Front, here: Vec<usize>, whole: Vec<usize>| {
                let row: Vec<f64> = here.iter().map(|_| random()).collect();
                let right = random();
                front.add(&here, &row, &[right], 1.0);
                for (a, i) in row.iter().zip(&whole) {
                    g[*i] += a * right;
                    row.iter().zip(&whole).for_each(|(b, j)| h[(*i, *j)] += a * b);
                }
            };
            let knot = |k: usize| (0..3).map(move |i| (shape.knot_at(k) + i, 3 * k + i));
            let constant = (0..2).map(|i| (shape.constants_at() + i, constants + i));
            for _ in 0..4 {
                let shake = (0..2).map(|i| (shape.shake_at() + i, 3 * knots + 2 * k + i));
                let (here, whole) = knot(k).chain(shake).chain(constant.clone()).unzip();
                add(&mut front, here, whole);
                if k + 1 < knots {
                    let (here, whole) = knot(k).chain(knot(k + 1)).unzip();
                    add(&mut front, here, whole);
                }
                for (i, (from, to, place)) in spans.into_iter().enumerate() {
                    if (from..=to).contains(&k) {
                        let landmark = (0..2).map(|c| (shape.landmark_at(place) + c, of_landmark(i) + c));
                        let (here, whole) = knot(k).chain(landmark).chain(constant.clone()).unzip();
                        add(&mut front, here, whole);
                    }
                }
            }
            done.push((front.eliminate(shape.shake_at(), 2, 0.0).expect("regular"), 3 * knots + 2 * k));
            done.push((front.eliminate(shape.knot_at(k), 3, 0.0).expect("regular"), 3 * k));
            for (i, (_, to, place)) in spans.into_iter().enumerate() {
                if to == k {
                    let gone = front.eliminate(shape.landmark_at(place), 2, 0.0).expect("regular");
                    done.push((gone, of_landmark(i)));
                }
            }
        }
        done.push((front.eliminate(shape.constants_at(), 2, 0.0).expect("regular"), constants));
        let inverse = h.clone().try_inverse().expect("regular");
        let x = &inverse * g;
        let mut back = Back::new(shape);
        for (e, whole) in done.iter().rev() {
            back.solve_with_covariance(e);
            for i in 0..e.len {
                assert!((back.x[e.first + i] - x[whole + i]).abs() < 1e-8, "{whole}");
                for j in 0..e.len {
                    let (got, want) =
                        (back.covariance(e.first + i, e.first + j), inverse[(whole + i, whole + j)]);
                    assert!((got - want).abs() < 1e-8 * (1.0 + want.abs()), "{whole}: {got} for {want}");
                }
                for c in 0..2 {
                    let got = back.covariance(e.first + i, shape.constants_at() + c);
                    let want = inverse[(whole + i, constants + c)];
                    assert!((got - want).abs() < 1e-8 * (1.0 + want.abs()), "{whole} constant");
                }
            }
        }
    }

    #[test]
    fn what_nothing_ties_down_is_singular() {
        let shape = Shape { knot: 2, landmarks: 0, shake: 0, constants: 0 };
        let mut front = Front::new(shape);
        front.add(&[0, 1], &[1.0, 1.0], &[0.5], 1.0);
        assert_eq!(front.eliminate(0, 2, 0.0).err(), Some(Singular));
    }
}
