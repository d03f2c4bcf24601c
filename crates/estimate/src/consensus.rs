//! Which of several measurements of one instant agree with each other, before any of them is fused.
//!
//! Innovations of one instant share the errors of the state. Given that measurement `k` is right, the innovation of
//! `a` is `ν_a − S_ak S_kk⁻¹ ν_k` with covariance `S_aa − S_ak S_kk⁻¹ S_ka`: what is common to both is gone, and what
//! is left is as sharp as the measurements' own noise. A set agrees where each of its members lies inside the gate
//! given those taken before it (1-point random sample consensus with the filter's prior, Civera et al. 2010, here
//! with every member as the first one in turn, which leaves nothing to chance).

use nalgebra::{Matrix2, Vector2};

use super::matrix::Grid;

/// Innovations of two components each, with their joint covariance; keeps its room.
#[derive(Clone, Debug, Default)]
pub(crate) struct Innovations {
    n: usize,
    value: Vec<Vector2<f64>>,
    /// Of all components with all.
    cov: Grid,
    given: Given,
    best: Vec<bool>,
}

/// Innovations and covariance given the members taken so far.
#[derive(Clone, Debug, Default)]
struct Given {
    value: Vec<Vector2<f64>>,
    cov: Grid,
    taken: Vec<bool>,
}

impl Innovations {
    /// With capacity for so many.
    pub(crate) fn with_room(most: usize) -> Self {
        let grid = Grid::zeros(2 * most, 2 * most);
        let value = vec![Vector2::zeros(); most];
        let given = Given { value: value.clone(), cov: grid.clone(), taken: vec![false; most] };
        Self { n: 0, value, cov: grid, given, best: vec![false; most] }
    }

    /// Begins with `n` of them.
    pub(crate) fn begin(&mut self, n: usize) {
        debug_assert!(n <= self.value.len());
        self.n = n;
    }

    /// Sets innovation `i`.
    pub(crate) fn set_value(&mut self, i: usize, value: Vector2<f64>) {
        self.value[i] = value;
    }

    /// Sets the covariance of innovations `i` and `j`.
    pub(crate) fn set_cov(&mut self, i: usize, j: usize, cov: &Matrix2<f64>) {
        for (a, b) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            self.cov.set(2 * i + a, 2 * j + b, cov[(a, b)]);
        }
    }

    /// Whether one is of the set that was found last.
    pub(crate) fn agrees(&self, i: usize) -> bool {
        self.best[i]
    }

    /// Finds those inside a gate, each one alone.
    pub(crate) fn inside(&mut self, gate: f64) {
        self.given.begin(self.n, &self.value, &self.cov);
        for i in 0..self.n {
            self.best[i] = self.given.square(i).is_some_and(|square| square <= gate);
        }
    }

    /// Leaves of the set that was found last those inside a gate by themselves as well.
    pub(crate) fn keep_inside(&mut self, gate: f64) {
        for i in 0..self.n {
            let cov = Matrix2::from_fn(|a, b| self.cov.at(2 * i + a, 2 * i + b));
            let square = cov.try_inverse().map(|inverse| self.value[i].dot(&(inverse * self.value[i])));
            self.best[i] &= square.is_some_and(|square| square <= gate);
        }
    }

    /// Finds the largest set that agrees within a gate (a chi-square value of two degrees), and of equal ones the one
    /// with the smallest sum of normalised squares; returns their number. A first member is taken whatever its prior
    /// is: a gust moves all of them in the same way.
    pub(crate) fn agreeing(&mut self, gate: f64) -> usize {
        let (mut most, mut least) = (0, f64::INFINITY);
        self.best[..self.n].fill(false);
        for first in 0..self.n {
            let (members, squares) = self.grow(first, gate);
            if members > most || (members == most && squares < least) {
                (most, least) = (members, squares);
                let Self { best, given, n, .. } = self;
                best[..*n].copy_from_slice(&given.taken[..*n]);
            }
            // No other set can be larger than all of them.
            if most == self.n {
                break;
            }
        }
        most
    }

    /// The largest normalised square within a majority, each member given those before it, where that is least over all first
    /// members.
    pub(crate) fn majority_square(&mut self) -> f64 {
        (0..self.n).map(|first| self.majority_from(first)).fold(f64::INFINITY, f64::min)
    }

    /// The same with this first member.
    fn majority_from(&mut self, first: usize) -> f64 {
        let (n, given) = (self.n, &mut self.given);
        given.begin(n, &self.value, &self.cov);
        given.take(first, n);
        let mut largest: f64 = 0.0;
        for _ in 0..n / 2 {
            let Some((next, square)) = given.nearest(n) else { break };
            given.take(next, n);
            largest = largest.max(square);
        }
        largest
    }

    /// Grows a set from its first member; how many it has, and the sum of their normalised squares.
    fn grow(&mut self, first: usize, gate: f64) -> (usize, f64) {
        let (n, given) = (self.n, &mut self.given);
        given.begin(n, &self.value, &self.cov);
        let Some(square) = given.square(first) else { return (0, f64::INFINITY) };
        let (mut members, mut squares) = (1, square);
        given.take(first, n);
        loop {
            match given.nearest(n) {
                Some((i, square)) if square <= gate => {
                    given.take(i, n);
                    (members, squares) = (members + 1, squares + square);
                }
                _ => return (members, squares),
            }
        }
    }
}

impl Given {
    /// Begins with `n` of them, of which none is taken.
    fn begin(&mut self, n: usize, value: &[Vector2<f64>], cov: &Grid) {
        self.value[..n].copy_from_slice(&value[..n]);
        self.cov.copy_from(cov);
        self.taken[..n].fill(false);
    }

    fn block(&self, i: usize, j: usize) -> Matrix2<f64> {
        Matrix2::from_fn(|a, b| self.cov.at(2 * i + a, 2 * j + b))
    }

    /// `νᵀ S⁻¹ ν` of one; `None` where its covariance is singular.
    fn square(&self, i: usize) -> Option<f64> {
        let square = self.value[i].dot(&(self.block(i, i).try_inverse()? * self.value[i]));
        square.is_finite().then_some(square)
    }

    /// The one not taken that is nearest to what the others say, and its normalised square.
    fn nearest(&self, n: usize) -> Option<(usize, f64)> {
        let open = (0..n).filter(|i| !self.taken[*i]);
        open.filter_map(|i| Some((i, self.square(i)?))).min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// Takes a member: its information on all others is subtracted from them.
    fn take(&mut self, k: usize, n: usize) {
        self.taken[k] = true;
        let Some(inverse) = self.block(k, k).try_inverse() else { return };
        for a in (0..n).filter(|a| *a != k) {
            let gain = self.block(a, k) * inverse;
            let less = gain * self.value[k];
            self.value[a] -= less;
            for b in (0..n).filter(|b| *b != k) {
                let less = gain * self.block(k, b);
                for (r, c) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    self.cov.add(2 * a + r, 2 * b + c, -less[(r, c)]);
                }
            }
        }
        // Nobody is judged by it again.
        for a in (0..n).filter(|a| *a != k) {
            for (r, c) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                self.cov.set(2 * a + r, 2 * k + c, 0.0);
                self.cov.set(2 * k + r, 2 * a + c, 0.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of the ground seen with a tenth of a pixel of noise by a camera whose turn is known to five pixels.
    fn seen(values: &[(f64, f64)]) -> Vec<bool> {
        let mut innovations = Innovations::with_room(12);
        innovations.begin(values.len());
        for (i, (x, y)) in values.iter().enumerate() {
            innovations.set_value(i, Vector2::new(*x, *y));
            for j in 0..values.len() {
                let own = if i == j { 0.01 } else { 0.0 };
                innovations.set_cov(i, j, &(Matrix2::identity() * (25.0 + own)));
            }
        }
        innovations.agreeing(13.8);
        (0..values.len()).map(|i| innovations.agrees(i)).collect()
    }

    #[test]
    fn what_moves_alike_is_one_movement_of_the_camera() {
        assert_eq!(seen(&[(7.0, -3.0), (7.1, -3.1), (6.9, -2.9)]), [true; 3]);
        // Beyond what the prior allows as well: a gust.
        assert_eq!(seen(&[(30.0, 0.0), (30.1, 0.1), (29.9, 0.0)]), [true; 3]);
    }

    #[test]
    fn the_few_that_move_otherwise_are_left_out_whoever_comes_first() {
        let still = (1.0, 1.0);
        // Two that walk in different directions, placed before and among five that stand; each alone is within the
        // prior.
        let found = seen(&[(6.0, 1.0), still, still, (1.0, -4.0), still, still, still]);
        assert_eq!(found, [false, true, true, false, true, true, true]);
    }

    #[test]
    fn of_two_groups_alike_in_number_the_likelier_is_taken() {
        let found = seen(&[(12.0, 1.0), (12.1, 1.0), (1.0, 0.0), (1.1, 0.0)]);
        assert_eq!(found, [false, false, true, true]);
    }

    #[test]
    fn one_alone_and_none_at_all() {
        assert_eq!(seen(&[(2.0, 0.0)]), [true]);
        assert!(seen(&[]).is_empty());
    }
}
