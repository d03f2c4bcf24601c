//! Box-averaged image pyramid: a first reduction by 3/2 or 2, then halvings.
//!
//! A pixel is the mean of the square of frame pixels it covers. With pixel centres at integers, a level of
//! scale `s` relates to the frame by `u_frame + ½ = s (u_level + ½)`.

use super::simd::Simd;
use windhover_base::msg::{GrayImage, ImageView};

/// How the first level is computed from the frame.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Base {
    /// It is the frame itself.
    Full,
    /// Three pixels become two.
    TwoThirds,
    /// Two pixels become one.
    Half,
}

/// Treatment of a last row or column that does not fill a pixel of the next level.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Rim {
    /// It is left out: all pixels are means of pixels of the frame.
    LeftOut,
    /// It is repeated: the whole frame is covered.
    Kept,
}

/// An image, and the number of frame pixels across one of its pixels.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Level<'a> {
    pub image: ImageView<'a>,
    pub scale: f32,
}

impl Level<'_> {
    /// Coordinates in this level of coordinates in the frame.
    pub fn of_frame(self, u: f32) -> f32 {
        (u + 0.5) / self.scale - 0.5
    }

    /// Coordinates in the frame of coordinates in this level.
    pub fn to_frame(self, u: f32) -> f32 {
        (u + 0.5) * self.scale - 0.5
    }
}

/// Levels below the frame itself, largest first; reuses its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Pyramid {
    levels: Vec<GrayImage>,
    scales: Vec<f32>,
}

/// Most levels: a cell of a tag as wide as the largest image is then a few pixels.
const MOST_LEVELS: usize = 8;

impl Pyramid {
    /// Builds as many levels as leave at least `least` pixels on the shorter side.
    pub fn build(&mut self, image: ImageView<'_>, base: Base, rim: Rim, least: usize, simd: Simd) {
        self.scales.clear();
        let mut scale = 1.0;
        let (mut width, mut height) = (image.width, image.height);
        for n in 0..MOST_LEVELS {
            let first_by_thirds = n == 0 && base == Base::TwoThirds;
            let (block, to) = if first_by_thirds { (3, 2) } else { (2, 1) };
            let reduced = |size: usize| match rim {
                Rim::LeftOut => size / block * to,
                Rim::Kept => size.div_ceil(block) * to,
            };
            if reduced(width).min(reduced(height)) < least.max(1) {
                break;
            }
            (width, height) = (reduced(width), reduced(height));
            scale *= if first_by_thirds { 1.5 } else { 2.0 };
            if self.levels.len() == n {
                self.levels.push(GrayImage::default());
            }
            let (below, rest) = self.levels.split_at_mut(n);
            let level = &mut rest[0];
            (level.width, level.height, level.stride) = (width, height, width);
            level.data.resize(width * height, 0);
            let below = below.last().map_or(image, |b| b.view());
            if first_by_thirds {
                two_thirds(below, level, simd);
            } else {
                halve(below, level, simd);
            }
            self.scales.push(scale);
        }
    }

    /// Number of levels, the frame included.
    pub fn len(&self) -> usize {
        self.scales.len() + 1
    }

    /// Level 0 is the frame.
    pub fn level<'a>(&'a self, image: ImageView<'a>, n: usize) -> Level<'a> {
        match n {
            0 => Level { image, scale: 1.0 },
            n => Level { image: self.levels[n - 1].view(), scale: self.scales[n - 1] },
        }
    }

    /// The coarsest level in which an object `size` frame pixels wide is still `least` pixels wide.
    pub fn for_size<'a>(&'a self, image: ImageView<'a>, size: f32, least: f32) -> Level<'a> {
        let n = self.scales.iter().take_while(|&&scale| size >= least * scale).count();
        self.level(image, n)
    }
}

/// Averages 2×2 blocks, halves rounded up; beyond an odd last row or column it is repeated.
fn halve(from: ImageView<'_>, to: &mut GrayImage, simd: Simd) {
    let width = to.width;
    for (v, row) in to.data.chunks_exact_mut(width).enumerate() {
        let rows = [2 * v, 2 * v + 1].map(|v| from.row(v.min(from.height - 1)));
        let whole = from.width / 2;
        simd.halve_rows(rows[0], rows[1], &mut row[..whole]);
        if whole < width {
            let [above, below] = rows.map(|row| [row[from.width - 1]; 2]);
            simd.halve_rows(&above, &below, &mut row[whole..]);
        }
    }
}

/// Averages blocks of 3/2×3/2; the last pixel is repeated where the frame does not fill a block on the right and below.
fn two_thirds(from: ImageView<'_>, to: &mut GrayImage, simd: Simd) {
    let (whole, width) = (from.width / 3, to.width);
    for (k, rows) in to.data.chunks_exact_mut(2 * width).enumerate() {
        let (first, second) = rows.split_at_mut(width);
        let rows = [3 * k, 3 * k + 1, 3 * k + 2].map(|v| from.row(v.min(from.height - 1)));
        simd.two_thirds_rows(rows, [&mut first[..2 * whole], &mut second[..2 * whole]]);
        if 2 * whole < width {
            let last = rows.map(|row| [0, 1, 2].map(|u| row[(3 * whole + u).min(from.width - 1)]));
            let last = last.each_ref().map(|row| &row[..]);
            simd.two_thirds_rows(last, [&mut first[2 * whole..], &mut second[2 * whole..]]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_keeps_its_place() {
        let ramp = GrayImage::from_vec(61, 13, (0..793).map(|i| (i % 61 * 4) as u8).collect()).expect("size");
        for (base, scales) in [
            (Base::Half, vec![1.0, 2.0, 4.0]),
            (Base::TwoThirds, vec![1.0, 1.5, 3.0]),
            (Base::Full, vec![1.0, 2.0, 4.0]),
        ] {
            let mut pyramid = Pyramid::default();
            pyramid.build(ramp.view(), base, Rim::Kept, 4, Simd::best());
            assert_eq!(
                (0..pyramid.len()).map(|n| pyramid.level(ramp.view(), n).scale).collect::<Vec<_>>(),
                scales
            );
            for n in 0..pyramid.len() {
                let level = pyramid.level(ramp.view(), n);
                for u in 0..level.image.width {
                    // Beyond the frame its last pixel is repeated.
                    let expected = (4.0 * level.to_frame(u as f32)).min(240.0);
                    assert!(
                        (f32::from(level.image.row(0)[u]) - expected).abs()
                            <= if u + 2 < level.image.width { 1.0 } else { 6.0 }
                    );
                    assert!((level.of_frame(level.to_frame(u as f32)) - u as f32).abs() < 1e-5);
                }
            }
        }
    }

    #[test]
    fn tiny_images_have_no_levels() {
        for (width, height) in [(1, 1), (1, 90), (3, 3)] {
            for base in [Base::Full, Base::TwoThirds, Base::Half] {
                let mut pyramid = Pyramid::default();
                pyramid.build(GrayImage::new(width, height).view(), base, Rim::Kept, 4, Simd::best());
                assert_eq!(pyramid.len(), 1);
            }
        }
    }
}
