//! Pixel kernels: one scalar form of each, and the same result from vector instructions.
//!
//! All kernels are integer and exact, so that every machine finds the same tags. The choice is made
//! once, at run time.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "aarch64")]
mod neon;
mod scalar;

/// Which kernels to use.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Simd(Kind);

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Kind {
    Scalar,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "aarch64")]
    Neon,
}

/// Plain code that gains from being compiled for what the processor has; it must be `#[inline(always)]`.
/// Floating-point operations are never fused, so that the result is the same.
pub(super) trait Kernel {
    /// Does the work.
    fn run(self);
}

/// Pixels on a side of a tile.
pub(super) const TILE: usize = 4;

impl Simd {
    /// The best this processor has.
    pub fn best() -> Self {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2")
            && std::arch::is_x86_feature_detected!("bmi1")
            && std::arch::is_x86_feature_detected!("bmi2")
            && std::arch::is_x86_feature_detected!("popcnt")
        {
            return Self(Kind::Avx2);
        }
        #[cfg(target_arch = "aarch64")]
        if std::arch::is_aarch64_feature_detected!("neon") {
            return Self(Kind::Neon);
        }
        Self(Kind::Scalar)
    }

    /// Plain code, for comparison.
    pub fn scalar() -> Self {
        Self(Kind::Scalar)
    }

    /// Runs plain code compiled for this processor.
    #[inline]
    pub(super) fn run(self, kernel: impl Kernel) {
        match self.0 {
            Kind::Scalar => kernel.run(),
            // SAFETY: `best` made this variant only where the processor has these.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { avx2::run(kernel) },
            // On aarch64 the default target has NEON.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => kernel.run(),
        }
    }

    /// `to[u]` = mean of the 2×2 block at `2u`, halves rounded up.
    pub(super) fn halve_rows(self, above: &[u8], below: &[u8], to: &mut [u8]) {
        match self.0 {
            Kind::Scalar => scalar::halve_rows(above, below, to),
            // SAFETY: `best` made this variant only where the processor has AVX2.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { avx2::halve_rows(above, below, to) },
            // SAFETY: `best` made this variant only where the processor has NEON.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { neon::halve_rows(above, below, to) },
        }
    }

    /// Three rows to two, three pixels to two: `to[0][2k]` = the mean of the first one and a half pixels
    /// of the first one and a half rows from `3k` on, and so forth, rounded.
    pub(super) fn two_thirds_rows(self, rows: [&[u8]; 3], to: [&mut [u8]; 2]) {
        match self.0 {
            Kind::Scalar => scalar::two_thirds_rows(rows, to),
            // SAFETY: `best` made this variant only where the processor has AVX2.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { avx2::two_thirds_rows(rows, to) },
            // SAFETY: `best` made this variant only where the processor has NEON.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { neon::two_thirds_rows(rows, to) },
        }
    }

    /// Smallest and largest pixel of each 4-pixel-wide tile of four rows of one length; the last tile
    /// may be narrower. `low` and `high` have a place for every tile.
    pub(super) fn tile_range(self, rows: [&[u8]; TILE], low: &mut [u8], high: &mut [u8]) {
        match self.0 {
            Kind::Scalar => scalar::tile_range(rows, low, high),
            // SAFETY: `best` made this variant only where the processor has AVX2.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { avx2::tile_range(rows, low, high) },
            // SAFETY: `best` made this variant only where the processor has NEON.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { neon::tile_range(rows, low, high) },
        }
    }

    /// Bit `u` of `words`, lowest first, is set if pixel `u` is below its tile's threshold.
    pub(super) fn pack_below(self, row: &[u8], thresholds: &[u8], words: &mut [u64]) {
        match self.0 {
            Kind::Scalar => scalar::pack_below(row, thresholds, words),
            // SAFETY: `best` made this variant only where the processor has AVX2.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { avx2::pack_below(row, thresholds, words) },
            // SAFETY: `best` made this variant only where the processor has NEON.
            #[cfg(target_arch = "aarch64")]
            Kind::Neon => unsafe { neon::pack_below(row, thresholds, words) },
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn vector_kernels_equal_their_scalar_twins(
            pixels in prop::collection::vec(any::<u8>(), 4..1200), seed in any::<u8>()
        ) {
            let width = pixels.len() / 4;
            let row = |v: usize| &pixels[v * width..(v + 1) * width];
            let (a, b) = (Simd::best(), Simd::scalar());
            let half = |s: Simd| {
                let mut to = vec![0; width / 2];
                s.halve_rows(row(0), row(1), &mut to);
                to
            };
            prop_assert_eq!(half(a), half(b));
            let shrunk = |s: Simd| {
                let (mut a, mut b) = (vec![0; width / 3 * 2], vec![0; width / 3 * 2]);
                s.two_thirds_rows([row(0), row(1), row(2)], [&mut a, &mut b]);
                (a, b)
            };
            prop_assert_eq!(shrunk(a), shrunk(b));
            let tiles = width.div_ceil(TILE);
            let range = |s: Simd| {
                let (mut low, mut high) = (vec![0; tiles], vec![0; tiles]);
                s.tile_range([row(0), row(1), row(2), row(3)], &mut low, &mut high);
                (low, high)
            };
            prop_assert_eq!(range(a), range(b));
            let thresholds: Vec<u8> = (0..tiles).map(|i| (i as u8).wrapping_mul(37) ^ seed).collect();
            let pack = |s: Simd| {
                let mut words = vec![u64::MAX; width.div_ceil(64)];
                s.pack_below(row(2), &thresholds, &mut words);
                words
            };
            prop_assert_eq!(pack(a), pack(b));
        }
    }
}
