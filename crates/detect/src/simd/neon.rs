//! NEON kernels. The rest at the end of a row is computed by the scalar form.

use std::arch::aarch64::*;

use super::{TILE, scalar};

/// # Safety
/// The processor must have NEON.
#[target_feature(enable = "neon")]
pub(super) unsafe fn halve_rows(above: &[u8], below: &[u8], to: &mut [u8]) {
    let blocks = to.len().min(above.len() / 2).min(below.len() / 2) / 8;
    for block in 0..blocks {
        // SAFETY: `block < blocks` keeps 16 pixels of each row and 8 of `to` inside their slices.
        unsafe {
            let pairs = |row: &[u8]| vpaddlq_u8(vld1q_u8(row.as_ptr().add(block * 16)));
            let sum = vaddq_u16(pairs(above), pairs(below));
            vst1_u8(to.as_mut_ptr().add(block * 8), vrshrn_n_u16::<2>(sum));
        }
    }
    let done = blocks * 8;
    scalar::halve_rows(&above[done * 2..], &below[done * 2..], &mut to[done..]);
}

/// # Safety
/// The processor must have NEON.
#[target_feature(enable = "neon")]
pub(super) unsafe fn two_thirds_rows(rows: [&[u8]; 3], to: [&mut [u8]; 2]) {
    let [first, second] = to;
    let width = rows.iter().map(|r| r.len()).min().unwrap_or(0);
    let blocks = (width / 24).min(first.len() / 16).min(second.len() / 16);
    for block in 0..blocks {
        // SAFETY: `block < blocks` keeps 24 pixels of each row and 16 of each output inside.
        unsafe {
            // First, second and third pixels of every three, to be weighed 2 1, 1 2.
            let across = |r: usize| {
                let p = vld3_u8(rows[r].as_ptr().add(block * 24));
                [vaddw_u8(vshll_n_u8::<1>(p.0), p.1), vaddw_u8(vshll_n_u8::<1>(p.2), p.1)]
            };
            let (a, b, c) = (across(0), across(1), across(2));
            // (2 · sum · ninth + 2¹⁵) / 2¹⁶.
            let mean = |outer: uint16x8_t, inner: uint16x8_t| {
                let sum = vaddq_u16(vaddq_u16(outer, outer), inner);
                vqmovun_s16(vqrdmulhq_n_s16(vreinterpretq_s16_u16(sum), scalar::NINTH))
            };
            let above = uint8x8x2_t(mean(a[0], b[0]), mean(a[1], b[1]));
            let below = uint8x8x2_t(mean(c[0], b[0]), mean(c[1], b[1]));
            vst2_u8(first.as_mut_ptr().add(block * 16), above);
            vst2_u8(second.as_mut_ptr().add(block * 16), below);
        }
    }
    let rest = rows.map(|r| &r[blocks * 24..]);
    scalar::two_thirds_rows(rest, [&mut first[blocks * 16..], &mut second[blocks * 16..]]);
}

/// # Safety
/// The processor must have NEON.
#[target_feature(enable = "neon")]
pub(super) unsafe fn tile_range(rows: [&[u8]; TILE], low: &mut [u8], high: &mut [u8]) {
    let width = rows.iter().map(|r| r.len()).min().unwrap_or(0);
    let blocks = (width / 64).min(low.len() / 16).min(high.len() / 16);
    for block in 0..blocks {
        // SAFETY: `block < blocks` keeps 64 pixels of each row and 16 tiles of each output inside.
        unsafe {
            let columns = |part: usize| {
                let load = |r: usize| vld1q_u8(rows[r].as_ptr().add(block * 64 + part * 16));
                let (a, b, c, d) = (load(0), load(1), load(2), load(3));
                [vminq_u8(vminq_u8(a, b), vminq_u8(c, d)), vmaxq_u8(vmaxq_u8(a, b), vmaxq_u8(c, d))]
            };
            let (a, b, c, d) = (columns(0), columns(1), columns(2), columns(3));
            // Extremes of neighbours, twice: of every four.
            let least = vpminq_u8(vpminq_u8(a[0], b[0]), vpminq_u8(c[0], d[0]));
            let most = vpmaxq_u8(vpmaxq_u8(a[1], b[1]), vpmaxq_u8(c[1], d[1]));
            vst1q_u8(low.as_mut_ptr().add(block * 16), least);
            vst1q_u8(high.as_mut_ptr().add(block * 16), most);
        }
    }
    let done = blocks * 16;
    let rest = rows.map(|r| &r[done * TILE..]);
    scalar::tile_range(rest, &mut low[done..], &mut high[done..]);
}

/// Tile of each of 16 pixels.
const SPREAD: [u8; 16] = [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3];

/// Bit of each of 16 pixels in its byte.
const BITS: [u8; 16] = [1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128];

/// # Safety
/// The processor must have NEON.
#[target_feature(enable = "neon")]
pub(super) unsafe fn pack_below(row: &[u8], thresholds: &[u8], words: &mut [u64]) {
    let blocks = (row.len() / 64).min(thresholds.len() / 16).min(words.len());
    // SAFETY: both tables have 16 bytes.
    let (spread, bits) = unsafe { (vld1q_u8(SPREAD.as_ptr()), vld1q_u8(BITS.as_ptr())) };
    for (block, word) in words.iter_mut().enumerate().take(blocks) {
        // SAFETY: `block < blocks` keeps 64 pixels and 16 thresholds inside their slices.
        unsafe {
            let tiles = vld1q_u8(thresholds.as_ptr().add(block * 16));
            let below = |part: u8| {
                let limit = vqtbl1q_u8(tiles, vaddq_u8(spread, vdupq_n_u8(4 * part)));
                let pixels = vld1q_u8(row.as_ptr().add(block * 64 + 16 * usize::from(part)));
                vandq_u8(vcltq_u8(pixels, limit), bits)
            };
            // Sums of neighbours, three times: a byte of eight pixels.
            let both = vpaddq_u8(vpaddq_u8(below(0), below(1)), vpaddq_u8(below(2), below(3)));
            *word = vgetq_lane_u64::<0>(vreinterpretq_u64_u8(vpaddq_u8(both, both)));
        }
    }
    let rest = row.len().min(blocks * 64);
    scalar::pack_below(&row[rest..], &thresholds[blocks * 16..], &mut words[blocks..]);
}
