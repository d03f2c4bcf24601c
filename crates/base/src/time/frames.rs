//! Exposure times of a camera: its stamps, or where they jitter the steady beat behind them.

use super::jitter::Point;
use super::{MonoTime, Span, SteadyClock};

/// Variance of real exposure times about their beat, ms²: from automatic exposure and the sensor's own clock, 0.5 ms.
const REAL_MS2: f64 = 0.25;
/// Variance of stamps about their beat up to which all of it is taken as real, ms².
const GOOD_MS2: f64 = 0.5;
/// Variance about the line from which there is no beat, because no host stamps frames that badly, ms². The camera has a
/// variable frame rate (or is an emulated one), and its stamps are the only information.
const NO_BEAT_MS2: f64 = 400.0;
/// Stamps farther from the beat than this many sigmas are excluded.
const WILD: f64 = 3.0;
/// Fewest stamps that show a beat.
const FEWEST: f64 = 12.0;

/// Determines when frames were exposed.
///
/// A stamp made by the sensor is right although it is not exactly on the beat; a stamp made at the end of a USB
/// transfer jitters by milliseconds about it. The variance of the stamps about their beat (the straight line through
/// them) distinguishes the two: of a deviation `r`, with a variance `V` above `GOOD`, the share `REAL / (REAL + V −
/// GOOD)` is taken as real, which is its expectation where the rest is the stamp's error. Good stamps are returned
/// unchanged.
///
/// ```
/// use windhover_base::time::{FrameClock, MonoTime, Span};
///
/// // Good stamps are returned as they are.
/// let mut clock = FrameClock::default();
/// for k in 0..60 {
///     let stamp = MonoTime::from_ns(k * 66_666_667);
///     assert_eq!(clock.exposed(stamp, stamp + Span::from_ms(20.0)), stamp);
/// }
/// ```
#[derive(Clone, Debug, Default)]
pub struct FrameClock {
    beat: SteadyClock,
    last: Option<MonoTime>,
}

impl FrameClock {
    /// The exposure of the next frame, from its stamp and its reception; never later than the reception.
    pub fn exposed(&mut self, stamp: MonoTime, received: MonoTime) -> MonoTime {
        self.beat.smooth(stamp);
        let line = Line::through(self.beat.counted());
        let deviation = line.zip(self.beat.deviation_of(stamp));
        let error_ms = deviation.map_or(0.0, |(line, (t_s, ms))| line.stamp_error_ms((t_s, ms)));
        if error_ms == 0.0 {
            self.last = None;
            return stamp;
        }
        // Where a beat is followed, times do not go back.
        let exposed = (stamp - Span::from_ms(error_ms)).min(received.max(stamp));
        let exposed = self.last.map_or(exposed, |last| exposed.max(last));
        self.last = Some(exposed);
        exposed
    }
}

/// A straight line through stamps against their count, with the variance about it.
#[derive(Clone, Copy, Debug)]
struct Line {
    t_mean_s: f64,
    at_mean_ms: f64,
    slope: f64,
    variance_ms2: f64,
}

impl Line {
    /// A least-squares line, fitted again without outliers; `None` through too few points.
    fn through(points: impl Iterator<Item = Point> + Clone) -> Option<Self> {
        let all = Self::fitted(points.clone())?;
        let reach_ms = WILD * all.variance_ms2.sqrt();
        Self::fitted(points.filter(|point| all.off_ms(*point).abs() <= reach_ms))
    }

    fn fitted(points: impl Iterator<Item = Point> + Clone) -> Option<Self> {
        let n = points.clone().count() as f64;
        if n < FEWEST {
            return None;
        }
        let mean = |of: fn(Point) -> f64| points.clone().map(of).sum::<f64>() / n;
        let (t_mean_s, at_mean_ms) = (mean(|p| p.0), mean(|p| p.1));
        let sums = points.clone().fold((0.0, 0.0), |(tt, tx), (t, x)| {
            (tt + (t - t_mean_s).powi(2), tx + (t - t_mean_s) * (x - at_mean_ms))
        });
        let line = Self { t_mean_s, at_mean_ms, slope: sums.1 / sums.0.max(1e-9), variance_ms2: 0.0 };
        let squares: f64 = points.map(|point| line.off_ms(point).powi(2)).sum();
        Some(Self { variance_ms2: squares / (n - 2.0), ..line })
    }

    fn off_ms(&self, (t_s, ms): Point) -> f64 {
        ms - self.at_mean_ms - self.slope * (t_s - self.t_mean_s)
    }

    /// The expected error of a stamp, from its deviation; zero where stamps are good or have no beat.
    fn stamp_error_ms(&self, point: Point) -> f64 {
        if self.variance_ms2 > NO_BEAT_MS2 {
            return 0.0;
        }
        let excess = (self.variance_ms2 - GOOD_MS2).max(0.0);
        self.off_ms(point) * excess / (REAL_MS2 + excess)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    /// Errors in ms of the returned times for frames at 10 Hz whose exposures vary by 0.5 ms and whose stamps vary by
    /// `jitter_ms` in addition; one of fifty is lost.
    fn errors_ms(jitter_ms: f64, seed: u64) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || Distribution::<f64>::sample(&StandardNormal, &mut rng);
        let (mut clock, start) = (FrameClock::default(), MonoTime::from_ns(1 << 60));
        let mut errors = Vec::new();
        for frame in 0..300 {
            let exposed = start + Span::from_s(f64::from(frame) * 0.1) + Span::from_ms(0.5 * normal());
            let stamp = exposed + Span::from_ms(jitter_ms * normal());
            if frame % 50 != 7 {
                errors.push((clock.exposed(stamp, stamp + Span::from_ms(50.0)) - exposed).ms());
            }
        }
        errors
    }

    fn rms_about_mean(errors: &[f64]) -> f64 {
        let n = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / n;
        (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n).sqrt()
    }

    #[test]
    fn good_stamps_are_given_back_to_the_bit() {
        for seed in 0..8 {
            assert!(errors_ms(0.0, seed).iter().all(|e| *e == 0.0), "seed {seed}");
        }
    }

    #[test]
    fn jitter_is_taken_out() {
        for (jitter_ms, most_ms) in [(1.0, 0.75), (3.0, 0.9), (10.0, 2.2)] {
            for seed in 0..6 {
                let left_ms = rms_about_mean(&errors_ms(jitter_ms, seed)[60..]);
                assert!(left_ms < most_ms, "{jitter_ms} ms, seed {seed}: {left_ms} ms left");
            }
        }
    }

    #[test]
    fn time_does_not_run_backwards() {
        let mut clock = FrameClock::default();
        let mut last = MonoTime::default();
        for frame in 0..200_i64 {
            let late = if frame % 3 == 0 { 12.0 } else { 0.0 };
            let stamp = MonoTime::from_ns(1 << 60) + Span::from_ms(frame as f64 * 20.0 + late);
            let exposed = clock.exposed(stamp, stamp + Span::from_ms(5.0));
            // Once the beat is known.
            assert!(frame < 40 || exposed >= last, "frame {frame}");
            last = exposed;
        }
    }

    #[test]
    fn no_frame_is_later_than_it_was_received() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut clock = FrameClock::default();
        for frame in 0..400_i64 {
            let jitter_ms = 6.0 * Distribution::<f64>::sample(&StandardNormal, &mut rng);
            let stamp = MonoTime::from_ns(1 << 60) + Span::from_ms(frame as f64 * 33.3 + jitter_ms);
            let received = stamp + Span::from_ms(0.2);
            assert!(clock.exposed(stamp, received) <= received, "frame {frame}");
        }
    }

    #[test]
    fn frames_without_a_beat_keep_their_stamps() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let (mut clock, mut stamp) = (FrameClock::default(), MonoTime::from_ns(1 << 60));
        for frame in 0..400 {
            let apart_ms = 150.0 + 80.0 * Distribution::<f64>::sample(&StandardNormal, &mut rng);
            stamp += Span::from_ms(apart_ms.max(20.0));
            assert_eq!(clock.exposed(stamp, stamp), stamp, "frame {frame}");
        }
    }
}
