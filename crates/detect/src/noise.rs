//! The noise of a frame, measured in the frame itself.

use windhover_base::msg::ImageView;

/// Number of rows that are used.
const ROWS: usize = 24;

/// Approximate number of places that are used in a row.
const PLACES: usize = 200;

/// Standard deviation of a pixel's noise, grey levels.
///
/// From `|p − 2q + r|` of neighbours along rows, whose standard deviation is √6 of a pixel's where the scene is smooth.
/// Texture makes it larger only, so the first quartile is used: 0.3186 σ of a normal.
pub(super) fn noise_sigma(image: ImageView<'_>) -> f32 {
    if image.width < 3 {
        return 0.0;
    }
    let mut histogram = [0u32; 1024];
    let mut total = 0;
    let step = (image.width / PLACES).max(1);
    for k in 0..ROWS {
        let row = image.row(image.height * k / ROWS);
        for p in row.windows(3).step_by(step) {
            let second = i32::from(p[0]) - 2 * i32::from(p[1]) + i32::from(p[2]);
            histogram[second.unsigned_abs() as usize] += 1;
            total += 1;
        }
    }
    let mut below = 0;
    for (value, &count) in histogram.iter().enumerate() {
        if (below + count) * 4 >= total {
            // Within a bin the values are spread evenly; bin 0 reaches half as far.
            let inside = (total as f32 / 4.0 - below as f32) / count.max(1) as f32;
            let quartile = (value as f32 - 0.5 + inside).max(0.0);
            return quartile / (0.3186 * 6f32.sqrt());
        }
        below += count;
    }
    0.0
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    use super::*;
    use windhover_base::msg::GrayImage;

    #[test]
    fn noise_is_measured_on_a_slope() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        for sigma in [2.0f32, 6.0, 12.0] {
            let noise = Normal::new(0.0, sigma).expect("a sigma");
            let mut image = GrayImage::new(640, 480);
            for (i, p) in image.data.iter_mut().enumerate() {
                *p = (80.0 + (i % 640) as f32 * 0.15 + noise.sample(&mut rng)).clamp(0.0, 255.0) as u8;
            }
            let measured = noise_sigma(image.view());
            assert!((measured / sigma - 1.0).abs() < 0.15, "{measured} for {sigma}");
        }
        assert_eq!(noise_sigma(GrayImage::new(2, 9).view()), 0.0);
    }
}
