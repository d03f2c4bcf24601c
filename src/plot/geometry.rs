//! Points of curves: covariance ellipses, and lines thinned to a chart's resolution.

use nalgebra::Matrix2;

/// The outline of the ellipse `{x : (x − c)ᵀ C⁻¹ (x − c) = scale²}`, closed, 73 points; empty where the covariance is
/// not valid.
pub fn ellipse(center: [f64; 2], covariance: &Matrix2<f64>, scale: f64) -> Vec<[f64; 2]> {
    if !covariance.iter().all(|x| x.is_finite()) {
        return Vec::new();
    }
    let eigen = covariance.symmetric_eigen();
    if eigen.eigenvalues.iter().any(|&l| l < -1e-9 * covariance.trace().abs()) {
        return Vec::new();
    }
    let axes =
        eigen.eigenvectors * Matrix2::from_diagonal(&eigen.eigenvalues.map(|l| l.max(0.0).sqrt() * scale));
    (0..=72)
        .map(|k| {
            let (s, c) = (f64::from(k) * std::f64::consts::TAU / 72.0).sin_cos();
            let p = axes * nalgebra::Vector2::new(c, s);
            [center[0] + p.x, center[1] + p.y]
        })
        .collect()
}

/// At most about `limit` points of a curve: of each group of neighbours the first, the lowest and the highest are kept,
/// so that spikes survive. A NaN point breaks the curve and is kept.
pub fn thin(points: &[[f64; 2]], limit: usize) -> Vec<[f64; 2]> {
    if points.len() <= limit.max(4) {
        return points.to_vec();
    }
    let run = (3 * points.len()).div_ceil(limit.max(4));
    let mut kept = Vec::with_capacity(limit + 8);
    for chunk in points.chunks(run) {
        let mut of_chunk = vec![0];
        let finite = || chunk.iter().enumerate().filter(|(_, p)| p[1].is_finite());
        of_chunk.extend(finite().min_by(|a, b| a.1[1].total_cmp(&b.1[1])).map(|(k, _)| k));
        of_chunk.extend(finite().max_by(|a, b| a.1[1].total_cmp(&b.1[1])).map(|(k, _)| k));
        of_chunk.extend(chunk.iter().position(|p| !p[1].is_finite()));
        of_chunk.sort_unstable();
        of_chunk.dedup();
        kept.extend(of_chunk.into_iter().map(|k| chunk[k]));
    }
    if let Some(&last) = points.last() {
        kept.push(last);
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ellipse_of_a_diagonal_covariance() {
        let outline = ellipse([1.0, 2.0], &Matrix2::new(4.0, 0.0, 0.0, 1.0), 2.0);
        let east = outline.iter().map(|p| p[0]).fold(f64::MIN, f64::max);
        let north = outline.iter().map(|p| p[1]).fold(f64::MIN, f64::max);
        assert!((east - 5.0).abs() < 1e-9 && (north - 4.0).abs() < 1e-9);
        assert!(ellipse([0.0, 0.0], &Matrix2::new(1.0, 3.0, 3.0, 1.0), 1.0).is_empty());
    }

    #[test]
    fn a_spike_survives_thinning() {
        let mut curve: Vec<[f64; 2]> = (0..10_000).map(|k| [f64::from(k), 0.0]).collect();
        curve[5_003][1] = 9.0;
        let thinned = thin(&curve, 300);
        assert!(thinned.len() < 320 && thinned.iter().any(|p| p[1] == 9.0));
        assert!(thinned.windows(2).all(|w| w[0][0] <= w[1][0]));
    }
}
