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
use super::matrix::{Grid, MAX_MEASURED, Small, axpy, cholesky, forward};
use super::measurement::Measurement;
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
}

impl Workspace {
    pub(crate) fn new(n: usize) -> Self {
        Self {
            whitened: Grid::zeros(MAX_MEASURED, n),
            dx: vec![0.0; n],
            gains: vec![[0.0; MAX_MEASURED]; n],
            kept: Grid::zeros(own::WITH_SECOND, own::WITH_SECOND),
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
        forward(&s, m, &mut white);
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
        self.apply(state, z, &s, &white, held);
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
        forward(&s, z.m, &mut white);
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
        for i in 0..z.m {
            let out = self.whitened.row_mut(i);
            out.fill(0.0);
            for (h, column) in z.row(i).iter().zip(z.columns()) {
                if *h != 0.0 {
                    axpy(out, *h, state.cov.row(*column));
                }
            }
        }
    }

    /// `H P Hᵀ` of what [`Self::project`] left.
    fn spread(&self, z: &Measurement) -> Small {
        let mut s = [[0.0; MAX_MEASURED]; MAX_MEASURED];
        for i in 0..z.m {
            let hp = self.whitened.row(i);
            for j in 0..=i {
                let value: f64 = z.row(j).iter().zip(z.columns()).map(|(h, c)| h * hp[*c]).sum();
                (s[i][j], s[j][i]) = (value, value);
            }
        }
        s
    }

    fn apply(
        &mut self,
        state: &mut State,
        z: &Measurement,
        l: &Small,
        white: &[f64; MAX_MEASURED],
        held: Held,
    ) {
        let m = z.m;
        for i in 0..m {
            for k in 0..i {
                self.whitened.add_row(i, -l[i][k], k);
            }
            let scale = 1.0 / l[i][i];
            self.whitened.row_mut(i).iter_mut().for_each(|x| *x *= scale);
        }
        self.dx.fill(0.0);
        for (i, white) in white[..m].iter().enumerate() {
            axpy(&mut self.dx, *white, self.whitened.row(i));
        }
        for a in held.columns() {
            self.dx[a] = 0.0;
            held.columns().for_each(|b| self.kept.set(a, b, state.cov.at(a, b)));
        }
        for r in 0..state.cov.rows() {
            let row = state.cov.row_mut(r);
            for i in 0..m {
                let w = self.whitened.row(i);
                axpy(row, -w[r], w);
            }
        }
        for a in held.columns() {
            held.columns().for_each(|b| state.cov.set(a, b, self.kept.at(a, b)));
        }
        for copy in state.copies_in_use() {
            self.update_copy(copy, z, l, white);
        }
        state.inject(&self.dx);
        state.keep_heading_unobserved(&self.dx);
        state.keep_scale_unobserved(&self.dx);
    }

    /// Fixed-point smoothing: the copy `c` moves by `P_cx Hᵀ S⁻¹ r`.
    fn update_copy(
        &mut self,
        copy: &mut DelayedCopy,
        z: &Measurement,
        l: &Small,
        white: &[f64; MAX_MEASURED],
    ) {
        let m = z.m;
        let rows = copy.mean.len();
        for c in 0..rows {
            let cross = copy.cross.row(c);
            let mut y = [0.0; MAX_MEASURED];
            for (i, y) in y[..m].iter_mut().enumerate() {
                *y = z.row(i).iter().zip(z.columns()).map(|(h, column)| h * cross[*column]).sum();
            }
            forward(l, m, &mut y);
            self.gains[c] = y;
        }
        for c in 0..rows {
            let y = &self.gains[c];
            let row = copy.cross.row_mut(c);
            for i in 0..m {
                axpy(row, -y[i], self.whitened.row(i));
                copy.mean[c] += y[i] * white[i];
            }
            for d in 0..rows {
                let product: f64 = y[..m].iter().zip(&self.gains[d]).map(|(a, b)| a * b).sum();
                copy.cov.add(c, d, -product);
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
