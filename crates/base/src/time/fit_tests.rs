//! The fit of a receiver's time on simulated arrivals.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Exp1, StandardNormal};

use super::fit::*;
use super::pulse::PulseTrouble;
use super::{MonoTime, NS_PER_S, Span};

/// Nanoseconds in a day.
const DAY_NS: i64 = 86_400 * NS_PER_S;
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

/// Errors in ms of a receiver at 5 Hz, received by a host that is `drift_ppm` fast.
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
    assert!((t_valid - (arrival - LATENCY)).ms().abs() < 1.0, "a late epoch still gets its time");
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
    assert!(clock.host_time_of(12 * NS_PER_S, t + LATENCY).is_none(), "the old time is over");
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

/// Epochs of a receiver with this period that corrects its time by `step_s` at `at`, with `gap` epochs missing there;
/// returns the largest early and late error of a stamp, ms, and how many stamps are off by more than 100 ms.
fn around_a_step(period_ms: i64, step_s: f64, at: i64, gap: i64, seed: u64) -> (f64, f64, usize) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut clock = GnssClock::new(LATENCY);
    let (mut early, mut late, mut off) = (0.0f64, 0.0f64, 0);
    for k in (0..at + 25).filter(|k| !(at..at + gap).contains(k)) {
        let valid = MonoTime::from_ns(START_NS + k * period_ms * 1_000_000);
        let arrival = valid + LATENCY + Jitter::OneSided(5.0).draw(&mut rng);
        let step_ns = if k < at { 0 } else { (step_s * 1e9) as i64 };
        let time_of_day_ns = (START_NS + k * period_ms * 1_000_000 + step_ns).rem_euclid(DAY_NS);
        clock.observe(time_of_day_ns, arrival);
        let t = clock.host_time_of(time_of_day_ns, arrival).map_or(arrival - LATENCY, |(t, _)| t);
        let error = (t - valid).ms();
        (early, late) = (early.min(error), late.max(error));
        off += usize::from(error.abs() > 100.0);
    }
    (early, late, off)
}

#[test]
fn a_receiver_that_learns_of_leap_seconds_is_followed_at_once() {
    for period_ms in [50, 200, 1_000] {
        for (seed, step_s) in [(1, -1.0), (2, 1.0), (3, -18.0)] {
            for at in [7, 40] {
                let (early, late, off) = around_a_step(period_ms, step_s, at, 0, seed);
                assert_eq!(off, 0, "{period_ms} ms, step {step_s} s after {at}: {early} to {late} ms");
            }
        }
        let (.., off) = around_a_step(period_ms, -0.4, 60, 0, 9);
        assert!(off <= 5, "a step of less than a second: {off}");
    }
    // Where epochs are missing, the first one after the gap may have come late.
    let (.., off) = around_a_step(200, -1.0, 60, 5, 6);
    assert!(off <= 1, "{off}");
}

#[test]
fn what_a_stall_held_back_is_no_step() {
    let mut clock = GnssClock::new(LATENCY);
    let valid = |k: i64| MonoTime::from_ns(START_NS + k * 200_000_000);
    for k in 0..200 {
        // The host stands still for 1.2 s, so one of the epochs is late by a second.
        let arrival = if (101..107).contains(&k) { valid(107) } else { valid(k) };
        let time_of_day_ns = (START_NS + k * 200_000_000).rem_euclid(DAY_NS);
        clock.observe(time_of_day_ns, arrival + LATENCY);
        let (t, _) = clock.host_time_of(time_of_day_ns, arrival + LATENCY).expect("a fit");
        assert!((t - valid(k)).ms().abs() < 2.0, "epoch {k}: {} ms", (t - valid(k)).ms());
    }
}

/// A receiver whose bursts come `delay_ms` after its epochs, with a pulse each `pulse_ms`, some of them missing.
struct Pulsed {
    period_ms: i64,
    pulse_ms: i64,
    delay_ms: f64,
    latency_ms: f64,
}

impl Pulsed {
    /// The clock after 20 s, and the worst stamp of the last 8 s where pulses determined it, ms.
    fn run(&self, missing: f64, seed: u64) -> (GnssClock, Option<f64>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut clock = GnssClock::new(Span::from_ms(self.latency_ms));
        let mut worst: Option<f64> = None;
        // The events in order: (host time, epoch or pulse).
        let mut events = Vec::new();
        for k in 0..20_000 / self.period_ms {
            let valid = MonoTime::from_ns(START_NS + k * self.period_ms * 1_000_000);
            let arrival = valid + Span::from_ms(self.delay_ms) + Jitter::OneSided(4.0).draw(&mut rng);
            events.push((arrival, Some(valid)));
        }
        for k in 0..20_000 / self.pulse_ms {
            if !rng.random_bool(missing) {
                events.push((MonoTime::from_ns(START_NS + k * self.pulse_ms * 1_000_000), None));
            }
        }
        events.sort();
        for (t, epoch) in events {
            let Some(valid) = epoch else {
                clock.observe_pulse(t);
                continue;
            };
            let time_of_day_ns = valid.ns().rem_euclid(DAY_NS);
            clock.observe(time_of_day_ns, t);
            if (valid.ns() - START_NS) > 12 * NS_PER_S && clock.state().is_some_and(|fit| fit.pulse) {
                let (fitted, _) = clock.host_time_of(time_of_day_ns, t).expect("a fit");
                worst = Some(worst.unwrap_or(0.0).max((fitted - valid).ms().abs()));
            }
        }
        (clock, worst)
    }
}

#[test]
fn a_pulse_takes_the_latency_out_however_late_the_sentences_come() {
    for (seed, (period_ms, pulse_ms)) in [(1_000, 1_000), (200, 1_000), (200, 200)].into_iter().enumerate() {
        for delay_ms in [40.0, 475.0, 1_100.0] {
            // Where the pulses are more frequent, the configured latency must decide which is which; where the
            // sentences come together with a pulse, nothing can.
            let phase_ms = delay_ms % f64::from(pulse_ms as i32);
            if !(15.0..f64::from(pulse_ms as i32) - 15.0).contains(&phase_ms) {
                continue;
            }
            let tells = delay_ms < f64::from(pulse_ms as i32) * 0.9;
            let latency_ms = if tells { 120.0 } else { delay_ms + 20.0 };
            let receiver = Pulsed { period_ms, pulse_ms, delay_ms, latency_ms };
            let (clock, worst) = receiver.run(0.05, seed as u64 + 1);
            let worst = worst.unwrap_or(f64::INFINITY);
            assert!(worst < 0.1, "{period_ms}/{pulse_ms} ms, {delay_ms} ms late: {worst} ms");
            assert_eq!(clock.pulse_trouble(), None, "{period_ms}/{pulse_ms} ms, {delay_ms} ms late");
        }
    }
}

#[test]
fn pulses_that_are_not_used_are_reported() {
    let ambiguous = Pulsed { period_ms: 200, pulse_ms: 200, delay_ms: 220.0, latency_ms: 120.0 };
    assert_eq!(ambiguous.run(0.0, 1).0.pulse_trouble(), Some(PulseTrouble::Ambiguous));
    let at_once = Pulsed { period_ms: 1_000, pulse_ms: 1_000, delay_ms: 2.0, latency_ms: 120.0 };
    assert_eq!(at_once.run(0.0, 1).0.pulse_trouble(), Some(PulseTrouble::Ambiguous));
    let uneven = Pulsed { period_ms: 200, pulse_ms: 730, delay_ms: 120.0, latency_ms: 120.0 };
    let (clock, worst) = uneven.run(0.0, 1);
    assert_eq!((clock.pulse_trouble(), worst), (Some(PulseTrouble::Uneven), None));
    let mut alone = GnssClock::new(LATENCY);
    (0..20).for_each(|k| alone.observe_pulse(MonoTime::from_ns(START_NS + k * NS_PER_S)));
    assert_eq!(alone.pulse_trouble(), Some(PulseTrouble::NoBurst));
}

#[test]
fn an_epoch_that_comes_late_takes_no_pulse_of_another() {
    // Given sentences 300 ms after the pulse, of which some are delayed by 1.1 s
    let mut clock = GnssClock::new(LATENCY);
    for k in 0..60 {
        let valid = MonoTime::from_ns(START_NS + k * NS_PER_S);
        clock.observe_pulse(valid);
        if k % 10 == 9 {
            clock.observe_pulse(valid + Span::from_s(1.0));
        }
        let stall = if k % 10 == 9 { 1_100.0 } else { 0.0 };
        let arrival = valid + Span::from_ms(300.0 + stall);
        let time_of_day_ns = valid.ns().rem_euclid(DAY_NS);
        clock.observe(time_of_day_ns, arrival);
        if k > 10 {
            let (t, _) = clock.host_time_of(time_of_day_ns, arrival).expect("a fit");
            assert!((t - valid).ms().abs() < 0.1, "epoch {k}: {} ms", (t - valid).ms());
        }
    }
}
