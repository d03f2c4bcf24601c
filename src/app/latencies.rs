//! Latency from exposure to estimate: of the last frames for the health line, of every frame for the last event of a
//! flight.

use std::collections::VecDeque;

use windhover_base::time::Span;

/// Ten seconds at thirty frames a second.
const KEPT: usize = 300;

/// The bounds of the classes in which all frames are counted grow by this factor from [`FIRST_MS`]: a quantile of the
/// whole flight is exact to two percent.
const GROWTH: f64 = 1.02;
const FIRST_MS: f64 = 0.05;
/// Up to some 20 s; longer latencies count in the last class.
const CLASSES: usize = 650;

/// Latencies of a flight's frames.
#[derive(Debug)]
pub struct Latencies {
    recent: VecDeque<Span>,
    classes: Vec<u64>,
    longest: Span,
}

/// The latencies of a whole flight.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct OfFlight {
    /// Frames counted.
    pub frames: u64,
    /// Median.
    pub p50: Span,
    /// 99th percentile.
    pub p99: Span,
    /// Maximum.
    pub longest: Span,
}

impl Default for Latencies {
    fn default() -> Self {
        Self { recent: VecDeque::with_capacity(KEPT), classes: vec![0; CLASSES], longest: Span::ZERO }
    }
}

impl Latencies {
    /// Adds a latency.
    pub fn push(&mut self, latency: Span) {
        if self.recent.len() == KEPT {
            self.recent.pop_front();
        }
        self.recent.push_back(latency);
        self.classes[class(latency)] += 1;
        self.longest = self.longest.max(latency);
    }

    /// The smallest latency that is not exceeded by the share `share` (0 to 1) of the last frames.
    pub fn quantile(&self, share: f64) -> Option<Span> {
        let mut sorted: Vec<Span> = self.recent.iter().copied().collect();
        sorted.sort_unstable();
        let rank = (share * sorted.len() as f64).ceil() as usize;
        sorted.get(rank.max(1) - 1).copied()
    }

    /// Over all frames so far; `None` before the first.
    pub fn of_flight(&self) -> Option<OfFlight> {
        let frames = self.classes.iter().sum();
        let at = |share| Some(self.upper(share, frames)?.min(self.longest));
        (frames > 0).then_some(())?;
        Some(OfFlight { frames, p50: at(0.5)?, p99: at(0.99)?, longest: self.longest })
    }

    /// Upper bound of the class in which the share `share` of all `frames` is reached.
    fn upper(&self, share: f64, frames: u64) -> Option<Span> {
        let rank = ((share * frames as f64).ceil() as u64).max(1);
        let mut so_far = 0;
        let reached = self.classes.iter().position(|&count| {
            so_far += count;
            so_far >= rank
        })?;
        Some(Span::from_ms(FIRST_MS * GROWTH.powi(reached as i32)))
    }
}

/// The first class whose upper bound is not below `latency`.
fn class(latency: Span) -> usize {
    let steps = (latency.ms().max(FIRST_MS) / FIRST_MS).ln() / GROWTH.ln();
    (steps.ceil() as usize).min(CLASSES - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_the_last_frames_are_ranks() {
        let mut latencies = Latencies::default();
        assert_eq!(latencies.quantile(0.5), None);
        for ms in 1..=100 {
            latencies.push(Span::from_ms(f64::from(ms)));
        }
        assert_eq!(latencies.quantile(0.5), Some(Span::from_ms(50.0)));
        assert_eq!(latencies.quantile(0.99), Some(Span::from_ms(99.0)));
        for _ in 0..KEPT {
            latencies.push(Span::from_ms(5.0));
        }
        assert_eq!(latencies.quantile(1.0), Some(Span::from_ms(5.0)));
    }

    #[test]
    fn the_whole_flight_is_known_to_two_percent() {
        let mut latencies = Latencies::default();
        assert_eq!(latencies.of_flight(), None);
        for n in 1..=10_000 {
            latencies.push(Span::from_ms(f64::from(n) * 0.01));
        }
        latencies.push(Span::from_s(60.0));
        let all = latencies.of_flight().expect("frames");
        assert_eq!((all.frames, all.longest), (10_001, Span::from_s(60.0)));
        for (reported, truth_ms) in [(all.p50, 50.0), (all.p99, 99.0)] {
            assert!((1.0..=GROWTH).contains(&(reported.ms() / truth_ms)), "{reported:?} for {truth_ms} ms");
        }
    }
}
