//! GPS time to host time: when was it true what a receiver said later.

use std::collections::VecDeque;

use super::jitter::{JitterFit, Point};
use super::{MonoTime, NS_PER_S, Span};

/// Epochs the fit is made over.
const WINDOW_MAX: usize = 600;
/// Age of the oldest.
const WINDOW_AGE: Span = Span::from_ns(150 * NS_PER_S);
/// One-sigma of the drift of the host's clock against UTC expected beforehand: crystals keep ±20
/// parts in a million. Milliseconds a second.
const DRIFT_SIGMA: f64 = 0.02;
/// Arrivals as much as this off the line are kept out of it, beside what the jitter explains.
const GATE_MS: f64 = 20.0;
/// As long as fewer epochs were seen, the gate is as wide as this.
const GATE_FIRST: (usize, f64) = (10, 300.0);
/// Epochs in a row off the line, and within this of each other, begin a new one.
const RESTART: (usize, f64) = (5, 150.0);
/// One-sigma of the first arrival, milliseconds: that the first few agree may be chance.
const FIRST_SIGMA_MS: f64 = 20.0;
/// Nanoseconds in a day.
const DAY_NS: i64 = 86_400 * NS_PER_S;
/// How long after an epoch is true it may at most be heard to be put in time by the fit.
const HEARD_WITHIN: Span = Span::from_ns(1_500_000_000);
/// How long before it is true it may seem to be heard: the fit's error.
const HEARD_BEFORE: Span = Span::from_ns(50_000_000);
/// How near to a whole second of UTC, by the arrivals, a pulse must be to be that second's.
const PULSE_NEAR_MS: f64 = 90.0;
/// How long a pulse holds the time.
const PULSE_HOLDS: Span = Span::from_ns(5 * NS_PER_S);
/// One-sigma of a pulse's stamp: interrupt latency of an idle kernel.
const PULSE_SIGMA: Span = Span::from_ns(50_000);

/// State of the fit, for people.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ClockFit {
    /// One-sigma of a host time it gives now, without the error of the configured latency.
    pub sigma: Span,
    /// How much faster the host's clock runs than UTC, parts in a million.
    pub drift_ppm: f64,
    /// Jitter of the arrivals: one-sigma of its symmetric part plus mean of its one-sided part.
    pub jitter: Span,
    /// Epochs it is made over.
    pub epochs: usize,
    /// Whether pulses hold the time.
    pub pulse: bool,
}

/// Fits the host's clock to a receiver's UTC over the arrivals of its epochs.
///
/// Only times of day are used: dates may be missing, wrong or roll over. An arrival is the validity
/// of its epoch, plus the configured latency, plus jitter that is symmetric or only late. Constant
/// errors of the latency cannot be seen here. Single wild arrivals are left out; a receiver or a
/// clock that has stepped is followed after five epochs, an announced leap second at once.
#[derive(Clone, Debug)]
pub struct GnssClock {
    latency: Span,
    fit: JitterFit,
    /// Host time that counts as zero, and the offset (arrival less time of day) there.
    reference: Option<(MonoTime, i64)>,
    points: VecDeque<Point>,
    astray: Vec<(MonoTime, i64)>,
    last_time_of_day_ns: Option<i64>,
    pulse: Option<(MonoTime, i64)>,
}

impl GnssClock {
    /// `latency`: from a fix's validity to the begin of its first byte, without jitter.
    pub fn new(latency: Span) -> Self {
        Self {
            latency,
            fit: JitterFit::new(DRIFT_SIGMA),
            reference: None,
            points: VecDeque::with_capacity(WINDOW_MAX),
            astray: Vec::new(),
            last_time_of_day_ns: None,
            pulse: None,
        }
    }

    /// The newest arrivals the fit is made over, oldest first: host time and that less the time of day
    /// (up to whole days). What [`Self::resume`] takes.
    pub fn arrivals(&self, most: usize) -> Vec<(MonoTime, i64)> {
        let Some((reference, reference_ns)) = self.reference else { return Vec::new() };
        let newest = self.points.iter().skip(self.points.len().saturating_sub(most));
        newest.map(|&(t, x)| (reference + Span::from_s(t), reference_ns + Span::from_ms(x).ns())).collect()
    }

    /// Continues from the arrivals of an earlier clock of the same receiver and host. New arrivals that
    /// do not lie with them begin a new fit, as after any step.
    pub fn resume(&mut self, arrivals: &[(MonoTime, i64)]) {
        if !arrivals.is_empty() {
            self.restart(arrivals);
        }
    }

    /// An epoch of this time of day (from 86 400 s on in a leap second) began to arrive.
    pub fn observe(&mut self, time_of_day_ns: i64, arrival: MonoTime) {
        let leapt = self.last_time_of_day_ns.replace(time_of_day_ns);
        if leapt == Some(time_of_day_ns) {
            return;
        }
        let offset_ns = arrival.ns().wrapping_sub(time_of_day_ns);
        if leapt.is_some_and(|before| before >= DAY_NS && time_of_day_ns < DAY_NS / 2)
            && let Some((_, reference_ns)) = &mut self.reference
        {
            // The leap second is over: UTC has stood still for a second.
            *reference_ns += NS_PER_S;
        }
        let Some((t, x)) = self.point(arrival, offset_ns) else {
            self.restart(&[(arrival, offset_ns)]);
            return;
        };
        if self.is_astray(t, x) {
            self.stray(arrival, offset_ns);
            return;
        }
        self.astray.clear();
        self.points.push_back((t, x));
        let oldest = t - WINDOW_AGE.s();
        while self.points.len() > WINDOW_MAX || self.points.front().is_some_and(|point| point.0 < oldest) {
            self.points.pop_front();
        }
        self.fit.fit(self.points.make_contiguous());
    }

    /// The receiver's pulse marked a whole second of UTC at this host time.
    pub fn observe_pulse(&mut self, edge: MonoTime) {
        let Some(offset_ns) = self.valid_offset(edge) else {
            return;
        };
        let time_of_day_ns = edge.ns() - offset_ns;
        let second_ns = (time_of_day_ns + NS_PER_S / 2).div_euclid(NS_PER_S) * NS_PER_S;
        if Span::from_ns(time_of_day_ns - second_ns).ms().abs() <= PULSE_NEAR_MS {
            self.pulse = Some((edge, edge.ns() - second_ns));
        }
    }

    /// Host time at which an epoch of this time of day, heard at `heard`, was true, with one-sigma.
    /// `None` before the first epoch, and where the epoch does not fit what was heard before.
    pub fn host_time_of(&self, time_of_day_ns: i64, heard: MonoTime) -> Option<(MonoTime, Span)> {
        let offset_ns = self.offset_ns(heard)?;
        let days = (heard.ns() - offset_ns - time_of_day_ns + DAY_NS / 2).div_euclid(DAY_NS);
        let t_valid = MonoTime::from_ns(time_of_day_ns + offset_ns + days * DAY_NS);
        let age = heard - t_valid;
        (age >= -HEARD_BEFORE && age <= HEARD_WITHIN).then_some((t_valid, self.sigma(heard)))
    }

    /// How well it is known; `None` before the first epoch.
    pub fn state(&self) -> Option<ClockFit> {
        let (reference, _) = self.reference?;
        let now = reference + Span::from_s(self.points.back()?.0);
        let (sigma, tau) = self.fit.jitter_ms();
        Some(ClockFit {
            sigma: self.sigma(now),
            drift_ppm: self.fit.slope() * 1e3,
            jitter: Span::from_ms(sigma + tau),
            epochs: self.points.len(),
            pulse: self.pulse_holds(now),
        })
    }

    fn pulse_holds(&self, at: MonoTime) -> bool {
        self.pulse.is_some_and(|(edge, _)| (at - edge).abs() <= PULSE_HOLDS)
    }

    fn sigma(&self, at: MonoTime) -> Span {
        if self.pulse_holds(at) {
            return PULSE_SIGMA;
        }
        let by_chance = FIRST_SIGMA_MS / self.points.len().max(1) as f64;
        self.reference.map_or(Span::ZERO, |(reference, _)| {
            Span::from_ms(self.fit.at((at - reference).s()).1.hypot(by_chance))
        })
    }

    /// Validity less time of day: of the pulse where one holds, else of the arrivals.
    fn offset_ns(&self, at: MonoTime) -> Option<i64> {
        match self.pulse {
            Some((_, offset_ns)) if self.pulse_holds(at) => Some(offset_ns),
            _ => self.valid_offset(at),
        }
    }

    fn valid_offset(&self, at: MonoTime) -> Option<i64> {
        let (reference, reference_ns) = self.reference?;
        let line = Span::from_ms(self.fit.at((at - reference).s()).0);
        Some(reference_ns + line.ns() - self.latency.ns())
    }

    /// An arrival as a point of the fit: seconds since the reference, milliseconds of offset.
    fn point(&self, arrival: MonoTime, offset_ns: i64) -> Option<Point> {
        let (reference, reference_ns) = self.reference?;
        let difference = offset_ns.wrapping_sub(reference_ns);
        let within_day = (difference + DAY_NS / 2).rem_euclid(DAY_NS) - DAY_NS / 2;
        Some(((arrival - reference).s(), Span::from_ns(within_day).ms()))
    }

    /// Whether the jitter so far does not explain this point.
    fn is_astray(&self, t: f64, x: f64) -> bool {
        let (line, line_sigma) = self.fit.at(t);
        let late = x - line;
        if self.points.len() < GATE_FIRST.0 {
            return late.abs() > GATE_FIRST.1;
        }
        let (sigma, tau) = self.fit.jitter_ms();
        let noise = 5.0 * sigma.hypot(line_sigma) + GATE_MS;
        late < -noise || late > noise + 8.0 * tau
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
        self.pulse = None;
        let points = arrivals.iter().filter_map(|&(arrival, offset_ns)| self.point(arrival, offset_ns));
        self.points = points.collect();
        self.fit.fit(self.points.make_contiguous());
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Exp1, StandardNormal};

    use super::*;

    const LATENCY: Span = Span::from_ns(120_000_000);
    /// 23:59:30 UTC of some day, so that every run passes midnight.
    const START_NS: i64 = 1_795_046_370_000_000_000;

    enum Jitter {
        OneSided(f64),
        Normal(f64),
    }

    impl Jitter {
        fn draw(&self, rng: &mut impl Rng) -> Span {
            Span::from_ms(match *self {
                Self::OneSided(mean) => mean * Distribution::<f64>::sample(&Exp1, rng),
                Self::Normal(sigma) => sigma * Distribution::<f64>::sample(&StandardNormal, rng),
            })
        }
    }

    /// Errors in ms of a receiver of 5 Hz heard by a host that is `drift_ppm` fast.
    fn errors_ms(jitter: &Jitter, drift_ppm: f64, seconds: i64, seed: u64) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut clock = GnssClock::new(LATENCY);
        let mut errors = Vec::new();
        for epoch in 0..seconds * 5 {
            let since_ns = epoch * 200_000_000;
            let valid = MonoTime::from_ns(START_NS + since_ns + (since_ns as f64 * drift_ppm * 1e-6) as i64);
            let arrival = valid + LATENCY + jitter.draw(&mut rng);
            let time_of_day_ns = (START_NS + since_ns).rem_euclid(DAY_NS);
            clock.observe(time_of_day_ns, arrival);
            let fitted = clock.host_time_of(time_of_day_ns, arrival);
            errors.push(fitted.map_or(f64::NAN, |(t, _)| (t - valid).ms()));
        }
        errors
    }

    fn rms(errors: &[f64]) -> f64 {
        (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
    }

    #[test]
    fn the_fit_is_within_two_milliseconds_whatever_the_jitter() {
        let cases = [
            Jitter::OneSided(5.0),
            Jitter::OneSided(17.5),
            Jitter::OneSided(30.0),
            Jitter::Normal(5.0),
            Jitter::Normal(15.0),
        ];
        for (index, jitter) in cases.iter().enumerate() {
            let errors = errors_ms(jitter, 30.0, 80, index as u64 + 1);
            let settled = rms(&errors[200..]);
            assert!(settled < 2.0, "case {index}: {settled} ms rms after 40 s");
            // From the first epoch the error is that of one arrival at most
            assert!(errors.iter().all(|e| e.abs() < 120.0), "case {index}");
        }
    }

    #[test]
    fn it_settles_within_seconds_where_the_jitter_is_one_sided() {
        let errors = errors_ms(&Jitter::OneSided(17.5), 0.0, 10, 3);
        assert!(rms(&errors[25..]) < 4.0, "{} ms rms from 5 s on", rms(&errors[25..]));
    }

    #[test]
    fn single_wild_arrivals_change_nothing() {
        let mut clock = GnssClock::new(LATENCY);
        let at = |k: i64| (k * 200_000_000, MonoTime::from_ns(START_NS + k * 200_000_000) + LATENCY);
        for k in 0..50 {
            let (time, arrival) = at(k);
            clock.observe(time, arrival + Span::from_ms(if k % 7 == 6 { 400.0 } else { 0.0 }));
        }
        let (time, arrival) = at(50);
        let (t_valid, sigma) = clock.host_time_of(time, arrival + Span::from_ms(400.0)).expect("a fit");
        assert!((t_valid - (arrival - LATENCY)).ms().abs() < 1.0, "a late epoch is still put in its place");
        assert!(sigma.ms() < 2.0);
    }

    #[test]
    fn a_step_of_either_clock_is_followed() {
        let mut clock = GnssClock::new(LATENCY);
        let step = |k: i64| if k < 50 { 0 } else { 3_723 * NS_PER_S };
        for k in 0..60 {
            let t = MonoTime::from_ns(START_NS + k * 200_000_000);
            clock.observe((k * 200_000_000 + step(k)).rem_euclid(DAY_NS), t + LATENCY);
        }
        let t = MonoTime::from_ns(START_NS + 12 * NS_PER_S);
        let (t_valid, _) = clock.host_time_of(12 * NS_PER_S + step(60), t + LATENCY).expect("a fit");
        assert!((t_valid - t).ms().abs() < 1.0);
        assert!(clock.host_time_of(12 * NS_PER_S, t + LATENCY).is_none(), "the old time is no more");
    }

    #[test]
    fn an_announced_leap_second_is_followed_at_once() {
        let mut clock = GnssClock::new(LATENCY);
        let last_minute_ns = DAY_NS - 60 * NS_PER_S;
        for k in 0..310 {
            let t = MonoTime::from_ns(START_NS + k * 200_000_000);
            let elapsed_ns = last_minute_ns + k * 200_000_000;
            // 23:59:60 is second 86400 of its day; the next day begins after it.
            let of_day = if k < 305 { elapsed_ns } else { elapsed_ns - DAY_NS - NS_PER_S };
            clock.observe(of_day, t + LATENCY);
            let (t_valid, _) = clock.host_time_of(of_day, t + LATENCY).expect("a fit");
            assert!((t_valid - t).ms().abs() < 2.0, "epoch {k}: {:?}", t_valid - t);
        }
    }

    #[test]
    fn a_pulse_takes_the_latency_out() {
        // Given a receiver 40 ms later than configured
        let mut clock = GnssClock::new(LATENCY);
        let late = Span::from_ms(40.0);
        for k in 0..30 {
            let t = MonoTime::from_ns(START_NS + k * 200_000_000);
            clock.observe(k * 200_000_000, t + LATENCY + late);
            if k % 5 == 0 {
                clock.observe_pulse(t);
            }
        }
        let t = MonoTime::from_ns(START_NS + 6 * NS_PER_S);
        let (t_valid, sigma) = clock.host_time_of(6 * NS_PER_S, t + LATENCY + late).expect("a fit");
        assert!((t_valid - t).ms().abs() < 0.1 && sigma.ms() < 0.1);
        assert!(clock.state().expect("a fit").pulse);
    }
}
