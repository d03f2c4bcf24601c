//! The best possible accuracy of a tag's corners: the Cramér–Rao bound of the model that is fitted (the detector's
//! page).

use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};
use windhover_detect::TagPattern;

/// A homography, a bow, a barrel and a twist of the lens, the blur's two sigmas and covariance, black's light and how
/// far white is from it, both linear over the tag.
const UNKNOWNS: usize = 22;
/// Number of those that move corners.
const GEOMETRY: usize = 13;
type Matrix = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
type Row = SVector<f64, UNKNOWNS>;

/// How a tag is seen.
#[derive(Clone, Copy)]
pub struct Seen<'a> {
    /// Takes tag coordinates, the border's square from −1 to 1, to pixels.
    pub view: &'a Matrix3<f64>,
    pub pattern: &'a TagPattern,
    /// Blur, a pixel's own square included: a sigma in pixels.
    pub blur: f64,
    /// White less black, and the noise of a pixel, grey levels.
    pub contrast: f64,
    pub noise: f64,
}

/// Least possible RMS error of a corner, over all four, pixels: of an estimate that expects a lens where there is none.
pub fn corner_bound(seen: Seen<'_>) -> f64 {
    let h = seen.view / seen.view[(2, 2)];
    let back = h.try_inverse().expect("a view has an inverse");
    let mut information = Matrix::zeros();
    let most = 1.0 + 2.0 / seen.pattern.border as f64;
    let at = |x: f64, y: f64| {
        let p = h * Vector3::new(x, y, 1.0);
        [p.x / p.z, p.y / p.z]
    };
    let bent = Bent::of(h, [at(-1.0, -1.0), at(1.0, -1.0), at(1.0, 1.0), at(-1.0, 1.0)].map(Vector2::from));
    let around = [at(-most, -most), at(most, -most), at(most, most), at(-most, most)];
    let span = |k: usize| {
        let (low, high) = around.iter().fold((f64::MAX, f64::MIN), |m, c| (m.0.min(c[k]), m.1.max(c[k])));
        low.ceil() as i64..=high.floor() as i64
    };
    for (u, v) in span(1).flat_map(|v| span(0).map(move |u| (u as f64, v as f64))) {
        let q = back * Vector3::new(u, v, 1.0);
        let (xi, eta) = (q.x / q.z, q.y / q.z);
        if xi.abs() < most
            && eta.abs() < most
            && let Some(row) = row(&seen, &bent, xi, eta)
        {
            information.syger(1.0, &row, &row, 1.0);
        }
    }
    information.fill_upper_triangle_with_lower_triangle();
    let known = information;
    // The lens's parameters have priors at zero, with the effect of a wide lens as sigma.
    let half = bent.half;
    let [bow, barrel, twist] = [0.75e-4 * half.powi(2), 3e-7 * half.powi(3), 2.5e-5 * half.powi(2)];
    for (k, sigma) in [bow, bow, barrel, twist, twist].into_iter().enumerate() {
        information[(8 + k, 8 + k)] += (seen.noise / sigma).powi(2);
    }
    let inverse = information.cholesky().expect("a tag's pixels tell all of it").inverse();
    // Where there is no lens, as in what is drawn, the priors add no error: only noise does.
    let covariance = (inverse * known * inverse).fixed_view::<GEOMETRY, GEOMETRY>(0, 0) * seen.noise.powi(2);
    let traces = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| {
        let by_geometry = bent.moved(x, y);
        (by_geometry * covariance * by_geometry.transpose()).trace()
    });
    (traces.iter().sum::<f64>() / 4.0).sqrt()
}

/// A view, and the distortion that a lens may add (`refine.rs`).
struct Bent {
    h: Matrix3<f64>,
    middle: Vector2<f64>,
    /// Half the length of a side, pixels.
    half: f64,
}

impl Bent {
    fn of(h: Matrix3<f64>, [p0, p1, p2, p3]: [Vector2<f64>; 4]) -> Self {
        let sides = [p1 - p0 + p2 - p3, p3 - p0 + p2 - p1];
        let length = (0.5 * (sides[0].norm_squared() + sides[1].norm_squared())).sqrt();
        Self { h, middle: (p0 + p1 + p2 + p3) / 4.0, half: length / 4.0 }
    }

    /// ∂pixel/∂geometry.
    fn moved(&self, x: f64, y: f64) -> SMatrix<f64, 2, GEOMETRY> {
        let p = self.h * Vector3::new(x, y, 1.0);
        let (w, u, v) = (1.0 / p.z, p.x / p.z, p.y / p.z);
        let (a, b) = (x * w, y * w);
        let q = (Vector2::new(u, v) - self.middle) / self.half;
        let far = q.norm_squared() - 2.0;
        let (even, odd) = (q.x * q.x - q.y * q.y, 2.0 * q.x * q.y);
        SMatrix::<f64, 2, GEOMETRY>::from_row_slice(&[
            a,
            b,
            w,
            0.0,
            0.0,
            0.0,
            -u * a,
            -u * b,
            far,
            0.0,
            far * q.x,
            even,
            -odd, //
            0.0,
            0.0,
            0.0,
            a,
            b,
            w,
            -v * a,
            -v * b,
            0.0,
            far,
            far * q.y,
            -odd,
            -even,
        ])
    }
}

/// ∂(grey level of a pixel)/∂unknowns; `None` where the ground is visible in it.
fn row(seen: &Seen<'_>, bent: &Bent, xi: f64, eta: f64) -> Option<Row> {
    let h = &bent.h;
    let p = h * Vector3::new(xi, eta, 1.0);
    let (w, u, v) = (1.0 / p.z, p.x / p.z, p.y / p.z);
    let by_q = Matrix2::new(
        (h[(0, 0)] - u * h[(2, 0)]) * w,
        (h[(0, 1)] - u * h[(2, 1)]) * w,
        (h[(1, 0)] - v * h[(2, 0)]) * w,
        (h[(1, 1)] - v * h[(2, 1)]) * w,
    );
    let half = 0.5 * seen.pattern.border as f64;
    // Cells a pixel.
    let slope = by_q.try_inverse()? * half;
    let ring = (seen.pattern.side() as f64 - seen.pattern.border as f64) / 2.0;
    let cell = [(xi + 1.0) * half + ring, (eta + 1.0) * half + ring];
    let lengths = [slope.row(0).norm(), slope.row(1).norm()];
    let shares = [0, 1].map(|k| shares(cell[k], seen.blur * lengths[k]));
    let first = [0, 1].map(|k| cell[k].floor() as i64 - 3);
    let mut sums = [0.0; 6];
    for (j, down) in shares[1].iter().enumerate() {
        for (i, across) in shares[0].iter().enumerate() {
            let (x, y) = (first[0] + i as i64, first[1] + j as i64);
            let inside = |c: i64| (0..seen.pattern.side() as i64).contains(&c);
            let share = across.0 * down.0;
            if !(inside(x) && inside(y)) {
                if share > 0.05 {
                    return None;
                }
                continue;
            }
            if seen.pattern.white(x as usize, y as usize) {
                let parts = [
                    share,
                    across.1 * down.0,
                    across.0 * down.1,
                    across.2 * down.0,
                    across.0 * down.2,
                    across.1 * down.1,
                ];
                sums.iter_mut().zip(parts).for_each(|(sum, part)| *sum += part);
            }
        }
    }
    let by_p = -seen.contrast * (slope.row(0) * sums[1] + slope.row(1) * sums[2]);
    let moved = by_p * bent.moved(xi, eta);
    let mut row = Row::zeros();
    (0..GEOMETRY).for_each(|k| row[k] = moved[k]);
    row[13] = seen.contrast * sums[3] * lengths[0];
    row[14] = seen.contrast * sums[4] * lengths[1];
    row[15] = seen.contrast * sums[5] * lengths[0] * lengths[1];
    row.rows_mut(16, 6).copy_from_slice(&[1.0, xi, eta, sums[0], xi * sums[0], eta * sums[0]]);
    Some(row)
}

/// For seven cells around the one in which `x` lies: the share under a Gaussian, and its slopes with `x` and with
/// sigma.
fn shares(x: f64, sigma: f64) -> [(f64, f64, f64); 7] {
    let edge = |k: usize| match k {
        0 => (1.0, 0.0, 0.0),
        7 => (0.0, 0.0, 0.0),
        k => {
            let t = (x - (x.floor() + k as f64 - 3.0)) / sigma;
            let density = (-0.5 * t * t).exp() / (std::f64::consts::TAU.sqrt() * sigma);
            (normal(t), density, -t * density)
        }
    };
    std::array::from_fn(|k| {
        let (a, b) = (edge(k), edge(k + 1));
        (a.0 - b.0, a.1 - b.1, a.2 - b.2)
    })
}

/// How much of a normal distribution is below `t` (Abramowitz and Stegun 26.2.17, to 1e-7).
fn normal(t: f64) -> f64 {
    let k = 1.0 / (1.0 + 0.231_641_9 * t.abs());
    let terms = [0.319_381_530, -0.356_563_782, 1.781_477_937, -1.821_255_978, 1.330_274_429];
    let sum = terms.iter().rev().fold(0.0, |sum, c| (sum + c) * k);
    let above = sum * (-0.5 * t * t).exp() / std::f64::consts::TAU.sqrt();
    if t < 0.0 { above } else { 1.0 - above }
}
