//! Box-averaged image pyramid: each level halves the one below.
//!
//! Pixel `i` of a level covers pixels `2i` and `2i + 1` of the level below, so that with pixel centres at
//! integers `u_below = 2 u + 0.5`.

use super::simd::Simd;
use crate::msg::{GrayImage, ImageView};

/// Levels below the frame itself, biggest first.
#[derive(Clone, Debug, Default)]
pub(super) struct Pyramid {
    levels: Vec<GrayImage>,
    used: usize,
}

/// Most halvings: a cell of a tag as wide as the largest image is then a few pixels.
const MOST_LEVELS: usize = 8;

impl Pyramid {
    /// Builds as many levels as leave at least `least` pixels on the shorter side.
    pub fn build(&mut self, image: ImageView<'_>, least: usize, simd: Simd) {
        self.used = 0;
        let (mut width, mut height) = (image.width, image.height);
        while self.used < MOST_LEVELS && (width / 2).min(height / 2) >= least.max(1) {
            (width, height) = (width / 2, height / 2);
            if self.levels.len() == self.used {
                self.levels.push(GrayImage::default());
            }
            let (below, rest) = self.levels.split_at_mut(self.used);
            let level = &mut rest[0];
            (level.width, level.height, level.stride) = (width, height, width);
            level.data.resize(width * height, 0);
            halve(below.last().map_or(image, |b| b.view()), level, simd);
            self.used += 1;
        }
    }

    /// Level 0 is `image`, level `n` is halved `n` times; the smallest where there is none so small.
    pub fn level<'a>(&'a self, image: ImageView<'a>, n: usize) -> ImageView<'a> {
        match n.min(self.used) {
            0 => image,
            n => self.levels[n - 1].view(),
        }
    }

    /// The highest level.
    pub fn top(&self) -> usize {
        self.used
    }
}

/// Averages 2×2 blocks, halves rounded up; an odd last row or column is left out.
fn halve(from: ImageView<'_>, to: &mut GrayImage, simd: Simd) {
    for v in 0..to.height {
        let (above, below) = (from.row(2 * v), from.row(2 * v + 1));
        simd.halve_rows(above, below, &mut to.data[v * to.stride..v * to.stride + to.width]);
    }
}

/// Coordinates in the frame of coordinates in a level.
pub(super) fn frame_from_level(u: f32, level: usize) -> f32 {
    let scale = (1u32 << level) as f32;
    (u + 0.5) * scale - 0.5
}

/// Coordinates in a level of coordinates in the frame.
pub(super) fn level_from_frame(u: f32, level: usize) -> f32 {
    let scale = (1u32 << level) as f32;
    (u + 0.5) / scale - 0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_keeps_its_place() {
        let ramp = GrayImage::from_vec(64, 8, (0..512).map(|i| (i % 64 * 4) as u8).collect()).expect("size");
        let mut pyramid = Pyramid::default();
        pyramid.build(ramp.view(), 2, Simd::best());
        assert_eq!(pyramid.top(), 2);
        for n in 1..=2 {
            let level = pyramid.level(ramp.view(), n);
            for u in 0..level.width {
                let expected = 4.0 * frame_from_level(u as f32, n);
                assert!((f32::from(level.row(0)[u]) - expected).abs() <= 1.0);
                assert!((level_from_frame(frame_from_level(u as f32, n), n) - u as f32).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn tiny_images_have_no_levels() {
        for (width, height) in [(1, 1), (1, 90), (3, 3)] {
            let mut pyramid = Pyramid::default();
            pyramid.build(GrayImage::new(width, height).view(), 2, Simd::best());
            assert_eq!(pyramid.top(), 0);
        }
    }
}
