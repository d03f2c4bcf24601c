//! One measurement into the state: gate, gain, mean, covariance, delayed copies.
//!
//! States may be held (consider states, Schmidt 1966): what is not known of them counts in the innovation's covariance
//! and in what the others become, but the measurement does not move them. With the rows of the gain that belong to held
//! states set to zero, Joseph's form leaves the part of the covariance between two held states as it is and gives every
//! other part what the optimal update gives it.

#![expect(clippy::needless_range_loop, reason = "matrix arithmetic reads by its indices")]

use windhover_base::msg::Disposition;

use super::blocks::{Block, own};
use super::delayed::DelayedCopy;
use super::matrix::{Grid, MAX_MEASURED, Shear, Small, axpy, cholesky, forward, subtract_rows};
use super::measurement::{MAX_COLUMNS, Measurement};
use super::state::State;

/// Beyond this many times the gate a measurement is refused: no model error explains it.
pub(crate) const REFUSE_RATIO: f64 = 50.0;

/// States of the helicopter's part that a measurement does not move.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(crate) struct Held(u64);

const _: () = assert!(own::WITH_SECOND <= u64::BITS as usize);

impl Held {
    /// None: the measurement moves everything.
    pub(crate) const NONE: Self = Self(0);

    /// These and those of a block.
    pub(crate) const fn and<const N: usize>(self, block: Block<N>) -> Self {
        Self(self.0 | ((1 << N) - 1) << block.column(0))
    }

    /// Those of them that lie before a column.
    pub(crate) const fn before(self, end: usize) -> Self {
        Self(self.0 & ((1 << end) - 1))
    }

    /// Their columns.
    pub(crate) fn columns(self) -> impl Iterator<Item = usize> {
        (0..own::WITH_SECOND).filter(move |column| self.0 >> column & 1 == 1)
    }
}

/// What became of a measurement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Outcome {
    pub(crate) disposition: Disposition,
    /// Normalised innovation squared over the gate.
    pub(crate) ratio: f64,
    /// Variance of each component's innovation as predicted.
    pub(crate) innovation_var: [f64; MAX_MEASURED],
    /// Posterior expectation of the squared error over the noise assumed, a component: one on average
    /// where that noise is the true one, `E[(z − h)ᵀ R⁻¹ (z − h) | data] / m`.
    pub(crate) misfit: f64,
}

/// Room for the arithmetic, made once.
#[derive(Clone, Debug)]
pub(crate) struct Workspace {
    /// `L⁻¹ H P`, one row a component.
    whitened: Grid,
    dx: Vec<f64>,
    /// `L⁻¹ H P_xc`, one entry a state of the delayed copy at hand.
    gains: Vec<[f64; MAX_MEASURED]>,
    /// Covariance of the helicopter's part between held states, as it was before.
    kept: Grid,
    /// What the measurement at hand touches of the states that have a variance.
    touched: Touched,
    /// What keeps heading and scale unobserved, for the step at hand.
    shears: [Shear; 2],
}

/// The part of a Jacobian that belongs to states that have a variance.
#[derive(Clone, Debug)]
struct Touched {
    /// Columns of the state.
    column: [usize; MAX_COLUMNS],
    /// The derivatives of all components by each of them.
    by: [[f64; MAX_MEASURED]; MAX_COLUMNS],
    len: usize,
    /// Columns of the state that have a variance lie before this one.
    width: usize,
}

impl Touched {
    const NONE: Self =
        Self { column: [0; MAX_COLUMNS], by: [[0.0; MAX_MEASURED]; MAX_COLUMNS], len: 0, width: 0 };

    /// Those of `z` that have a variance, and that any of its components moves with.
    fn find(&mut self, z: &Measurement, cov: &Grid, width: usize) {
        (self.len, self.width) = (0, width);
        for (place, column) in z.columns().iter().enumerate() {
            let by = std::array::from_fn(|i| if i < z.m { z.row(i)[place] } else { 0.0 });
            let uncertain = *column < width && cov.at(*column, *column) != 0.0;
            if uncertain && by.iter().any(|d| *d != 0.0) {
                (self.column[self.len], self.by[self.len]) = (*column, by);
                self.len += 1;
            }
        }
    }

    /// The columns with the derivatives by them.
    fn iter(&self) -> impl Iterator<Item = (usize, &[f64; MAX_MEASURED])> {
        self.column[..self.len].iter().copied().zip(&self.by)
    }

    /// `H x` of a row of the state's length.
    #[inline(always)]
    fn times<const M: usize>(&self, row: &[f64]) -> [f64; M] {
        let mut product = [0.0; M];
        for (column, by) in self.iter() {
            let x = row[column];
            product.iter_mut().zip(by).for_each(|(sum, d)| *sum += d * x);
        }
        product
    }
}

impl Workspace {
    pub(crate) fn new(n: usize) -> Self {
        Self {
            whitened: Grid::zeros(MAX_MEASURED, n),
            dx: vec![0.0; n],
            gains: vec![[0.0; MAX_MEASURED]; n],
            kept: Grid::zeros(own::WITH_SECOND, own::WITH_SECOND),
            touched: Touched::NONE,
            shears: [Shear::none(n), Shear::none(n)],
        }
    }

    /// Fuses `z`. With a gate (a chi-square value) the noise of a measurement outside it is raised until
    /// its innovation lies on the gate (soft gate: `R ← R + (ratio − 1) S`, so its weight falls as
    /// 1/ratio however uncertain the state is), and one absurdly far outside is refused. States that are held do
    /// not move.
    pub(crate) fn fuse(
        &mut self,
        state: &mut State,
        z: &Measurement,
        gate: Option<f64>,
        held: Held,
    ) -> Outcome {
        let mut outcome = Outcome {
            disposition: Disposition::Invalid,
            ratio: f64::NAN,
            innovation_var: [0.0; MAX_MEASURED],
            misfit: f64::NAN,
        };
        if !z.is_finite() {
            return outcome;
        }
        let m = z.m;
        self.project(state, z);
        let mut s = self.innovation_covariance(z);
        for i in 0..m {
            outcome.innovation_var[i] = s[i][i];
        }
        if !cholesky(&mut s, m) {
            return outcome;
        }
        let mut white = z.residual;
        forward(&s, &mut white[..m]);
        let squared: f64 = white[..m].iter().map(|x| x * x).sum();
        outcome.ratio = gate.map_or(0.0, |g| squared / g);
        outcome.misfit = misfit(&s, &z.noise, m, &white);
        outcome.disposition = Disposition::Fused;
        if !(outcome.ratio <= REFUSE_RATIO) {
            outcome.disposition = Disposition::GateRejected;
            return outcome;
        }
        if outcome.ratio > 1.0 {
            outcome.disposition = Disposition::Deweighted;
            // Innovation covariance raised until the innovation lies on the gate.
            let root = outcome.ratio.sqrt();
            s.iter_mut().flatten().for_each(|x| *x *= root);
            white.iter_mut().for_each(|x| *x /= root);
        }
        self.apply(state, &s, &white[..m], held);
        outcome
    }

    /// The normalised innovation squared of `z`, which is not fused; `None` where it is no number.
    pub(crate) fn square(&mut self, state: &State, z: &Measurement) -> Option<f64> {
        self.project(state, z);
        let mut s = self.innovation_covariance(z);
        if !z.is_finite() || !cholesky(&mut s, z.m) {
            return None;
        }
        let mut white = z.residual;
        forward(&s, &mut white[..z.m]);
        Some(white[..z.m].iter().map(|x| x * x).sum())
    }

    /// `H P Hᵀ + R` of what [`Self::project`] left.
    fn innovation_covariance(&self, z: &Measurement) -> Small {
        let mut s = self.spread(z);
        for i in 0..z.m {
            for j in 0..z.m {
                s[i][j] += z.noise[i][j];
            }
        }
        s
    }

    /// `H P` into the workspace.
    fn project(&mut self, state: &State, z: &Measurement) {
        let width = state.width();
        self.touched.find(z, &state.cov, width);
        for i in 0..z.m {
            let out = &mut self.whitened.row_mut(i)[..width];
            out.fill(0.0);
            for (column, by) in self.touched.iter() {
                axpy(out, by[i], &state.cov.row(column)[..width]);
            }
        }
    }

    /// `H P Hᵀ` of what [`Self::project`] left.
    fn spread(&self, z: &Measurement) -> Small {
        let mut s = [[0.0; MAX_MEASURED]; MAX_MEASURED];
        for i in 0..z.m {
            let row = self.touched.times::<MAX_MEASURED>(self.whitened.row(i));
            for j in 0..=i {
                (s[i][j], s[j][i]) = (row[j], row[j]);
            }
        }
        s
    }

    /// Mean, covariance and copies by what [`Self::project`] left, with the widest arithmetic that the processor has. Only
    /// the number of components done at once differs, none of them is fused: the bits are the same.
    fn apply(&mut self, state: &mut State, l: &Small, white: &[f64], held: Held) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            unsafe { self.apply_wide(state, l, white, held) };
            return;
        }
        self.apply_plain(state, l, white, held);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn apply_wide(&mut self, state: &mut State, l: &Small, white: &[f64], held: Held) {
        self.apply_plain(state, l, white, held);
    }

    /// By the number of components, so that the compiler lays out the inner loops.
    #[inline(always)]
    fn apply_plain(&mut self, state: &mut State, l: &Small, white: &[f64], held: Held) {
        match white.len() {
            1 => self.apply_to::<1>(state, l, white, held),
            2 => self.apply_to::<2>(state, l, white, held),
            3 => self.apply_to::<3>(state, l, white, held),
            4 => self.apply_to::<4>(state, l, white, held),
            5 => self.apply_to::<5>(state, l, white, held),
            6 => self.apply_to::<6>(state, l, white, held),
            7 => self.apply_to::<7>(state, l, white, held),
            _ => self.apply_to::<MAX_MEASURED>(state, l, white, held),
        }
    }

    #[inline(always)]
    fn apply_to<const M: usize>(&mut self, state: &mut State, l: &Small, white: &[f64], held: Held) {
        let width = self.touched.width;
        for i in 0..M {
            for k in 0..i {
                self.whitened.add_row(i, -l[i][k], k);
            }
            let scale = 1.0 / l[i][i];
            self.whitened.row_mut(i).iter_mut().for_each(|x| *x *= scale);
        }
        self.dx.fill(0.0);
        for i in 0..M {
            axpy(&mut self.dx[..width], white[i], &self.whitened.row(i)[..width]);
        }
        for a in held.columns() {
            self.dx[a] = 0.0;
            held.columns().for_each(|b| self.kept.set(a, b, state.cov.at(a, b)));
        }
        let whitened: [&[f64]; M] = std::array::from_fn(|i| &self.whitened.row(i)[..width]);
        for r in 0..width {
            let by = whitened.map(|w| w[r]);
            // A state without variance is not moved.
            if by.iter().any(|w| *w != 0.0) {
                subtract_rows(&mut state.cov.row_mut(r)[..width], &by, &whitened);
            }
        }
        for a in held.columns() {
            held.columns().for_each(|b| state.cov.set(a, b, self.kept.at(a, b)));
        }
        state.inject(&self.dx);
        let [heading, scale] = &mut self.shears;
        state.keep_heading_unobserved(&self.dx, heading);
        state.keep_scale_unobserved(&self.dx, scale);
        self.shears.iter().for_each(|shear| state.cov.shear(shear));
        for copy in state.copies_in_use() {
            self.update_copy::<M>(copy, l, white);
        }
    }

    /// Fixed-point smoothing: the copy `c` moves by `P_cx Hᵀ S⁻¹ r`.
    #[inline(always)]
    fn update_copy<const M: usize>(&mut self, copy: &mut DelayedCopy, l: &Small, white: &[f64]) {
        let width = self.touched.width;
        let whitened: [&[f64]; M] = std::array::from_fn(|i| &self.whitened.row(i)[..width]);
        for c in 0..copy.mean.len() {
            let mut y = self.touched.times::<M>(copy.cross.row(c));
            forward(l, &mut y);
            let cross = &mut copy.cross.row_mut(c)[..width];
            subtract_rows(cross, &y, &whitened);
            self.shears.iter().for_each(|shear| shear.carry(cross));
            copy.mean[c] += y.iter().zip(white).map(|(y, white)| y * white).sum::<f64>();
            self.gains[c][..M].copy_from_slice(&y);
            for d in 0..=c {
                let product: f64 = y.iter().zip(&self.gains[d]).map(|(a, b)| a * b).sum();
                copy.cov.add(c, d, -product);
                if d < c {
                    copy.cov.add(d, c, -product);
                }
            }
        }
    }
}

/// `(νᵀ S⁻¹ R S⁻¹ ν + m − tr(S⁻¹ R)) / m` from `S = L Lᵀ` and the whitened innovation `L⁻¹ ν`.
fn misfit(l: &Small, noise: &Small, m: usize, white: &[f64; MAX_MEASURED]) -> f64 {
    let mut inverse = [[0.0; MAX_MEASURED]; MAX_MEASURED];
    for k in 0..m {
        // Column k of L⁻¹ as a row: only entries from k on differ from zero.
        inverse[k][k] = 1.0;
        for i in k..m {
            for j in k..i {
                inverse[k][i] -= l[i][j] * inverse[k][j];
            }
            inverse[k][i] /= l[i][i];
        }
    }
    let dot = |a: &[f64; MAX_MEASURED], b: &[f64; MAX_MEASURED]| -> f64 {
        a[..m].iter().zip(&b[..m]).map(|(a, b)| a * b).sum()
    };
    let mut weighed = [0.0; MAX_MEASURED];
    for (k, weighed) in weighed[..m].iter_mut().enumerate() {
        *weighed = dot(&inverse[k], white);
    }
    let (mut square, mut trace) = (0.0, 0.0);
    for i in 0..m {
        for j in 0..m {
            if noise[i][j] != 0.0 {
                square += weighed[i] * noise[i][j] * weighed[j];
                trace += dot(&inverse[i], &inverse[j]) * noise[i][j];
            }
        }
    }
    (square + m as f64 - trace) / m as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blocks::Layout;
    use crate::fitted::Learnt;
    use crate::kind::TiltWatch;
    use crate::own::Senses;

    /// A state with some covariance, a delayed copy, and a measurement of `m` components of it.
    fn example(m: usize) -> (State, Measurement) {
        let layout = Layout { own: own::LEN, targets: 1, features: 2, tags: 0 };
        let tilt = std::array::from_fn(|_| TiltWatch::default());
        let mut state = State::new(layout, 2, Learnt::default(), Senses::default(), tilt);
        let n = layout.len();
        let wave = |i: usize, j: usize| ((i * 7 + j * 3) as f64 * 0.37).sin();
        for i in 0..n {
            for j in 0..n {
                let product: f64 = (0..n).map(|k| wave(i, k) * wave(j, k)).sum();
                state.cov.set(i, j, product + if i == j { 1.0 } else { 0.0 });
            }
        }
        state.copy_targets(7, windhover_base::time::Span::from_ms(400.0));
        let mut z = Measurement::default();
        z.begin(m);
        let (attitude, place) = (z.touch(own::ATTITUDE), z.touch(layout.target(0).pose()));
        for i in 0..m {
            z.set(i, attitude, &nalgebra::SMatrix::<f64, 1, 3>::from_fn(|_, k| wave(i, k + 1)));
            z.set(i, place, &nalgebra::SMatrix::<f64, 1, 3>::from_fn(|_, k| wave(i + 3, k)));
            (z.residual[i], z.noise[i][i]) = (wave(i, 5), 0.5);
        }
        (state, z)
    }

    #[test]
    fn the_wide_arithmetic_gives_the_same_bits() {
        for m in 1..=MAX_MEASURED {
            let (state, z) = example(m);
            let updated = |by: fn(&mut Workspace, &mut State, &Small, &[f64], Held)| {
                let (mut state, mut work) = (state.clone(), Workspace::new(state.layout().len()));
                work.project(&state, &z);
                let mut s = work.innovation_covariance(&z);
                assert!(cholesky(&mut s, m));
                let mut white = z.residual;
                forward(&s, &mut white[..m]);
                by(&mut work, &mut state, &s, &white[..m], Held::NONE.and(own::TRIM));
                (state.cov, state.copies[0].cross.clone(), state.copies[0].mean.clone())
            };
            assert_eq!(updated(Workspace::apply), updated(Workspace::apply_plain));
        }
    }
}
