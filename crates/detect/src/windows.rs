//! The windows in which a tag's edges are searched: as narrow as the blur allows, in either direction.

/// Cells wider than this, pixels, have windows no wider: sharp edges are sampled too coarsely in wider ones.
pub(super) const WIDEST_CELL: f64 = 5.7;

/// Sharpness below which edges need a wider window, and above which a narrower one: that of a Gaussian whose sigma is
/// 0.42 and 0.3 of the half width.
const SMEARED: f64 = 0.5;
const NARROW: f64 = 0.68;

/// Half widths of the windows in which edges are searched, along ξ and along η.
#[derive(Clone, Copy, Debug)]
pub(super) struct Windows {
    /// Over the width of a cell.
    widths: [f64; 2],
    /// Pixels.
    pub half: [f32; 2],
    /// Mean of the edges found in them.
    pub sharpness: [f64; 2],
}

impl Default for Windows {
    fn default() -> Self {
        Self { widths: [0.7; 2], half: [0.0; 2], sharpness: [1.0; 2] }
    }
}

impl Windows {
    pub fn halves(&self, pitches: [f64; 2], coarse: bool) -> [f32; 2] {
        [0, 1].map(|axis| {
            let (pitch, width) = (pitches[axis].min(WIDEST_CELL), self.widths[axis]);
            // Two pixels' gradients at least, but hardly more than a cell.
            let least = if coarse { pitch.clamp(1.0, 1.5) } else { (0.625 * pitch).clamp(0.8, 1.25) };
            (width * pitch).clamp(least, 6.0) as f32
        })
    }

    /// Widens where edges fill the window, as far as the neighbours allow; returns whether it did.
    pub fn widen(&mut self) -> bool {
        let mut widened = false;
        for axis in 0..2 {
            if self.sharpness[axis] < SMEARED && self.widths[axis] < 0.9 {
                self.widths[axis] *= 1.3;
                widened = true;
            }
        }
        widened
    }

    /// Narrows where edges are narrow, so that neighbours matter less.
    pub fn narrow(&mut self) {
        for axis in 0..2 {
            if self.sharpness[axis] > NARROW {
                self.widths[axis] *= 0.7;
            }
        }
    }

    /// Variance of the blur, px², from the sharpness in the windows: `q = 1 / (1 + (2 σ / h)²)`, nearly. From it σ
    /// comes out 6 % too large at 0.2 of the half width and 29 % at 1.
    pub fn blurs_squared(&self) -> [f64; 2] {
        [0, 1].map(|axis| {
            let (half, q) = (f64::from(self.half[axis]), self.sharpness[axis].clamp(0.2, 1.0));
            half * half * (1.0 / q - 1.0) / 4.0
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sharpness of an edge blurred by a Gaussian, in the middle of its window: the slope of the biweight's balance
    /// over its weight (`edge_points.rs`), sigma in half widths.
    fn sharpness(sigma: f64) -> f64 {
        let steps = 2_000;
        let (mut slope, mut sum) = (0.0, 0.0);
        for k in 0..steps {
            let d2 = ((f64::from(k) + 0.5) / f64::from(steps)).powi(2);
            let gradient = (-0.5 * d2 / (sigma * sigma)).exp();
            slope += gradient * (1.0 - d2) * (1.0 - 5.0 * d2);
            sum += gradient * (1.0 - d2).powi(2);
        }
        slope / sum
    }

    #[test]
    fn windows_change_at_the_blurs_that_are_said() {
        assert!((sharpness(0.42) - SMEARED).abs() < 0.01, "{}", sharpness(0.42));
        assert!((sharpness(0.303) - NARROW).abs() < 0.01, "{}", sharpness(0.303));
    }

    #[test]
    fn the_blur_is_read_off_the_windows_to_a_third() {
        for (sigma, too_large) in [(0.2, 1.06), (0.3, 1.12), (0.5, 1.22), (1.0, 1.29)] {
            let sharpness = sharpness(sigma);
            // Below 0.2, sharpness shows only that blur fills the window.
            let windows = Windows { half: [1.0; 2], sharpness: [sharpness; 2], ..Windows::default() };
            let factor = windows.blurs_squared()[0].sqrt() / sigma;
            let most = if sharpness < 0.2 { 1.01 } else { too_large };
            assert!((factor - most).abs() < 0.02, "sigma {sigma}: {factor}");
        }
    }
}
