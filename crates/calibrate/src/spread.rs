//! Statistics of errors in the plane.

use nalgebra::{Matrix2, Vector2};

/// Mean, and covariance about it, of (north, east) errors; zero where there are too few.
pub fn moments(errors_m: &[[f64; 2]]) -> (Vector2<f64>, Matrix2<f64>) {
    let n = errors_m.len();
    if n < 2 {
        return (Vector2::zeros(), Matrix2::zeros());
    }
    let mean = errors_m.iter().map(|e| Vector2::from(*e)).sum::<Vector2<f64>>() / n as f64;
    let spread: Matrix2<f64> = errors_m
        .iter()
        .map(|e| {
            let d = Vector2::from(*e) - mean;
            d * d.transpose()
        })
        .sum();
    (mean, spread / (n - 1) as f64)
}

/// Radii that contain 50 % and 95 % of the errors, and the largest; zero where there are none.
pub fn radii(errors_m: &[[f64; 2]]) -> (f64, f64, f64) {
    let mut distances: Vec<f64> = errors_m.iter().map(|e| e[0].hypot(e[1])).collect();
    distances.sort_by(f64::total_cmp);
    let quantile = |q: f64| match distances.len() {
        0 => 0.0,
        n => distances[((q * n as f64).ceil() as usize).clamp(1, n) - 1],
    };
    (quantile(0.5), quantile(0.95), quantile(1.0))
}
