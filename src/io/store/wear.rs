//! What recording means for the life of a flash card.

/// What a card takes before its cells wear out.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Life {
    /// Erase cycles of its cells.
    pub cycles: f64,
    /// Hours of recording until then.
    pub hours: f64,
}

/// Hours of recording until a card of `capacity` bytes has erased every cell `cycles` times, where
/// `rate` bytes of data are recorded a second and the card writes `amplification` bytes for each:
/// `t = capacity · cycles / (rate · amplification)`. Wear levelling is taken as perfect; the card's
/// own amplification comes on top and is its maker's to tell.
pub fn life(capacity: u64, cycles: f64, rate: f64, amplification: f64) -> Option<Life> {
    let wear = rate * amplification;
    (wear > 0.0).then(|| Life { cycles, hours: capacity as f64 * cycles / wear / 3600.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_card_lives_its_bytes() {
        let life = life(4 << 30, 10_000.0, (4u64 << 30) as f64 / 3600.0, 1.0).expect("something is written");
        assert!((life.hours - 10_000.0).abs() < 1e-6);
        assert!(super::life(4 << 30, 10_000.0, 0.0, 1.1).is_none());
    }
}
