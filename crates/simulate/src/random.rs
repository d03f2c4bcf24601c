//! Seeded randomness: an independent stream for every purpose, and smooth random functions of time.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// One stream of random figures. Streams of one seed with different purposes are independent.
///
/// ```
/// use windhover_simulate::Stream;
///
/// let draw = |seed, number| Stream::new(seed, number).normal();
/// assert_eq!(draw(7, 1), draw(7, 1));
/// assert!(draw(7, 1) != draw(7, 2) && draw(7, 1) != draw(8, 1));
/// ```
#[derive(Clone, Debug)]
pub struct Stream(ChaCha8Rng);

/// What a stream is drawn for; its number selects the ChaCha stream.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u64)]
pub(super) enum Purpose {
    Wind = 1,
    Flight = 2,
    Gnss = 3,
    Compass = 4,
    Exposure = 5,
    Markers = 6,
    Features = 7,
    Scene = 8,
    GnssLine = 9,
    CompassLine = 10,
    GnssStamps = 11,
    Latency = 12,
    CompassSlow = 13,
    Trim = 14,
    Vibration = 15,
    Riders = 16,
    Lateness = 17,
    Vehicle = 100,
    Rough = 200,
    Company = 300,
}

impl Stream {
    /// Stream number `stream` of `seed`.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(stream);
        Self(rng)
    }

    pub(super) fn of(seed: u64, purpose: Purpose) -> Self {
        Self::new(seed, purpose as u64)
    }

    /// A standard normal figure.
    pub fn normal(&mut self) -> f64 {
        self.0.sample(StandardNormal)
    }

    /// Uniform in [low, high).
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.random::<f64>()
    }

    /// True with this probability. Always draws, so that one figure does not shift all later ones.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.0.random::<f64>() < probability
    }

    /// A raw 32-bit word.
    pub fn word(&mut self) -> u32 {
        self.0.random()
    }
}

/// Sines in one [`SmoothNoise`].
const TERMS: usize = 7;

/// A smooth random function of time: sines whose periods spread over a band, with random phases.
///
/// ```
/// use windhover_simulate::{SmoothNoise, Stream};
///
/// let sway = SmoothNoise::new(0.5, 1.0, 8.0, &mut Stream::new(7, 1));
/// let mean_square = (0..10_000).map(|k| sway.at(f64::from(k) * 0.1).powi(2)).sum::<f64>() / 10_000.0;
/// assert!((mean_square.sqrt() - 0.5).abs() < 0.05);
/// // The rate is the derivative.
/// let by_difference = (sway.at(3.0 + 1e-5) - sway.at(3.0 - 1e-5)) / 2e-5;
/// assert!((sway.rate(3.0) - by_difference).abs() < 1e-6);
/// ```
#[derive(Clone, Debug)]
pub struct SmoothNoise {
    amplitude: f64,
    terms: [(f64, f64); TERMS],
}

impl SmoothNoise {
    /// Root mean square `rms`, periods from `shortest_s` to `longest_s` (log-spaced, each moved at
    /// random within its share of the band).
    pub fn new(rms: f64, shortest_s: f64, longest_s: f64, stream: &mut Stream) -> Self {
        let ratio = (longest_s / shortest_s).ln();
        let terms = std::array::from_fn(|i| {
            let at = (i as f64 + stream.uniform(0.0, 1.0)) / TERMS as f64;
            let period_s = shortest_s * (ratio * at).exp();
            (std::f64::consts::TAU / period_s, stream.uniform(0.0, std::f64::consts::TAU))
        });
        Self { amplitude: rms * (2.0 / TERMS as f64).sqrt(), terms }
    }

    /// Its value at `t_s` seconds.
    pub fn at(&self, t_s: f64) -> f64 {
        self.amplitude * self.terms.iter().map(|(rate, phase)| (rate * t_s + phase).sin()).sum::<f64>()
    }

    /// Its derivative at `t_s` seconds, per second.
    pub fn rate(&self, t_s: f64) -> f64 {
        self.amplitude * self.terms.iter().map(|(rate, phase)| rate * (rate * t_s + phase).cos()).sum::<f64>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_are_repeatable_and_independent() {
        let draw = |seed, stream| {
            let mut s = Stream::new(seed, stream);
            std::array::from_fn::<f64, 4, _>(|_| s.normal())
        };
        assert_eq!(draw(7, 1), draw(7, 1));
        assert_ne!(draw(7, 1), draw(7, 2));
        assert_ne!(draw(7, 1), draw(8, 1));
    }

    #[test]
    fn wander_has_its_rms_and_its_derivative() {
        let wander = SmoothNoise::new(2.0, 3.0, 20.0, &mut Stream::new(1, 1));
        let n = 200_000;
        let mean_square = (0..n).map(|i| wander.at(f64::from(i) * 0.05).powi(2)).sum::<f64>() / f64::from(n);
        assert!((mean_square.sqrt() - 2.0).abs() < 0.1, "{}", mean_square.sqrt());
        let difference = (wander.at(4.0 + 1e-5) - wander.at(4.0 - 1e-5)) / 2e-5;
        assert!((difference - wander.rate(4.0)).abs() < 1e-6);
    }
}
