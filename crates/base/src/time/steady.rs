//! Arrivals of a device that measures at a steady rate, with the jitter taken out.

use std::collections::VecDeque;
use std::f64::consts::TAU;

use super::jitter::{JitterFit, Point};
use super::{MonoTime, Span};

/// Samples the line is fitted over: a few seconds of a compass.
const WINDOW_MAX: usize = 128;
/// Arrivals the rate is learnt from.
const RECENT: usize = 24;
/// Every so many samples the rate is looked at again.
const CHECK_EVERY: u32 = 12;
/// One-sigma of the period learnt so, milliseconds a second.
const PERIOD_SIGMA: f64 = 10.0;
/// Periods a clock can smooth, seconds.
const PERIODS_S: (f64, f64) = (0.001, 10.0);
/// Least coherence (1: no jitter at all, 0: no rate at all) that is taken for a rate.
const COHERENCE_MIN: f64 = 0.4;
/// Part of the best coherence below which the period in use is given up.
const COHERENCE_KEPT: f64 = 0.6;

/// Most of a period that expected lateness moves the limit between one count and the next.
const LATE_PART: f64 = 0.3;

/// Takes the jitter out of the arrivals of a device with a steady rate.
///
/// The rate need not be known: it is the one at which the recent arrivals are most coherent. Samples
/// may be missing; a device that changes its rate is followed. While there is no steady rate the
/// arrivals are given back as they are.
#[derive(Clone, Debug)]
pub struct SteadyClock {
    fit: JitterFit,
    reference: MonoTime,
    /// Period the samples are counted with, seconds.
    period_s: Option<f64>,
    /// Count of the last sample.
    index: i64,
    points: VecDeque<Point>,
    recent: VecDeque<MonoTime>,
    since_check: u32,
    last: Option<MonoTime>,
}

impl Default for SteadyClock {
    fn default() -> Self {
        Self::new()
    }
}

impl SteadyClock {
    /// A clock of a rate yet unknown.
    pub fn new() -> Self {
        Self {
            fit: JitterFit::new(PERIOD_SIGMA),
            reference: MonoTime::default(),
            period_s: None,
            index: 0,
            points: VecDeque::with_capacity(WINDOW_MAX),
            recent: VecDeque::with_capacity(RECENT),
            since_check: 0,
            last: None,
        }
    }

    /// The arrival of the next sample without its jitter. Never before the one given last, never
    /// more than a period from the arrival.
    pub fn smooth(&mut self, arrival: MonoTime) -> MonoTime {
        if self.recent.back().is_some_and(|last| arrival < *last) {
            // Host time does not run backwards; something else is wrong here.
            self.forget();
        }
        if self.recent.len() == RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(arrival);
        self.check_rate();
        let smoothed = self.period_s.map_or(arrival, |period_s| self.place(arrival, period_s));
        let smoothed = self.last.map_or(smoothed, |last| smoothed.max(last));
        self.last = Some(smoothed);
        smoothed
    }

    /// The period, once known.
    pub fn period(&self) -> Option<Span> {
        self.period_s.map(|period_s| Span::from_s(self.true_period_s(period_s)))
    }

    /// One-sigma of what [`Self::smooth`] gave last; `None` while the rate is not known.
    pub fn sigma(&self) -> Option<Span> {
        let period_s = self.period_s?;
        Some(Span::from_ms(self.fit.at(self.index as f64 * period_s).1))
    }

    /// The arrivals that the line is fitted over, the last one last: time of the count, s, and arrival against it, ms. None
    /// while the rate is not known.
    pub(super) fn counted(&self) -> impl DoubleEndedIterator<Item = Point> + Clone + '_ {
        self.points.iter().copied()
    }

    /// Where among [`Self::counted`] this arrival is; `None` where it was not counted.
    pub(super) fn deviation_of(&self, arrival: MonoTime) -> Option<Point> {
        let since_s = (arrival - self.reference).s();
        let last = self.points.back()?;
        self.period_s.map(|_| *last).filter(|(t_s, ms)| ((since_s - t_s) * 1e3 - ms).abs() < 1e-6)
    }

    fn forget(&mut self) {
        self.period_s = None;
        self.recent.clear();
        self.points.clear();
        self.since_check = 0;
        self.last = None;
    }

    /// The period samples are counted with, put right by the slope of the line.
    fn true_period_s(&self, period_s: f64) -> f64 {
        period_s * (1.0 + self.fit.slope() * 1e-3)
    }

    /// Learns the rate, or gives up one that no longer holds.
    fn check_rate(&mut self) {
        self.since_check += 1;
        if self.recent.len() < RECENT || self.since_check < CHECK_EVERY {
            return;
        }
        self.since_check = 0;
        let times: Vec<f64> = self.recent.iter().map(|t| (*t - self.recent[0]).s()).collect();
        let Some((best_s, best)) = most_coherent_period(&times) else {
            return;
        };
        if let Some(period_s) = self.period_s {
            let kept = coherence(&times, self.true_period_s(period_s)).0;
            if kept >= COHERENCE_KEPT * best {
                return;
            }
            self.period_s = None;
        }
        if best >= COHERENCE_MIN {
            self.begin(&times, best_s);
        }
    }

    /// Counts the recent samples with a new period and fits the line to them; the last is left to
    /// be placed.
    fn begin(&mut self, times: &[f64], period_s: f64) {
        let phase = coherence(times, period_s).1;
        self.fit = JitterFit::new(PERIOD_SIGMA);
        self.reference = self.recent[0];
        self.period_s = Some(period_s);
        self.points.clear();
        self.index = i64::MIN;
        for &time in &times[..times.len() - 1] {
            let index = ((time / period_s) - phase).round() as i64;
            if index > self.index {
                self.index = index;
                self.points.push_back(point(time, index, period_s));
            }
        }
        self.fit.fit(self.points.make_contiguous());
    }

    fn place(&mut self, arrival: MonoTime, period_s: f64) -> MonoTime {
        let since = (arrival - self.reference).s();
        let t_last = self.index as f64 * period_s;
        let on_line = t_last + self.fit.at(t_last).0 * 1e-3;
        let true_period_s = self.true_period_s(period_s);
        // Where arrivals are only ever late, more than half a period of lateness is to be told apart.
        let late = (self.fit.jitter_ms().1 * 1e-3 / true_period_s).min(LATE_PART);
        let steps = ((since - on_line) / true_period_s - late).round();
        if !(1.0..1e9).contains(&steps) {
            // Two in the place of one: the one before was too late to be told from this one.
            return self.reference + Span::from_s(on_line);
        }
        self.index += steps as i64;
        let point = point(since, self.index, period_s);
        self.points.push_back(point);
        if self.points.len() > WINDOW_MAX {
            self.points.pop_front();
        }
        self.fit.fit(self.points.make_contiguous());
        let on_line = point.0 + self.fit.at(point.0).0 * 1e-3;
        self.reference + Span::from_s(on_line.clamp(since - true_period_s, since + true_period_s))
    }
}

/// Time of the count in seconds, arrival against it in milliseconds.
fn point(since_s: f64, index: i64, period_s: f64) -> Point {
    let t = index as f64 * period_s;
    (t, (since_s - t) * 1e3)
}

/// How well times fall on one phase of a period: |mean of exp(2πi t/P)|, and that phase in turns.
fn coherence(times: &[f64], period_s: f64) -> (f64, f64) {
    let (sin, cos) = times.iter().fold((0.0, 0.0), |(sin, cos), time| {
        let (s, c) = (TAU * time / period_s).sin_cos();
        (sin + s, cos + c)
    });
    (f64::hypot(sin, cos) / times.len() as f64, sin.atan2(cos) / TAU)
}

/// The period near the median interval at which the times are most coherent, and how much.
fn most_coherent_period(times: &[f64]) -> Option<(f64, f64)> {
    let mut intervals: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    intervals.sort_by(f64::total_cmp);
    let median = *intervals.get(intervals.len() / 2)?;
    let length = times.last()? - times.first()?;
    if !(PERIODS_S.0..=PERIODS_S.1).contains(&median) {
        return None;
    }
    // Frequencies a tenth of the resolution 1/T apart, from a third below to a third above.
    let (low, high) = (0.75 / median, 1.35 / median);
    let count = ((high - low) * length * 10.0).ceil().clamp(1.0, 10_000.0);
    let periods = (0..=count as u32).map(|k| 1.0 / (low + (high - low) * f64::from(k) / count));
    periods.map(|period| (period, coherence(times, period).0)).max_by(|a, b| a.1.total_cmp(&b.1))
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Exp1};

    use super::*;

    /// Errors in ms of samples that arrive late by a mean of `late_ms`, some of them missing; the
    /// rate goes from 30 to 25 Hz in the middle.
    fn errors_ms(late_ms: f64, seed: u64) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (mut clock, mut errors, mut t) = (SteadyClock::new(), Vec::new(), MonoTime::from_ns(1 << 60));
        for sample in 0..1_000 {
            t += Span::from_s(if sample < 500 { 1.0 / 30.0 } else { 1.0 / 25.0 });
            if rng.random_bool(0.03) {
                continue;
            }
            let late = Span::from_ms(late_ms * Distribution::<f64>::sample(&Exp1, &mut rng));
            errors.push((clock.smooth(t + late) - t).ms());
        }
        errors
    }

    #[test]
    fn jitter_is_taken_out_through_gaps_and_a_change_of_rate() {
        for late_ms in [0.6, 2.0] {
            let errors = errors_ms(late_ms, 11);
            let rms = |part: &[f64]| (part.iter().map(|e| e * e).sum::<f64>() / part.len() as f64).sqrt();
            assert!(rms(&errors[60..460]) < 1.0, "{late_ms}: {}", rms(&errors[60..460]));
            assert!(rms(&errors[560..]) < 1.0, "{late_ms}: {}", rms(&errors[560..]));
        }
    }

    #[test]
    fn without_a_rate_arrivals_are_given_back() {
        let mut clock = SteadyClock::new();
        let mut t = MonoTime::default();
        for step in [3.0, 700.0, 12.0, 250.0, 90.0].repeat(12) {
            t += Span::from_ms(step);
            assert!((clock.smooth(t) - t).abs() <= Span::from_ms(700.0));
        }
        let mut burst = SteadyClock::new();
        (0..100).for_each(|_| assert_eq!(burst.smooth(t), t, "all in one read"));
    }
}
