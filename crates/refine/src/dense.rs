//! Dense matrices of a front, row by row: sums of rows, Cholesky factors, triangular solutions.

/// The normal equations are singular, or not finite.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Singular;

/// `y += Σ a x` over `count` rows, four at once: y is read and written a quarter as often.
#[inline(always)]
pub(crate) fn add_rows<'a>(y: &mut [f64], count: usize, row: impl Fn(usize) -> (f64, &'a [f64])) {
    let n = y.len();
    let fours = count / 4 * 4;
    for first in (0..fours).step_by(4) {
        let [a, b, c, d] = [0, 1, 2, 3].map(|k| row(first + k));
        let (p, q, r, s) = (&a.1[..n], &b.1[..n], &c.1[..n], &d.1[..n]);
        for i in 0..n {
            y[i] += (a.0 * p[i] + b.0 * q[i]) + (c.0 * r[i] + d.0 * s[i]);
        }
    }
    for k in fours..count {
        let (a, x) = row(k);
        axpy(y, a, x);
    }
}

/// `Σ a b`, in four sums side by side.
#[inline(always)]
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a, b) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    let mut sums = [0.0; 4];
    for (a, b) in a.zip(b) {
        (0..4).for_each(|i| sums[i] += a[i] * b[i]);
    }
    rest + (sums[0] + sums[1]) + (sums[2] + sums[3])
}

#[inline(always)]
fn axpy(y: &mut [f64], a: f64, x: &[f64]) {
    if a != 0.0 {
        y.iter_mut().zip(x).for_each(|(y, x)| *y += a * x);
    }
}

/// Lower Cholesky factor in place of a lower triangle.
pub(crate) fn cholesky(l: &mut [f64], n: usize) -> Result<(), Singular> {
    for i in 0..n {
        for j in 0..=i {
            let dot: f64 = l[i * n..][..j].iter().zip(&l[j * n..][..j]).map(|(a, b)| a * b).sum();
            let left = l[i * n + j] - dot;
            if i == j {
                if !(left > 0.0 && left.is_finite()) {
                    return Err(Singular);
                }
                l[i * n + i] = left.sqrt();
            } else {
                l[i * n + j] = left / l[j * n + j];
            }
        }
    }
    Ok(())
}

/// `B ← L⁻¹ B` of `width` columns.
pub(crate) fn forward(l: &[f64], n: usize, b: &mut [f64], width: usize) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        unsafe { forward_wide(l, n, b, width) };
        return;
    }
    forward_plain(l, n, b, width);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn forward_wide(l: &[f64], n: usize, b: &mut [f64], width: usize) {
    forward_plain(l, n, b, width);
}

#[inline(always)]
fn forward_plain(l: &[f64], n: usize, b: &mut [f64], width: usize) {
    for i in 0..n {
        let (done, open) = b.split_at_mut(i * width);
        let row = &mut open[..width];
        add_rows(row, i, |k| (-l[i * n + k], &done[k * width..][..width]));
        let by = 1.0 / l[i * n + i];
        row.iter_mut().for_each(|x| *x *= by);
    }
}

/// `B ← L⁻ᵀ B` of `width` columns.
pub(crate) fn backward(l: &[f64], n: usize, b: &mut [f64], width: usize) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        unsafe { backward_wide(l, n, b, width) };
        return;
    }
    backward_plain(l, n, b, width);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn backward_wide(l: &[f64], n: usize, b: &mut [f64], width: usize) {
    backward_plain(l, n, b, width);
}

#[inline(always)]
fn backward_plain(l: &[f64], n: usize, b: &mut [f64], width: usize) {
    for i in (0..n).rev() {
        let (open, done) = b.split_at_mut((i + 1) * width);
        let row = &mut open[i * width..];
        add_rows(row, n - i - 1, |k| (-l[(i + 1 + k) * n + i], &done[k * width..][..width]));
        let by = 1.0 / l[i * n + i];
        row.iter_mut().for_each(|x| *x *= by);
    }
}
