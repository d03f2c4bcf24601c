//! Sizes of the tags of a vehicle against each other, before the second one of a frame is fused.
//!
//! While tilt is hardly known, or a vehicle may sway, a tag of another size than configured is inside the gate, and bends
//! everything else: it would take seconds until it contradicts the first one. What it measures beside that one shows it in
//! the first frames: neither tilt nor sway makes one tag much larger than the other.

use nalgebra::{Matrix2, Vector2};

use windhover_base::msg::MarkerDetection;

use super::aid::pixel;
use super::blocks::own;
use super::core::Core;
use super::tag_fit;

/// Sigmas of the comparison, and least difference of a size.
const SIGMAS: f64 = 5.0;
const DIFFERENCE: f64 = 0.01;
/// By how much the plane of the tags may be inclined beside what is known of tilt, one sigma, rad.
const INCLINED: f64 = 0.05;

/// How much larger than beside the first tag of its frame a tag is, over some frames: logarithms.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct SizeTest {
    sum: f64,
    /// Sum of the variances by the pixels' noise.
    noise: f64,
    frames: u32,
}

impl SizeTest {
    /// Takes a comparison with its variance; whether the size is another one, with what all frames have in common of
    /// this variance.
    fn take(&mut self, larger: f64, noise: f64, common: f64) -> bool {
        self.sum += larger;
        self.noise += noise;
        self.frames += 1;
        let n = f64::from(self.frames);
        let sigma = (self.noise / (n * n) + common).sqrt();
        (self.sum / n).abs() > DIFFERENCE.max(SIGMAS * sigma)
    }
}

impl Core {
    /// Compares the size of a tag, seen in the same frame as the first one of its target that was fused, and opens it where it
    /// is another one.
    pub(crate) fn judge_size(&mut self, target: usize, first: &MarkerDetection, second: &MarkerDetection) {
        let of = |seen: &MarkerDetection| self.models.find(seen.marker).map(|(_, marker)| marker);
        let Some((first_marker, marker)) = of(first).zip(of(second)) else { return };
        let slot_of = |marker: usize| self.models.targets[target].markers[marker].fit;
        let Some((first_slot, slot)) = slot_of(first_marker).zip(slot_of(marker)) else { return };
        if self.at_truth || [first_slot, slot].iter().any(|slot| self.state.tags[*slot].differs()) {
            return;
        }
        let sizes = self.larger(target, first_marker, first).zip(self.larger(target, marker, second));
        let Some(((first_by, first_var), (by, var))) = sizes else { return };
        let apart = (first.center_px - second.center_px).norm() / self.models.camera.fx;
        let tilt_var = (0..2).map(|i| self.state.cov.sigma(own::ATTITUDE, i).powi(2)).sum::<f64>();
        let common = apart * apart * (tilt_var + INCLINED * INCLINED);
        if self.state.tags[slot].size.take(by - first_by, var + first_var, common) {
            self.open_sizes(target, first_slot, slot);
        }
    }

    /// Logarithm of a tag's size in the picture over that expected, and its variance by the noise of its corners.
    fn larger(&self, target: usize, marker: usize, seen: &MarkerDetection) -> Option<(f64, f64)> {
        let (state, models) = (&self.state, &self.models);
        let marker = &models.targets[target].markers[marker];
        let (points, corners_px) = marker.corners.as_ref().zip(seen.corners_px.as_ref())?;
        let slot = marker.fit?;
        let fitted = tag_fit::corners(&state.tags[slot].mean, &marker.center, points);
        let mut expected = [Vector2::zeros(); 4];
        for (px, (point, _)) in expected.iter_mut().zip(&fitted) {
            let (world, _) = pixel::target_point(&state.targets[target].mean, models, point);
            *px = pixel::view(&state.own, models, &world)?.px;
        }
        let size_px = perimeter(corners_px) / 4.0;
        let corner_var: f64 = seen.corner_cov_px2.iter().map(Matrix2::trace).sum::<f64>() / 8.0;
        // The mean of four edges moves by √2/4 of what each corner does.
        let var = 0.5 * (corner_var + models.marker_var_px2) / (size_px * size_px);
        let by = (perimeter(corners_px) / perimeter(&expected)).ln();
        (by.is_finite() && var.is_finite()).then_some((by, var))
    }
}

fn perimeter(corners: &[Vector2<f64>; 4]) -> f64 {
    (0..4).map(|i| (corners[i] - corners[(i + 1) % 4]).norm()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_size_is_found_as_soon_as_noise_allows() {
        // Tags of 34 px, 0.14 px a corner, 70 px apart at a focal length of 1000 px.
        let noise = 2.0 * 0.5 * (0.14_f64 / 34.0).powi(2);
        let common = (0.07_f64 * 0.05).powi(2);
        let frames = |larger: f64| {
            let mut test = SizeTest::default();
            (1..=100).find(|_| test.take(larger, noise, common))
        };
        assert_eq!(frames(0.05), Some(1));
        assert_eq!(frames(-0.05), Some(1));
        assert!(frames(0.02).is_some_and(|n| n < 20), "{:?}", frames(0.02));
        assert_eq!(frames(0.009), None, "what sway and tilt may do");
    }
}
