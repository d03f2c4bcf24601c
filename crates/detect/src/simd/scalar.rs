//! Scalar kernels: the definition of what the vector ones compute.

use super::TILE;

pub(super) fn halve_rows(above: &[u8], below: &[u8], to: &mut [u8]) {
    for ((to, a), b) in to.iter_mut().zip(above.chunks_exact(2)).zip(below.chunks_exact(2)) {
        let sum = u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]);
        *to = ((sum + 2) >> 2) as u8;
    }
}

/// Ninths as 15-bit fractions: exact to a hundredth of a grey level.
pub(super) const NINTH: i16 = 3641;

pub(super) fn two_thirds_rows(rows: [&[u8]; 3], to: [&mut [u8]; 2]) {
    let [first, second] = to;
    let count = (first.len() / 2).min(second.len() / 2).min(rows[0].len() / 3);
    let mean = |sum: u16| ((u32::from(sum) * NINTH as u32 + 0x4000) >> 15) as u8;
    for k in 0..count {
        let across = rows.map(|row| {
            let p: [u16; 3] = std::array::from_fn(|i| u16::from(row[3 * k + i]));
            [2 * p[0] + p[1], p[1] + 2 * p[2]]
        });
        for i in 0..2 {
            first[2 * k + i] = mean(2 * across[0][i] + across[1][i]);
            second[2 * k + i] = mean(across[1][i] + 2 * across[2][i]);
        }
    }
}

pub(super) fn tile_range(rows: [&[u8]; TILE], low: &mut [u8], high: &mut [u8]) {
    for (tile, (low, high)) in low.iter_mut().zip(high).enumerate() {
        let (mut least, mut most) = (u8::MAX, 0);
        for row in rows {
            for &p in &row[tile * TILE..row.len().min((tile + 1) * TILE)] {
                least = least.min(p);
                most = most.max(p);
            }
        }
        (*low, *high) = (least, most);
    }
}

pub(super) fn pack_below(row: &[u8], thresholds: &[u8], words: &mut [u64]) {
    for (word, pixels) in words.iter_mut().zip(row.chunks(64)).enumerate().map(|(i, p)| ((i, p.0), p.1)) {
        let (index, word) = word;
        let tiles = &thresholds[index * (64 / TILE)..];
        *word = pixels.iter().enumerate().fold(0, |bits, (u, &p)| bits | u64::from(p < tiles[u / TILE]) << u);
    }
}
