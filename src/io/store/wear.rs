//! The effect of recording on the life of a flash card.

/// What a card can write before its cells wear out.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Life {
    /// Erase cycles of its cells.
    pub cycles: f64,
    /// Hours of recording until then.
    pub hours: f64,
}

/// Bytes that a second of recording writes in addition to the segments: file system journal, inode and index for one
/// commit. Measured on ext4: 67 kB with frames, 69 kB without (docs/storage.md).
pub const OVERHEAD_BYTES_PER_S: f64 = 70_000.0;

/// Hours of recording until a card of `capacity` bytes has erased every cell `cycles` times, where segments grow by
/// `rate` bytes a second: `t = capacity · cycles / (rate + overhead)`. Wear levelling is assumed to be perfect. The
/// card's own controller writes more than that (write amplification), which only its manufacturer knows.
pub fn life(capacity: u64, cycles: f64, rate: f64) -> Life {
    Life { cycles, hours: capacity as f64 * cycles / (rate + OVERHEAD_BYTES_PER_S) / 3600.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_card_lives_its_bytes() {
        let rate = (4u64 << 30) as f64 / 3600.0 - OVERHEAD_BYTES_PER_S;
        assert!((life(4 << 30, 10_000.0, rate).hours - 10_000.0).abs() < 1e-6, "one filling an hour");
    }
}
