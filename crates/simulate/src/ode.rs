//! Integration of motion over a grid, and smooth values between the grid's points.

/// One step of the classical Runge–Kutta method of order four: `y' = f(t, y)` over `h`.
pub(super) fn rk4<const N: usize>(
    f: impl Fn(f64, &[f64; N]) -> [f64; N],
    t: f64,
    y: &[f64; N],
    h: f64,
) -> [f64; N] {
    let plus = |k: &[f64; N], step: f64| -> [f64; N] { std::array::from_fn(|i| y[i] + step * k[i]) };
    let k1 = f(t, y);
    let k2 = f(t + 0.5 * h, &plus(&k1, 0.5 * h));
    let k3 = f(t + 0.5 * h, &plus(&k2, 0.5 * h));
    let k4 = f(t + h, &plus(&k3, h));
    std::array::from_fn(|i| y[i] + h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]))
}

/// A motion `y(t)` kept as values and derivatives on an even grid.
#[derive(Clone, Debug)]
pub(super) struct Table<const N: usize> {
    start_s: f64,
    step_s: f64,
    nodes: Vec<([f64; N], [f64; N])>,
}

impl<const N: usize> Table<N> {
    /// Integrates `y' = f(t, y)` from `y0` at `start_s` until past `end_s`.
    pub(super) fn integrate(
        f: impl Fn(f64, &[f64; N]) -> [f64; N],
        y0: [f64; N],
        (start_s, end_s): (f64, f64),
        step_s: f64,
    ) -> Self {
        let steps = ((end_s - start_s) / step_s).ceil().max(1.0) as usize;
        let mut nodes = Vec::with_capacity(steps + 1);
        let mut y = y0;
        for k in 0..=steps {
            let t = start_s + k as f64 * step_s;
            nodes.push((y, f(t, &y)));
            y = rk4(&f, t, &y, step_s);
        }
        Self { start_s, step_s, nodes }
    }

    /// A motion that begins at `start_s`; [`Self::push`] goes on with it.
    pub(super) fn begin(start_s: f64, step_s: f64, y: [f64; N], derivative: [f64; N]) -> Self {
        Self { start_s, step_s, nodes: vec![(y, derivative)] }
    }

    /// The next state on the grid, a step later.
    pub(super) fn push(&mut self, y: [f64; N], derivative: [f64; N]) {
        self.nodes.push((y, derivative));
    }

    /// The last state on the grid, and its time.
    pub(super) fn last(&self) -> (f64, [f64; N]) {
        let last = self.nodes.len() - 1;
        (self.start_s + last as f64 * self.step_s, self.nodes[last].0)
    }

    /// The state at `t_s` by cubic Hermite interpolation, held at the ends of the grid.
    pub(super) fn at(&self, t_s: f64) -> [f64; N] {
        let last = self.nodes.len() - 1;
        let position = ((t_s - self.start_s) / self.step_s).clamp(0.0, last as f64);
        let k = (position as usize).min(last.saturating_sub(1));
        let s = position - k as f64;
        let ((y0, d0), (y1, d1)) = (&self.nodes[k], &self.nodes[(k + 1).min(last)]);
        let h = self.step_s;
        let (s2, s3) = (s * s, s * s * s);
        let (a0, b0) = (2.0 * s3 - 3.0 * s2 + 1.0, (s3 - 2.0 * s2 + s) * h);
        let (a1, b1) = (3.0 * s2 - 2.0 * s3, (s3 - s2) * h);
        std::array::from_fn(|i| a0 * y0[i] + b0 * d0[i] + a1 * y1[i] + b1 * d1[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_oscillator_is_followed_between_the_nodes() {
        let table = Table::integrate(|_, y: &[f64; 2]| [y[1], -9.0 * y[0]], [0.0, 3.0], (0.0, 10.0), 0.005);
        for k in 0..997 {
            let t = f64::from(k) * 0.01003;
            assert!((table.at(t)[0] - (3.0 * t).sin()).abs() < 1e-7, "at {t}");
        }
    }
}
