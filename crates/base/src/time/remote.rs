//! The clock of another computer that counts from its own start, mapped to host time.
//!
//! An exchange (we send at `t₁`, it answers `r`, the answer arrives at `t₂`) bounds `host − remote` to `(t₁ + t₂)/2 − r
//! ± (t₂ − t₁)/2`; the quickest exchange of the last half minute is used. Without any exchange, the least delayed
//! arrival is used, which is late by the least delay.

use std::collections::VecDeque;

use super::{MonoTime, Span};

/// How long exchanges and arrivals are used.
const KEPT: Span = Span::from_ns(30_000_000_000);
/// Largest drift between two crystals.
const DRIFT: f64 = 50e-6;
/// A slower exchange is not used.
const SLOWEST: Span = Span::from_ns(500_000_000);
/// In each such span the least delayed arrival is kept.
const BIN: Span = Span::from_ns(1_000_000_000);
/// A remote clock that jumps by more than this was restarted.
const RESTART: Span = Span::from_ns(1_000_000_000);
/// Number of consecutive jumps that are accepted: a single one is a damaged or foreign message.
const BELIEVED: u32 = 3;

/// A bound on the difference of the clocks: `host − remote`, and its largest error.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Bound {
    at: MonoTime,
    host_less_remote_ns: i64,
    wrong_by: Span,
}

impl Bound {
    /// Its largest error at `now`, seconds.
    fn doubt_s(&self, now: MonoTime) -> f64 {
        self.wrong_by.s() + DRIFT * (now - self.at).s().abs()
    }
}

/// A remote clock.
///
/// ```
/// use windhover_base::time::{MonoTime, RemoteClock, Span};
///
/// let ms = |ms: i64| MonoTime::from_ns(ms * 1_000_000);
/// let mut clock = RemoteClock::default();
/// // Sent at 1000 ms, answered at 40 ms of the other clock, received at 1006 ms.
/// clock.exchanged(ms(1_000), Span::from_ms(40.0), ms(1_006));
/// assert_eq!(clock.host(Span::from_ms(50.0)), Some(ms(1_013)));
/// assert_eq!(clock.remote(ms(1_013)), Some(Span::from_ms(50.0)));
/// ```
#[derive(Clone, PartialEq, Debug, Default)]
pub struct RemoteClock {
    exchanges: VecDeque<Bound>,
    arrivals: VecDeque<Bound>,
    jumps: u32,
    restarts: u32,
    now: MonoTime,
}

impl RemoteClock {
    /// A message with the remote time `remote` arrived at `t`. False where that is impossible: the clock jumped, which
    /// is accepted when it happens three times in a row.
    pub fn observe(&mut self, remote: Span, t: MonoTime) -> bool {
        self.now = t;
        if self.has_jumped(remote, t) {
            self.jumps += 1;
            if self.jumps < BELIEVED {
                return false;
            }
            self.restarts += 1;
            self.exchanges.clear();
            self.arrivals.clear();
        }
        self.jumps = 0;
        let bound = Bound { at: t, host_less_remote_ns: t.ns() - remote.ns(), wrong_by: Span::default() };
        match self.arrivals.back_mut() {
            Some(last) if t - last.at < BIN => {
                if bound.host_less_remote_ns < last.host_less_remote_ns {
                    last.host_less_remote_ns = bound.host_less_remote_ns;
                }
            }
            _ => self.arrivals.push_back(bound),
        }
        self.arrivals.retain(|arrival| t - arrival.at <= KEPT);
        true
    }

    /// An exchange: sent at `sent`, answered at `remote`, the answer received at `received`.
    pub fn exchanged(&mut self, sent: MonoTime, remote: Span, received: MonoTime) {
        let took = received - sent;
        if took < Span::default() || took > SLOWEST || !self.observe(remote, received) {
            return;
        }
        let half = Span::from_ns(took.ns() / 2);
        let host_less_remote_ns = (sent + half).ns() - remote.ns();
        self.exchanges.push_back(Bound { at: received, host_less_remote_ns, wrong_by: half });
        self.exchanges.retain(|exchange| received - exchange.at <= KEPT);
    }

    fn has_jumped(&self, remote: Span, t: MonoTime) -> bool {
        // Relative to the last arrival: a message delayed by a second is late, not early.
        self.arrivals.back().is_some_and(|last| {
            let moved = (t.ns() - remote.ns()) - last.host_less_remote_ns;
            moved.abs() > RESTART.ns()
        })
    }

    /// Number of detected restarts.
    pub fn restarts(&self) -> u32 {
        self.restarts
    }

    /// Whether it answered recently: then its time is known to half of an exchange's duration.
    pub fn is_exchanged(&self) -> bool {
        self.exchanges.iter().any(|exchange| self.now - exchange.at <= KEPT)
    }

    fn host_less_remote_ns(&self) -> Option<i64> {
        let known = |bound: &&Bound| self.now - bound.at <= KEPT;
        let surest = self.exchanges.iter().filter(known);
        let surest = surest.min_by(|a, b| a.doubt_s(self.now).total_cmp(&b.doubt_s(self.now)));
        let earliest = || self.arrivals.iter().filter(known).map(|bound| bound.host_less_remote_ns).min();
        surest.map(|bound| bound.host_less_remote_ns).or_else(earliest)
    }

    /// Host time of a remote one; `None` before the first message.
    pub fn host(&self, remote: Span) -> Option<MonoTime> {
        self.host_less_remote_ns().map(|apart| MonoTime::from_ns(remote.ns().saturating_add(apart)))
    }

    /// Remote time of a host one.
    pub fn remote(&self, host: MonoTime) -> Option<Span> {
        self.host_less_remote_ns().map(|apart| Span::from_ns(host.ns().saturating_sub(apart)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A link with a delay of 2 ms each way and, one-sided and unequal, up to 40 ms more.
    fn delay(k: u64) -> Span {
        let mixed = k.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
        Span::from_ms(2.0 + 40.0 * ((mixed % 1_000) as f64 / 1_000.0).powi(3))
    }

    fn at(s: f64) -> MonoTime {
        MonoTime::from_ns(1_700_000_000_000_000_000) + Span::from_s(s)
    }

    /// Time of a remote clock that is 30 ppm fast and was started 50 s before.
    fn remote(t: MonoTime) -> Span {
        Span::from_s(50.0 + (t - at(0.0)).s() * (1.0 + 30e-6))
    }

    #[test]
    fn an_exchange_a_second_gives_times_to_three_milliseconds() {
        let mut clock = RemoteClock::default();
        let mut worst: f64 = 0.0;
        for k in 0..600_u64 {
            let sent = at(k as f64);
            let there = sent + delay(2 * k);
            clock.exchanged(sent, remote(there), there + delay(2 * k + 1));
            for j in 1..10_u32 {
                let t = sent + Span::from_ms(100.0 * f64::from(j));
                clock.observe(remote(t), t + delay(7_777 * k + u64::from(j)));
                let off = clock.host(remote(t)).expect("known") - t;
                worst = worst.max(if k > 5 { off.s().abs() } else { 0.0 });
            }
        }
        assert!(worst < 3e-3, "{worst} s");
        assert!(clock.is_exchanged() && clock.restarts() == 0);
    }

    #[test]
    fn arrivals_alone_are_late_by_the_least_delay() {
        let mut clock = RemoteClock::default();
        for k in 0..300_u64 {
            let t = at(0.1 * k as f64);
            assert!(clock.observe(remote(t), t + delay(k)));
        }
        let off = clock.host(remote(at(30.0))).expect("known") - at(30.0);
        assert!((0.0..0.006).contains(&off.s()), "{} s", off.s());
        assert!(!clock.is_exchanged());
    }

    #[test]
    fn a_remote_that_starts_anew_is_followed_and_one_odd_message_is_not() {
        let mut clock = RemoteClock::default();
        clock.exchanged(at(0.0), remote(at(0.002)), at(0.004));
        assert!(!clock.observe(Span::from_s(9.0), at(1.0)));
        assert!(clock.observe(remote(at(1.1)), at(1.11)));
        assert_eq!(clock.restarts(), 0);
        let mut believed = 0;
        for k in 0..10 {
            let t = at(2.0 + 0.1 * f64::from(k));
            believed += u32::from(clock.observe(Span::from_s(0.1 * f64::from(k)), t + Span::from_ms(2.0)));
        }
        assert_eq!((clock.restarts(), believed), (1, 8));
        let off = clock.host(Span::from_s(0.5)).expect("known") - at(2.5);
        assert!((off.s() - 0.002).abs() < 1e-3, "{}", off.s());
    }

    #[test]
    fn an_answer_that_comes_before_its_question_or_much_too_late_is_none() {
        let mut clock = RemoteClock::default();
        clock.exchanged(at(1.0), remote(at(0.5)), at(0.9));
        clock.exchanged(at(1.0), remote(at(1.5)), at(3.0));
        assert_eq!(clock.host(Span::from_s(51.0)), None);
    }
}
