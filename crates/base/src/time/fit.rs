//! GPS time to host time: the time of validity of the receiver's reports.

use std::collections::VecDeque;

use super::jitter::{JitterFit, Point};
use super::pulse::{PulseTrouble, Pulses};
use super::{MonoTime, NS_PER_S, Span};

/// Most epochs in the fit.
const WINDOW_MAX: usize = 600;
/// Age of the oldest.
const WINDOW_AGE: Span = Span::from_ns(150 * NS_PER_S);
/// Prior one-sigma of the drift of the host's clock against UTC, milliseconds a second: crystals are within ±20 parts
/// in a million.
const DRIFT_SIGMA: f64 = 0.02;
/// Arrivals that are this far off the line, in addition to the jitter, are excluded.
const GATE_MS: f64 = 20.0;
/// While fewer epochs were seen, the gate has this width.
const GATE_FIRST: (usize, f64) = (10, 300.0);
/// This many consecutive epochs off the line, within this of each other, begin a new line.
const RESTART: (usize, f64) = (5, 150.0);
/// One-sigma of the first arrival, milliseconds: the agreement of the first few may be chance.
const FIRST_SIGMA_MS: f64 = 20.0;
/// Nanoseconds in a day.
const DAY_NS: i64 = 86_400 * NS_PER_S;
/// Longest time from the validity of an epoch to its reception for a stamp by the fit.
const RECEIVED_WITHIN: Span = Span::from_ns(1_500_000_000);
/// Longest time by which it may seem to be received before its validity: the fit's error.
const RECEIVED_BEFORE: Span = Span::from_ns(50_000_000);
/// One-sigma of a pulse's stamp: interrupt latency of an idle kernel.
const PULSE_SIGMA: Span = Span::from_ns(50_000);
/// Number of epochs whose arrivals determine well enough to which pulse each belongs.
const PULSE_EPOCHS: usize = 5;
/// Bursts nearer than this are not two of one receiver: another time of day in them is not a step.
const APART: Span = Span::from_ns(30_000_000);
/// A time of day that is repeated later than this is another burst.
const AGAIN: Span = Span::from_ns(300_000_000);

/// State of the fit, for display.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ClockFit {
    /// Present one-sigma of its host times, without the error of the configured latency.
    pub sigma: Span,
    /// How much faster the host's clock runs than UTC, parts in a million.
    pub drift_ppm: f64,
    /// Jitter of the arrivals: one-sigma of its symmetric part plus mean of its one-sided part.
    pub jitter: Span,
    /// Epochs in the fit.
    pub epochs: usize,
    /// Whether pulses determine the time.
    pub pulse: bool,
}

/// Fits the host's clock to a receiver's UTC over the arrivals of its epochs.
///
/// Only times of day are used: dates may be missing, wrong or roll over. An arrival is the validity of its epoch, plus
/// the configured latency, plus jitter that is either symmetric or one-sided (late). Constant errors of the latency
/// cannot be detected here. Single outliers are excluded; a step of the receiver or of a clock is followed after five
/// epochs, an announced leap second at once.
///
/// ```
/// use windhover_base::time::{GnssClock, MonoTime, Span};
///
/// // Epochs of a receiver at one a second, each 100 ms old when its first byte arrives, some later.
/// let mut clock = GnssClock::new(Span::from_ms(100.0));
/// let late_ms = |k: i64| [0, 9, 2, 15, 1][k as usize % 5];
/// let arrival = |k: i64| MonoTime::from_ns(k * 1_000_000_000 + 100_000_000 + late_ms(k) * 1_000_000);
/// for k in 0..60 {
///     clock.observe(36_000_000_000_000 + k * 1_000_000_000, arrival(k));
/// }
/// let (valid, sigma) = clock.host_time_of(36_059_000_000_000, arrival(59)).expect("the epoch is on the line");
/// // The jitter is removed: the epoch was valid 59 s after the first one.
/// assert!((valid - MonoTime::from_ns(59_000_000_000)).ms().abs() < 4.0 && sigma < Span::from_ms(5.0));
/// ```
#[derive(Clone, Debug)]
pub struct GnssClock {
    latency: Span,
    fit: JitterFit,
    /// Host time that counts as zero, and the offset (arrival minus time of day) there.
    reference: Option<(MonoTime, i64)>,
    points: VecDeque<Point>,
    astray: Vec<(MonoTime, i64)>,
    last: Option<Last>,
    pulses: Pulses,
}

/// The last epoch.
#[derive(Clone, Copy, Debug)]
struct Last {
    time_of_day_ns: i64,
    arrival: MonoTime,
}

/// The interpretation of an arrival off the line.
enum OffLine {
    /// UTC was corrected by whole seconds: this many nanoseconds of host time later.
    Seconds(i64),
    /// The receiver's time was corrected by some other amount.
    Anew,
    /// It came late, or is an outlier.
    Unknown,
}

impl GnssClock {
    /// `latency`: from a fix's validity to the start of its first byte, without jitter.
    pub fn new(latency: Span) -> Self {
        Self {
            latency,
            fit: JitterFit::new(DRIFT_SIGMA),
            reference: None,
            points: VecDeque::with_capacity(WINDOW_MAX),
            astray: Vec::new(),
            last: None,
            pulses: Pulses::default(),
        }
    }

    /// The newest arrivals in the fit, oldest first: host time, and that minus the time of day (modulo whole days). The
    /// input of [`Self::resume`].
    pub fn arrivals(&self, most: usize) -> Vec<(MonoTime, i64)> {
        let Some((reference, reference_ns)) = self.reference else { return Vec::new() };
        let newest = self.points.iter().skip(self.points.len().saturating_sub(most));
        newest.map(|&(t, x)| (reference + Span::from_s(t), reference_ns + Span::from_ms(x).ns())).collect()
    }

    /// Continues from the arrivals of an earlier clock of the same receiver and host. New arrivals that do not agree
    /// with them begin a new fit, as after any step.
    pub fn resume(&mut self, arrivals: &[(MonoTime, i64)]) {
        if !arrivals.is_empty() {
            self.restart(arrivals);
        }
    }

    /// An epoch of this time of day (from 86 400 s on in a leap second) began to arrive.
    pub fn observe(&mut self, time_of_day_ns: i64, arrival: MonoTime) {
        let before = self.last.replace(Last { time_of_day_ns, arrival });
        if before.is_some_and(|b| b.time_of_day_ns == time_of_day_ns && arrival - b.arrival < AGAIN) {
            return;
        }
        if before.is_some_and(|b| b.time_of_day_ns >= DAY_NS && time_of_day_ns < DAY_NS / 2) {
            // The leap second is over: UTC stood still for a second.
            self.step(NS_PER_S);
        }
        let offset_ns = arrival.ns().wrapping_sub(time_of_day_ns);
        let Some((t, mut x)) = self.point(arrival, offset_ns) else {
            self.restart(&[(arrival, offset_ns)]);
            return;
        };
        if self.is_off_line(t, x) {
            match self.interpret(t, x, offset_ns, before) {
                OffLine::Seconds(ns) => {
                    self.step(ns);
                    x -= Span::from_ns(ns).ms();
                }
                OffLine::Anew => return self.restart(&[(arrival, offset_ns)]),
                OffLine::Unknown => return self.stray(arrival, offset_ns),
            }
        }
        self.astray.clear();
        self.points.push_back((t, x));
        let oldest = t - WINDOW_AGE.s();
        while self.points.len() > WINDOW_MAX || self.points.front().is_some_and(|point| point.0 < oldest) {
            self.points.pop_front();
        }
        self.fit.fit(self.points.make_contiguous());
        self.pair(time_of_day_ns, arrival);
    }

    /// The receiver's pulse arrived at this host time.
    pub fn observe_pulse(&mut self, edge: MonoTime) {
        self.pulses.edge(edge);
    }

    /// Why arriving pulses are not used; `None` where they are used, or where none arrive.
    pub fn pulse_trouble(&self) -> Option<PulseTrouble> {
        self.pulses.trouble()
    }

    /// Finds the pulse that marked an epoch.
    fn pair(&mut self, time_of_day_ns: i64, arrival: MonoTime) {
        if self.points.len() < PULSE_EPOCHS {
            return;
        }
        let Some(offset_ns) = self.arrival_offset(arrival) else { return };
        let days = (arrival.ns() - offset_ns - time_of_day_ns + DAY_NS / 2).div_euclid(DAY_NS);
        let of_day_ns = time_of_day_ns + days * DAY_NS;
        self.pulses.epoch(of_day_ns, MonoTime::from_ns(of_day_ns + offset_ns), self.latency);
    }

    /// From here on UTC is behind by this much relative to host time.
    fn step(&mut self, ns: i64) {
        if let Some((_, reference_ns)) = &mut self.reference {
            *reference_ns = reference_ns.wrapping_add(ns);
        }
        self.pulses.shift(ns);
    }

    /// The interpretation of an arrival off the line. Arrivals are never early, and a time of day never goes back:
    /// where they seem to, the receiver has corrected its time (it learns leap seconds some minutes after its start). A
    /// late arrival is just late, unless the next is equally late.
    fn interpret(&self, t: f64, x: f64, offset_ns: i64, before: Option<Last>) -> OffLine {
        let (late_ms, gate_ms) = (x - self.fit.at(t).0, self.gate_ms(t));
        let seconds = (late_ms / 1e3).round();
        let is_whole = seconds != 0.0 && (late_ms - seconds * 1e3).abs() <= gate_ms;
        let went_back = before.zip(self.last).is_some_and(|(before, last)| {
            let step_ns = (last.time_of_day_ns - before.time_of_day_ns + DAY_NS / 2).rem_euclid(DAY_NS);
            step_ns <= DAY_NS / 2 && last.arrival - before.arrival >= APART
        });
        // Epochs that a stall of the host held back arrive at once, each less late than the one before.
        let as_late_before =
            self.astray.last().zip(before).zip(self.last).is_some_and(|((astray, b), last)| {
                let apart = Span::from_ns(offset_ns.wrapping_sub(astray.1)).abs();
                apart.ns() <= (last.arrival - b.arrival).ns() / 4
            });
        if is_whole && (late_ms < 0.0 || went_back || as_late_before) {
            return OffLine::Seconds(seconds as i64 * NS_PER_S);
        }
        if went_back { OffLine::Anew } else { OffLine::Unknown }
    }

    /// Host time at which an epoch of this time of day, received at `t_recv`, was valid, with one-sigma. `None` before
    /// the first epoch, and where the epoch does not agree with earlier ones.
    pub fn host_time_of(&self, time_of_day_ns: i64, t_recv: MonoTime) -> Option<(MonoTime, Span)> {
        let offset_ns = self.offset_ns(t_recv)?;
        let days = (t_recv.ns() - offset_ns - time_of_day_ns + DAY_NS / 2).div_euclid(DAY_NS);
        let t_valid = MonoTime::from_ns(time_of_day_ns + offset_ns + days * DAY_NS);
        let age = t_recv - t_valid;
        (age >= -RECEIVED_BEFORE && age <= RECEIVED_WITHIN).then_some((t_valid, self.sigma(t_recv)))
    }

    /// Quality of the fit; `None` before the first epoch.
    pub fn state(&self) -> Option<ClockFit> {
        let (reference, _) = self.reference?;
        let now = reference + Span::from_s(self.points.back()?.0);
        let (sigma, tau) = self.fit.jitter_ms();
        Some(ClockFit {
            sigma: self.sigma(now),
            drift_ppm: self.fit.slope() * 1e3,
            jitter: Span::from_ms(sigma + tau),
            epochs: self.points.len(),
            pulse: self.pulses.offset_ns(now).is_some(),
        })
    }

    fn sigma(&self, at: MonoTime) -> Span {
        if self.pulses.offset_ns(at).is_some() {
            return PULSE_SIGMA;
        }
        let by_chance = FIRST_SIGMA_MS / self.points.len().max(1) as f64;
        self.reference.map_or(Span::ZERO, |(reference, _)| {
            Span::from_ms(self.fit.at((at - reference).s()).1.hypot(by_chance))
        })
    }

    /// Validity minus time of day: from the pulse where one is valid, else from the arrivals.
    fn offset_ns(&self, at: MonoTime) -> Option<i64> {
        self.pulses.offset_ns(at).or_else(|| Some(self.arrival_offset(at)? - self.latency.ns()))
    }

    /// Arrival minus time of day, from all arrivals.
    fn arrival_offset(&self, at: MonoTime) -> Option<i64> {
        let (reference, reference_ns) = self.reference?;
        Some(reference_ns + Span::from_ms(self.fit.at((at - reference).s()).0).ns())
    }

    /// An arrival as a point of the fit: seconds since the reference, milliseconds of offset.
    fn point(&self, arrival: MonoTime, offset_ns: i64) -> Option<Point> {
        let (reference, reference_ns) = self.reference?;
        let difference = offset_ns.wrapping_sub(reference_ns);
        let within_day = (difference + DAY_NS / 2).rem_euclid(DAY_NS) - DAY_NS / 2;
        Some(((arrival - reference).s(), Span::from_ns(within_day).ms()))
    }

    /// Whether the jitter so far does not explain this point.
    fn is_off_line(&self, t: f64, x: f64) -> bool {
        let late = x - self.fit.at(t).0;
        late > self.gate_ms(t) || -late > self.gate_early_ms(t)
    }

    /// The largest lateness of an arrival by the jitter so far.
    fn gate_ms(&self, t: f64) -> f64 {
        if self.points.len() < GATE_FIRST.0 {
            return GATE_FIRST.1;
        }
        self.gate_early_ms(t) + 8.0 * self.fit.jitter_ms().1
    }

    /// The largest earliness.
    fn gate_early_ms(&self, t: f64) -> f64 {
        if self.points.len() < GATE_FIRST.0 {
            return GATE_FIRST.1;
        }
        5.0 * self.fit.jitter_ms().0.hypot(self.fit.at(t).1) + GATE_MS
    }

    fn stray(&mut self, arrival: MonoTime, offset_ns: i64) {
        self.astray.push((arrival, offset_ns));
        if self.astray.len() > RESTART.0 {
            self.astray.remove(0);
        }
        if self.astray.len() < RESTART.0 {
            return;
        }
        let first = self.astray[0].1;
        let spread = |&(_, offset): &(MonoTime, i64)| Span::from_ns(offset.wrapping_sub(first)).ms().abs();
        if self.astray.iter().map(spread).all(|ms| ms <= RESTART.1) {
            let astray = std::mem::take(&mut self.astray);
            self.restart(&astray);
        }
    }

    fn restart(&mut self, arrivals: &[(MonoTime, i64)]) {
        self.reference = arrivals.first().copied();
        self.fit = JitterFit::new(DRIFT_SIGMA);
        self.astray.clear();
        self.pulses.forget();
        let points = arrivals.iter().filter_map(|&(arrival, offset_ns)| self.point(arrival, offset_ns));
        self.points = points.collect();
        self.fit.fit(self.points.make_contiguous());
    }
}
