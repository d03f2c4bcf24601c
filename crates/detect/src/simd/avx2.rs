//! AVX2 kernels. The rest at the end of a row is computed by the scalar form.

use std::arch::x86_64::*;

use super::{Kernel, TILE, scalar};

/// # Safety
/// The processor must have AVX2, BMI1, BMI2 and POPCNT.
#[target_feature(enable = "avx2,bmi1,bmi2,popcnt")]
pub(super) unsafe fn run(kernel: impl Kernel) {
    kernel.run();
}

/// # Safety
/// The processor must have AVX2.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn halve_rows(above: &[u8], below: &[u8], to: &mut [u8]) {
    let blocks = to.len().min(above.len() / 2).min(below.len() / 2) / 32;
    let (ones, two) = (_mm256_set1_epi8(1), _mm256_set1_epi16(2));
    for block in 0..blocks {
        // SAFETY: `block < blocks` keeps 64 pixels of each row and 32 of `to` inside their slices.
        unsafe {
            let (a, b) = (above.as_ptr().add(block * 64), below.as_ptr().add(block * 64));
            let half = |offset: usize| {
                let a = _mm256_maddubs_epi16(_mm256_loadu_si256(a.add(offset).cast()), ones);
                let b = _mm256_maddubs_epi16(_mm256_loadu_si256(b.add(offset).cast()), ones);
                _mm256_srli_epi16(_mm256_add_epi16(_mm256_add_epi16(a, b), two), 2)
            };
            let packed = _mm256_permute4x64_epi64(_mm256_packus_epi16(half(0), half(32)), 0b11_01_10_00);
            _mm256_storeu_si256(to.as_mut_ptr().add(block * 32).cast(), packed);
        }
    }
    let done = blocks * 32;
    scalar::halve_rows(&above[done * 2..], &below[done * 2..], &mut to[done..]);
}

/// # Safety
/// The processor must have AVX2.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn two_thirds_rows(rows: [&[u8]; 3], to: [&mut [u8]; 2]) {
    let [first, second] = to;
    let width = rows.iter().map(|r| r.len()).min().unwrap_or(0);
    // A block is 24 pixels; its second load reaches four pixels beyond it.
    let blocks = (width.saturating_sub(4) / 24).min(first.len() / 16).min(second.len() / 16);
    // Pixels 0 1, 1 2 of every three as pairs, to be weighed 2 1, 1 2.
    let pairs = _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 1, 1, 2, 3, 4, 4, 5, 6, 7, 7, 8, 9, 10, 10, 11));
    let weights = _mm256_set1_epi32(0x0201_0102);
    let ninth = _mm256_set1_epi16(scalar::NINTH);
    for block in 0..blocks {
        // SAFETY: `block < blocks` keeps 28 pixels of each row and 16 of each output inside.
        unsafe {
            let across = |r: usize| {
                let at = rows[r].as_ptr().add(block * 24);
                let low = _mm256_castsi128_si256(_mm_loadu_si128(at.cast()));
                let both = _mm256_inserti128_si256(low, _mm_loadu_si128(at.add(12).cast()), 1);
                _mm256_maddubs_epi16(_mm256_shuffle_epi8(both, pairs), weights)
            };
            let (a, b, c) = (across(0), across(1), across(2));
            let above = _mm256_mulhrs_epi16(_mm256_add_epi16(_mm256_add_epi16(a, a), b), ninth);
            let below = _mm256_mulhrs_epi16(_mm256_add_epi16(_mm256_add_epi16(c, c), b), ninth);
            let packed = _mm256_permute4x64_epi64(_mm256_packus_epi16(above, below), 0b11_01_10_00);
            _mm_storeu_si128(first.as_mut_ptr().add(block * 16).cast(), _mm256_castsi256_si128(packed));
            _mm_storeu_si128(second.as_mut_ptr().add(block * 16).cast(), _mm256_extracti128_si256(packed, 1));
        }
    }
    let rest = rows.map(|r| &r[blocks * 24..]);
    scalar::two_thirds_rows(rest, [&mut first[blocks * 16..], &mut second[blocks * 16..]]);
}

/// # Safety
/// The processor must have AVX2.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn tile_range(rows: [&[u8]; TILE], low: &mut [u8], high: &mut [u8]) {
    let width = rows.iter().map(|r| r.len()).min().unwrap_or(0);
    let blocks = (width / 32).min(low.len() / 8).min(high.len() / 8);
    let byte = _mm256_set1_epi32(0xff);
    let order = _mm256_setr_epi32(0, 4, 0, 0, 0, 0, 0, 0);
    for block in 0..blocks {
        // SAFETY: `block < blocks` keeps 32 pixels of each row and 8 tiles of each output inside.
        unsafe {
            let load = |r: usize| _mm256_loadu_si256(rows[r].as_ptr().add(block * 32).cast());
            let (a, b, c, d) = (load(0), load(1), load(2), load(3));
            let mut least = _mm256_min_epu8(_mm256_min_epu8(a, b), _mm256_min_epu8(c, d));
            let mut most = _mm256_max_epu8(_mm256_max_epu8(a, b), _mm256_max_epu8(c, d));
            // The lowest byte of each 32-bit lane gathers the lane's extreme.
            least = _mm256_min_epu8(least, _mm256_srli_epi32(least, 16));
            least = _mm256_min_epu8(least, _mm256_srli_epi32(least, 8));
            most = _mm256_max_epu8(most, _mm256_srli_epi32(most, 16));
            most = _mm256_max_epu8(most, _mm256_srli_epi32(most, 8));
            let both = _mm256_packus_epi32(_mm256_and_si256(least, byte), _mm256_and_si256(most, byte));
            // Each half now holds four minima and four maxima as 16-bit values.
            let bytes = _mm256_packus_epi16(both, both);
            let joined = _mm256_permutevar8x32_epi32(bytes, order);
            let minima = _mm256_castsi256_si128(joined);
            let shifted = _mm256_permutevar8x32_epi32(bytes, _mm256_setr_epi32(1, 5, 0, 0, 0, 0, 0, 0));
            _mm_storel_epi64(low.as_mut_ptr().add(block * 8).cast(), minima);
            _mm_storel_epi64(high.as_mut_ptr().add(block * 8).cast(), _mm256_castsi256_si128(shifted));
        }
    }
    let done = blocks * 8;
    let rest = rows.map(|r| &r[done * TILE..]);
    scalar::tile_range(rest, &mut low[done..], &mut high[done..]);
}

/// # Safety
/// The processor must have AVX2.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn pack_below(row: &[u8], thresholds: &[u8], words: &mut [u64]) {
    let blocks = (row.len() / 64).min(thresholds.len() / 16).min(words.len());
    let spread = _mm256_setr_epi8(
        0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 6, 6, 6, 6, 7, 7, 7, 7,
    );
    for (block, word) in words.iter_mut().enumerate().take(blocks) {
        // SAFETY: `block < blocks` keeps 64 pixels and 16 thresholds inside their slices.
        let (first, second) = unsafe {
            let tiles = _mm_loadu_si128(thresholds.as_ptr().add(block * 16).cast());
            let pixels = row.as_ptr().add(block * 64);
            let not_below = |tiles: __m128i, at: *const u8| {
                let limit = _mm256_shuffle_epi8(_mm256_broadcastsi128_si256(tiles), spread);
                let p = _mm256_loadu_si256(at.cast());
                _mm256_movemask_epi8(_mm256_cmpeq_epi8(_mm256_max_epu8(p, limit), p)) as u32
            };
            (not_below(tiles, pixels), not_below(_mm_srli_si128(tiles, 8), pixels.add(32)))
        };
        *word = !(u64::from(first) | u64::from(second) << 32);
    }
    let rest = row.len().min(blocks * 64);
    scalar::pack_below(&row[rest..], &thresholds[blocks * 16..], &mut words[blocks..]);
}
