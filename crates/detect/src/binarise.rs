//! Dark pixels: thresholds from the local range of 4×4 tiles, one bit a pixel.

use super::simd::{Kernel, Simd, TILE};
use windhover_base::msg::ImageView;

/// One bit a pixel, lowest first; set where the pixel is dark. Bits past the width are zero.
#[derive(Clone, Debug, Default)]
pub(super) struct Bitmap {
    pub width: usize,
    pub height: usize,
    words: Vec<u64>,
}

impl Bitmap {
    /// From one truth value a pixel.
    #[cfg(test)]
    pub fn from_pixels(width: usize, height: usize, dark: &[bool]) -> Self {
        let per_row = width.div_ceil(64);
        let mut words = vec![0; per_row * height];
        for (i, _) in dark.iter().enumerate().filter(|(_, d)| **d) {
            words[i / width * per_row + i % width / 64] |= 1 << (i % width % 64);
        }
        Self { width, height, words }
    }

    /// How many runs of dark pixels there are: what labelling takes time for.
    pub fn runs(&self) -> usize {
        let mut carry = 0;
        // A row ends with clear bits or with its last word: a run over two rows counts once, which is near enough.
        let starts = self.words.iter().map(|&word| {
            let starts = word & !(word << 1 | carry);
            carry = word >> 63;
            starts.count_ones() as usize
        });
        starts.sum()
    }

    /// The words of a row.
    pub fn row(&self, v: usize) -> &[u64] {
        let per_row = self.width.div_ceil(64);
        &self.words[v * per_row..(v + 1) * per_row]
    }
}

/// Range over maximum, of 256, that print in clear air keeps: ink is a fifth to a tenth as light as paper, and blur
/// takes some of that away, while most ground varies less. Haze, glare and thermal cameras leave less: see `AboveNoise`.
const CLEAR_RELATIVE: u8 = 70;

/// Where more of the image than `BUSY_SHARE` has that contrast, only what has most is looked at, but all that
/// has `ENOUGH_RELATIVE`: a tag that is read keeps it, and coarse gravel does not cost more than grass.
const ENOUGH_RELATIVE: u8 = 160;
const BUSY_SHARE: f32 = 0.3;

/// Share of an image that is looked at more closely because nowhere else there is as much contrast.
const STRONGEST_SHARE: f32 = 0.05;

/// And no fewer tiles than a tag of some fifty pixels of its level has, however small the image is.
const STRONGEST_TILES: u32 = 256;

/// Share of an image with the contrast of print in clear air below which weak contrast is what there is.
const HAZY_SHARE: f32 = 0.05;

/// Contrast of sharp print, of 256, which stones and their shadows seldom have, and how much of an image has it that
/// shows a sheet of print.
const PRINTED: u8 = 190;
const PRINTED_SHARE: f32 = 0.15;

/// Tiles on a side of the blocks whose light is compared, and by what factor it differs among a block and its
/// neighbours where a shadow ends.
const BLOCK: usize = 8;
const LIGHT_STEP: f32 = 1.5;

/// Thresholds an image against its surroundings, 12×12 pixels around each tile.
#[derive(Clone, Debug, Default)]
pub(super) struct Binariser {
    low: Vec<u8>,
    high: Vec<u8>,
    wide_low: Vec<u8>,
    wide_high: Vec<u8>,
    scratch: Vec<u8>,
    /// Range over maximum around every tile, of 256; nought below the gate.
    relative: Vec<u8>,
    /// The least of these that counts in this image.
    least_relative: u8,
    /// What the tiles of `STRONGEST_SHARE` have at least.
    strongest: u8,
    /// Shares of the tiles that are above the gate and have less than that, that have the contrast of clear air, and that
    /// of sharp print.
    dim_share: f32,
    clear_share: f32,
    printed_share: f32,
    thresholds: Vec<u8>,
    tiles: (usize, usize),
    /// Mean of the local maxima of each block of tiles.
    lights: Vec<f32>,
}

/// Where dark pixels are looked for.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Where {
    Everywhere,
    /// Where light and shade are near each other.
    LightChanges,
    /// In the part of the image that has most contrast.
    Strongest,
    /// Where there is any contrast above the gate.
    AboveNoise,
    /// Where something is as light as a pixel can be: what is lit more than that spreads over what is beside it.
    Saturated,
}

/// Lightest pixel of a neighbourhood from which it counts as saturated.
const SATURATED: u8 = 250;

impl Binariser {
    /// Measures the range around every tile of an image. Only ranges of at least the first of `gates` count, and in
    /// clear air of the second. Of a negative, contrast is that of the picture it was made from.
    pub fn measure(&mut self, image: ImageView<'_>, gates: (u8, u8), is_negative: bool, simd: Simd) {
        let (across, down) = (image.width.div_ceil(TILE), image.height.div_ceil(TILE));
        self.tiles = (across, down);
        let Self { low, high, wide_low, wide_high, relative, .. } = self;
        for buffer in [low, high, wide_low, wide_high, relative] {
            buffer.resize(across * down, 0);
        }
        for tile in 0..down {
            let row = |k: usize| image.row((tile * TILE + k).min(image.height - 1));
            let part = tile * across..(tile + 1) * across;
            simd.tile_range(
                [row(0), row(1), row(2), row(3)],
                &mut self.low[part.clone()],
                &mut self.high[part],
            );
        }
        widen(&self.low, &mut self.wide_low, &mut self.scratch, across, u8::min);
        widen(&self.high, &mut self.wide_high, &mut self.scratch, across, u8::max);
        self.weigh(gates, is_negative, simd);
    }

    /// Fills in `relative` and `least_relative`: see `BUSY_SHARE`.
    fn weigh(&mut self, gates: (u8, u8), is_negative: bool, simd: Simd) {
        let Self { wide_low: low, wide_high: high, relative: to, .. } = self;
        match is_negative {
            false => simd.run(Weigh::<false> { low, high, to, gates }),
            true => simd.run(Weigh::<true> { low, high, to, gates }),
        }
        let mut tiles = [0u32; 256];
        self.relative.iter().for_each(|&r| tiles[usize::from(r)] += 1);
        let from = |r: u8| tiles[usize::from(r)];
        let share = |share: f32| (share * self.wide_low.len() as f32) as u32;
        // The least contrast, `floor` or more, with which no more tiles than `budget` count; at most `least`.
        let of_tiles = |budget: u32, mut least: u8, floor: u8| {
            let mut passed = (least..=u8::MAX).map(from).sum::<u32>();
            while least > floor && passed + from(least - 1) <= budget {
                least -= 1;
                passed += from(least);
            }
            least
        };
        let least = of_tiles(share(BUSY_SHARE), ENOUGH_RELATIVE, CLEAR_RELATIVE);
        let strongest = of_tiles(share(STRONGEST_SHARE).max(STRONGEST_TILES), u8::MAX, least);
        let dim = tiles[1..usize::from(least)].iter().sum::<u32>();
        let clear = tiles[usize::from(CLEAR_RELATIVE)..].iter().sum::<u32>();
        [self.dim_share, self.clear_share] =
            [dim, clear].map(|count| count as f32 / self.wide_low.len() as f32);
        let printed = tiles[usize::from(PRINTED)..].iter().sum::<u32>();
        self.printed_share = printed as f32 / self.wide_low.len() as f32;
        (self.least_relative, self.strongest) = (least, strongest);
    }

    /// Share of the image with contrast above the gate that is not looked at everywhere.
    pub fn dim_share(&self) -> f32 {
        self.dim_share
    }

    /// Whether hardly any of the image has the contrast of clear air.
    pub fn is_hazy(&self) -> bool {
        self.clear_share < HAZY_SHARE
    }

    /// Whether much of the image has the contrast of sharp print: sheets of tags, that touch each other's corners, or
    /// coarse gravel in the sun.
    pub fn is_print(&self) -> bool {
        self.printed_share > PRINTED_SHARE
    }

    /// Whether a tile that is looked at has saturated pixels near.
    pub fn is_saturated(&self) -> bool {
        let is_any = self.wide_high.iter().fold(false, |any, &h| any | (h >= SATURATED));
        let mut tiles = self.wide_high.iter().zip(&self.relative);
        is_any && tiles.any(|(&h, &r)| h >= SATURATED && r >= self.least_relative)
    }

    /// Whether more of the image has all the contrast a tag has than can be looked at cheaply.
    pub fn is_busy(&self) -> bool {
        self.least_relative == ENOUGH_RELATIVE
    }

    /// Marks pixels below `fraction`/256 of the way from the local minimum to the local maximum, where
    /// the minimum is well below the maximum; elsewhere nothing is dark.
    pub fn mark(&mut self, image: ImageView<'_>, fraction: u16, at: Where, out: &mut Bitmap, simd: Simd) {
        let (across, down) = self.tiles;
        self.thresholds.resize(across * down, 0);
        let least = match at {
            Where::AboveNoise => 1,
            Where::Strongest => self.strongest,
            _ => self.least_relative,
        };
        let lightest = if at == Where::Saturated { SATURATED } else { 0 };
        let Self { wide_low: low, wide_high: high, relative, thresholds: to, .. } = self;
        simd.run(Divide { low, high, relative, to, fraction, least, lightest });
        if at == Where::LightChanges {
            self.clear_even_light();
        }
        let per_row = image.width.div_ceil(64);
        (out.width, out.height) = (image.width, image.height);
        out.words.resize(per_row * image.height, 0);
        let mut is_empty = true;
        for (v, words) in out.words.chunks_exact_mut(per_row).enumerate() {
            let tile = v / TILE;
            let thresholds = &self.thresholds[tile * across..(tile + 1) * across];
            if v % TILE == 0 {
                is_empty = thresholds.iter().fold(0, |any, t| any | t) == 0;
            }
            match is_empty {
                true => words.fill(0),
                false => simd.pack_below(image.row(v), thresholds, words),
            }
        }
    }

    /// Takes the thresholds away where the light of a block and its neighbours is much the same.
    fn clear_even_light(&mut self) {
        let (across, down) = self.tiles;
        let (wide, high) = (across.div_ceil(BLOCK), down.div_ceil(BLOCK));
        let span = |block: usize, tiles: usize| block * BLOCK..tiles.min((block + 1) * BLOCK);
        self.lights.clear();
        for (y, x) in (0..high).flat_map(|y| (0..wide).map(move |x| (y, x))) {
            let (rows, columns) = (span(y, down), span(x, across));
            let count = (rows.len() * columns.len()) as f32;
            let row = |v: usize| &self.wide_high[v * across..][columns.clone()];
            let sum: u32 = rows.flat_map(row).map(|&h| u32::from(h)).sum();
            self.lights.push(sum as f32 / count);
        }
        for (y, x) in (0..high).flat_map(|y| (0..wide).map(move |x| (y, x))) {
            let (mut least, mut most) = (f32::MAX, 0.0f32);
            for v in y.saturating_sub(1)..(y + 2).min(high) {
                for &light in &self.lights[v * wide + x.saturating_sub(1)..v * wide + (x + 2).min(wide)] {
                    (least, most) = (least.min(light), most.max(light));
                }
            }
            if most < LIGHT_STEP * least {
                let columns = span(x, across);
                span(y, down).for_each(|v| self.thresholds[v * across..][columns.clone()].fill(0));
            }
        }
    }
}

/// Thresholds of tiles, nought where nothing is dark.
struct Divide<'a> {
    low: &'a [u8],
    high: &'a [u8],
    relative: &'a [u8],
    to: &'a mut [u8],
    fraction: u16,
    least: u8,
    lightest: u8,
}

impl Kernel for Divide<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { low, high, relative, to, fraction, least, lightest } = self;
        let count = to.len();
        let (low, high, relative) = (&low[..count], &high[..count], &relative[..count]);
        for t in 0..count {
            let above =
                (u16::from(high[t].wrapping_sub(low[t])).wrapping_mul(fraction).wrapping_add(128)) >> 8;
            let threshold = low[t].wrapping_add(above as u8);
            to[t] = if (relative[t] >= least) & (high[t] >= lightest) { threshold } else { 0 };
        }
    }
}

/// Contrasts of tiles: ranges over what is lightest, of 255. Of a negative that is what is darkest in it.
struct Weigh<'a, const NEGATIVE: bool> {
    low: &'a [u8],
    high: &'a [u8],
    to: &'a mut [u8],
    gates: (u8, u8),
}

impl<const NEGATIVE: bool> Kernel for Weigh<'_, NEGATIVE> {
    #[inline(always)]
    fn run(self) {
        let Self { low, high, to, gates: (gate, clear_gate) } = self;
        let count = to.len();
        let (low, high) = (&low[..count], &high[..count]);
        for t in 0..count {
            let range = high[t].wrapping_sub(low[t]);
            let contrast = relative(range, if NEGATIVE { !low[t] } else { high[t] });
            let dim = if range >= gate { 1 } else { 0 };
            to[t] = if range >= clear_gate { contrast } else { dim };
        }
    }
}

/// Added to a number from −2²² to 2²², it leaves the nearest whole number in the low bits.
const WHOLE: f32 = 12_582_912.0;

/// Range over maximum, of 255, rounded down: quotients by at most 255 end in nothing between 254/255 and 1.
#[inline(always)]
fn relative(range: u8, high: u8) -> u8 {
    let high = if high > 0 { high } else { 1 };
    (255.0 * f32::from(range) / f32::from(high) - 0.498 + WHOLE).to_bits() as u8
}

/// Extreme over 3×3 tiles.
fn widen(from: &[u8], to: &mut [u8], scratch: &mut Vec<u8>, across: usize, pick: impl Fn(u8, u8) -> u8) {
    let down = from.len() / across;
    scratch.resize(across, 0);
    for tile in 0..down {
        let row = |t: usize| &from[t * across..(t + 1) * across];
        let (above, here, below) = (row(tile.saturating_sub(1)), row(tile), row((tile + 1).min(down - 1)));
        for (((s, &a), &b), &c) in scratch.iter_mut().zip(above).zip(here).zip(below) {
            *s = pick(pick(a, b), c);
        }
        let to = &mut to[tile * across..(tile + 1) * across];
        to[0] = pick(scratch[0], scratch[1.min(across - 1)]);
        to[across - 1] = pick(scratch[across - 1], scratch[across.saturating_sub(2)]);
        if across > 2 {
            for (t, s) in to[1..across - 1].iter_mut().zip(scratch.windows(3)) {
                *t = pick(pick(s[0], s[1]), s[2]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::msg::GrayImage;

    #[test]
    fn a_dark_square_on_light_ground_is_marked() {
        let mut image = GrayImage::from_vec(40, 30, vec![200; 1200]).expect("size");
        for v in 10..18 {
            (12..22).for_each(|u| image.data[v * 40 + u] = 20);
        }
        let (mut binariser, mut bits) = (Binariser::default(), Bitmap::default());
        binariser.measure(image.view(), (30, 30), false, Simd::best());
        binariser.mark(image.view(), 128, Where::Everywhere, &mut bits, Simd::best());
        for v in 0..30 {
            for u in 0..40 {
                let dark = bits.row(v)[u / 64] >> (u % 64) & 1 == 1;
                assert_eq!(dark, image.data[v * 40 + u] == 20, "({u}, {v})");
            }
        }
        binariser.measure(image.view(), (190, 190), false, Simd::best());
        binariser.mark(image.view(), 128, Where::Everywhere, &mut bits, Simd::best());
        assert!((0..30).all(|v| bits.row(v)[0] == 0), "a gate above the contrast leaves nothing");
    }

    #[test]
    fn low_divisions_look_where_light_changes() {
        // A chequer of three pixels, the right half in shadow: all of it has all the contrast a tag has.
        let light = |u: usize, v: usize| match (u / 3 + v / 3) % 2 {
            0 => 20,
            _ if u < 160 => 200,
            _ => 100,
        };
        let pixels = (0..320 * 128).map(|i| light(i % 320, i / 320)).collect();
        let image = GrayImage::from_vec(320, 128, pixels).expect("size");
        let (mut binariser, mut bits) = (Binariser::default(), Bitmap::default());
        binariser.measure(image.view(), (30, 30), false, Simd::best());
        assert!(binariser.is_busy());
        let marked = |bits: &Bitmap| -> Vec<bool> {
            (0..5).map(|word| (0..128).any(|v| bits.row(v)[word] != 0)).collect()
        };
        binariser.mark(image.view(), 72, Where::Everywhere, &mut bits, Simd::best());
        assert_eq!(marked(&bits), [true; 5]);
        binariser.mark(image.view(), 72, Where::LightChanges, &mut bits, Simd::best());
        assert_eq!(marked(&bits), [false, false, true, false, false], "only about the shadow's edge");
    }

    #[test]
    fn contrasts_are_exact() {
        for high in 1..=255u8 {
            for range in 0..=high {
                assert_eq!(u32::from(relative(range, high)), u32::from(range) * 255 / u32::from(high));
            }
        }
    }
}
