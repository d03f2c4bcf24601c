//! Arrivals of a device with a steady rate, with the jitter removed.

use std::collections::VecDeque;
use std::f64::consts::TAU;

use super::jitter::{JitterFit, Point};
use super::{MonoTime, Span};

/// Samples in the fit of the line: a few seconds of a compass.
const WINDOW_MAX: usize = 128;
/// Arrivals from which the rate is determined.
const RECENT: usize = 24;
/// Samples between two checks of the rate.
const CHECK_EVERY: u32 = 12;
/// One-sigma of a period determined in this way, milliseconds a second.
const PERIOD_SIGMA: f64 = 10.0;
/// Periods that a clock can smooth, seconds.
const PERIODS_S: (f64, f64) = (0.001, 10.0);
/// Periods that are examined more closely: the most coherent ones.
const PEAKS: usize = 6;
/// Log-odds against a missing sample, and against two in the place of one.
const LOG_MISSING: f64 = 3.5;
const LOG_DOUBLE: f64 = 5.0;
/// Least width of jitter, seconds.
const WIDTH_MIN_S: f64 = 3e-4;
/// Limits for a steady device: the share of a period that its jitter fills, and the share of missing or double samples.
const STEADY: (f64, f64) = (0.75, 0.3);
/// Log-odds by which another period must explain the arrivals better than the present one.
const LOG_BETTER: f64 = 8.0;

/// Largest share of a period by which expected lateness moves the limit between two counts.
const LATE_PART: f64 = 0.3;
/// Removes the jitter from the arrivals of a device with a steady rate.
///
/// The rate need not be known: it is the one that explains the recent arrivals best, by the width of the remaining
/// jitter and the number of samples that must then be missing. (Coherence alone is not enough: arrivals that wait for a
/// tick of 16 ms are as coherent at 32.5 Hz as at the 30 Hz of their device.) Samples may be missing; a change of the
/// device's rate is followed. While there is no steady rate the arrivals are returned unchanged.
///
/// ```
/// use windhover_base::time::{MonoTime, SteadyClock};
///
/// // A compass at 20 Hz whose readings arrive up to 8 ms late.
/// let mut clock = SteadyClock::new();
/// let late_ms = |k: i64| (k * 7) % 9;
/// let mut smoothed = MonoTime::default();
/// for k in 0..200 {
///     smoothed = clock.smooth(MonoTime::from_ns(k * 50_000_000 + late_ms(k) * 1_000_000));
/// }
/// assert!((clock.period().expect("a steady device").ms() - 50.0).abs() < 0.1);
/// assert!((smoothed - MonoTime::from_ns(199 * 50_000_000)).ms().abs() < 4.0);
/// ```
#[derive(Clone, Debug)]
pub struct SteadyClock {
    fit: JitterFit,
    reference: MonoTime,
    /// Period with which the samples are counted, seconds.
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
    /// A clock of an unknown rate.
    pub fn new() -> Self {
        Self {
            fit: JitterFit::with_ticks(PERIOD_SIGMA),
            reference: MonoTime::default(),
            period_s: None,
            index: 0,
            points: VecDeque::with_capacity(WINDOW_MAX),
            recent: VecDeque::with_capacity(RECENT),
            since_check: 0,
            last: None,
        }
    }

    /// The arrival of the next sample without its jitter. Never before the last returned one, never more than a period
    /// from the arrival.
    pub fn smooth(&mut self, arrival: MonoTime) -> MonoTime {
        if self.recent.back().is_some_and(|last| arrival < *last) {
            // Host time does not go back; something else is wrong.
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

    /// One-sigma of the last result of [`Self::smooth`]; `None` while the rate is not known.
    pub fn sigma(&self) -> Option<Span> {
        let period_s = self.period_s?;
        Some(Span::from_ms(self.fit.at(self.index as f64 * period_s).1))
    }

    /// The arrivals in the fit, the latest one last: time of the count, s, and arrival relative to it, ms. None while
    /// the rate is not known.
    pub(super) fn counted(&self) -> impl DoubleEndedIterator<Item = Point> + Clone + '_ {
        self.points.iter().copied()
    }

    /// The deviation of this arrival in [`Self::counted`]; `None` where it was not counted.
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

    /// The counting period, corrected by the slope of the line.
    fn true_period_s(&self, period_s: f64) -> f64 {
        period_s * (1.0 + self.fit.slope() * 1e-3)
    }

    /// Determines the rate, or drops one that is no longer valid.
    fn check_rate(&mut self) {
        self.since_check += 1;
        if self.recent.len() < RECENT || self.since_check < CHECK_EVERY {
            return;
        }
        self.since_check = 0;
        let times: Vec<f64> = self.recent.iter().map(|t| (*t - self.recent[0]).s()).collect();
        let best = likely_periods(&times).into_iter().max_by(|a, b| a.log_odds.total_cmp(&b.log_odds));
        let Some(best) = best else { return };
        if let Some(period_s) = self.period_s {
            let kept = Explanation::of(&times, self.true_period_s(period_s));
            // A few seconds may hide a tick that the fit has already detected.
            let (sigma, late) = self.fit.jitter_ms();
            let is_known = kept.width * self.true_period_s(period_s) * 1e3 <= 2.5 * late + 5.0 * sigma;
            if kept.is_steady() && (is_known || kept.log_odds >= best.log_odds - LOG_BETTER) {
                return;
            }
            self.period_s = None;
        }
        if best.is_steady() {
            self.begin(&times, &best);
        }
    }

    /// Counts the recent samples with a new period and fits the line to them; the last one is not placed yet.
    fn begin(&mut self, times: &[f64], best: &Explanation) {
        self.fit = JitterFit::with_ticks(PERIOD_SIGMA);
        self.reference = self.recent[0];
        self.period_s = Some(best.period_s);
        self.points.clear();
        self.index = i64::MIN;
        for &time in &times[..times.len() - 1] {
            let index = best.index(time);
            if index > self.index {
                self.index = index;
                self.points.push_back(point(time, index, best.period_s));
            }
        }
        self.fit.fit(self.points.make_contiguous());
    }

    fn place(&mut self, arrival: MonoTime, period_s: f64) -> MonoTime {
        let since = (arrival - self.reference).s();
        let t_last = self.index as f64 * period_s;
        let on_line = t_last + self.fit.at(t_last).0 * 1e-3;
        let true_period_s = self.true_period_s(period_s);
        // Where arrivals are only ever late, more than half a period of lateness has to be distinguished.
        let late = (self.fit.jitter_ms().1 * 1e-3 / true_period_s).min(LATE_PART);
        let steps = ((since - on_line) / true_period_s - late).round();
        if !(1.0..1e9).contains(&steps) {
            // Two in the place of one: the one before was too late to be distinguished from this one.
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

/// Time of the count in seconds, arrival relative to it in milliseconds.
fn point(since_s: f64, index: i64, period_s: f64) -> Point {
    let t = index as f64 * period_s;
    (t, (since_s - t) * 1e3)
}

/// How well times agree with one phase of a period: |mean of exp(2πi t/P)|, and that phase in turns.
fn coherence(times: &[f64], period_s: f64) -> (f64, f64) {
    let (sin, cos) = times.iter().fold((0.0, 0.0), |(sin, cos), time| {
        let (s, c) = (TAU * time / period_s).sin_cos();
        (sin + s, cos + c)
    });
    (f64::hypot(sin, cos) / times.len() as f64, sin.atan2(cos) / TAU)
}

/// How a period explains the arrivals.
#[derive(Clone, Copy, Debug)]
struct Explanation {
    period_s: f64,
    /// Phase of the arrivals in the period, turns.
    phase: f64,
    /// Width of the jitter without the extremes, as a share of the period.
    width: f64,
    /// Missing or double samples, as a share of those present.
    wrong: f64,
    /// Log-likelihood up to a constant.
    log_odds: f64,
}

impl Explanation {
    fn of(times: &[f64], period_s: f64) -> Self {
        let (_, phase) = coherence(times, period_s);
        let mut this = Self { period_s, phase, width: 1.0, wrong: 1.0, log_odds: f64::NEG_INFINITY };
        let count = times.len() as f64;
        let indices: Vec<i64> = times.iter().map(|&time| this.index(time)).collect();
        let steps =
            |few: fn(i64) -> i64| indices.windows(2).map(|pair| few(pair[1] - pair[0])).sum::<i64>() as f64;
        let (missing, double) = (steps(|step| (step - 1).max(0)), steps(|step| i64::from(step < 1)));
        let off = |(&time, &index): (&f64, &i64)| time - index as f64 * period_s;
        let mut offs: Vec<f64> = times.iter().zip(&indices).map(off).collect();
        offs.sort_by(f64::total_cmp);
        let edge = offs.len() / 12;
        let width_s = (offs[offs.len() - 1 - edge] - offs[edge]).max(WIDTH_MIN_S);
        this.width = width_s / period_s;
        this.wrong = (missing + double) / count;
        this.log_odds = -count * width_s.ln() - LOG_MISSING * missing - LOG_DOUBLE * double;
        this
    }

    /// The count of the sample that arrived at `time`.
    fn index(&self, time: f64) -> i64 {
        (time / self.period_s - self.phase).round() as i64
    }

    fn is_steady(&self) -> bool {
        self.width <= STEADY.0 && self.wrong <= STEADY.1
    }
}

/// The most coherent periods near the mean interval.
fn likely_periods(times: &[f64]) -> Vec<Explanation> {
    let intervals: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len().max(1) as f64;
    // Without silences, which are not intervals.
    let (length, rough) = (intervals.iter().sum::<f64>(), mean(&intervals));
    let near: Vec<f64> = intervals.into_iter().filter(|interval| *interval <= 4.0 * rough).collect();
    let interval = mean(&near);
    if !(PERIODS_S.0..=PERIODS_S.1).contains(&interval) {
        return Vec::new();
    }
    // Frequencies a tenth of the resolution 1/T apart, from a third below to a third above.
    let (low, high) = (0.75 / interval, 1.35 / interval);
    let count = ((high - low) * length * 10.0).ceil().clamp(1.0, 10_000.0);
    let periods = (0..=count as u32).map(|k| 1.0 / (low + (high - low) * f64::from(k) / count));
    let coherent: Vec<(f64, f64)> = periods.map(|period| (period, coherence(times, period).0)).collect();
    let mut peaks: Vec<(f64, f64)> = coherent
        .windows(3)
        .filter(|three| three[1].1 >= three[0].1.max(three[2].1))
        .map(|three| three[1])
        .collect();
    peaks.sort_by(|a, b| b.1.total_cmp(&a.1));
    peaks.truncate(PEAKS);
    peaks.into_iter().map(|(period_s, _)| Explanation::of(times, period_s)).collect()
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Exp1};

    use super::*;

    /// Errors in ms of samples that arrive late by a mean of `late_ms`, some of them missing; the rate changes from 30
    /// to 25 Hz in the middle.
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

    /// One-sigma about the mean and mean, ms, of the errors of a device that arrives by ticks, after `skip`.
    fn through_ticks(rate_hz: f64, tick_ms: f64, late_ms: f64, missing: f64, seed: u64) -> (f64, f64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (mut clock, mut errors) = (SteadyClock::new(), Vec::new());
        let (start, phase_ms) = (1i64 << 60, rng.random_range(0.0..1e3 / rate_hz));
        for sample in 0..300 {
            let since_ms = phase_ms + f64::from(sample) * 1e3 / rate_hz;
            if rng.random_bool(missing) {
                continue;
            }
            let sent_ms = since_ms + late_ms * Distribution::<f64>::sample(&Exp1, &mut rng);
            let received_ms = (sent_ms / tick_ms).ceil() * tick_ms;
            let t = MonoTime::from_ns(start) + Span::from_ms(received_ms);
            errors.push((clock.smooth(t) - MonoTime::from_ns(start) - Span::from_ms(since_ms)).ms());
        }
        let settled = &errors[60..];
        let mean = settled.iter().sum::<f64>() / settled.len() as f64;
        let variance = settled.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / settled.len() as f64;
        (variance.sqrt(), mean)
    }

    #[test]
    fn ticks_are_taken_out_at_every_rate() {
        let kinds = [(0.0, 0.0), (0.3, 0.0), (0.5, 0.03)];
        for (n, tick_ms) in [1.0, 4.0, 10.0, 16.0, 20.0].into_iter().enumerate() {
            for (k, rate_hz) in [8.0, 25.0, 30.0, 30.5].into_iter().enumerate() {
                let (late_ms, missing) = kinds[(n + k) % 3];
                let (sigma, mean) = through_ticks(rate_hz, tick_ms, late_ms, missing, (n + k) as u64);
                let what =
                    format!("{tick_ms} ms at {rate_hz} Hz, {late_ms} ms late: {sigma:.2} about {mean:.2} ms");
                assert!(sigma <= 2.5, "{what}");
                // The common lateness is visible only where the period goes through all phases of the tick.
                let seen = [30.0, 30.5].contains(&rate_hz) && tick_ms == 16.0;
                assert!(mean > -1.5 && mean < if seen { 2.0 } else { tick_ms + 1.0 }, "{what}");
            }
        }
    }

    #[test]
    fn where_ticks_are_as_long_as_the_period_it_is_no_worse_than_nothing() {
        for (rate_hz, tick_ms) in [(50.0, 16.0), (100.0, 16.0), (60.0, 20.0)] {
            let (sigma, mean) = through_ticks(rate_hz, tick_ms, 0.2, 0.0, 7);
            let nothing = tick_ms / 12f64.sqrt();
            assert!(sigma <= nothing * 1.2, "{tick_ms} ms at {rate_hz} Hz: {sigma:.2} about {mean:.2} ms");
        }
    }
}
