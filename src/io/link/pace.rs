//! How much may be sent now: a token bucket that may go into debt, for a bandwidth ceiling and for the rate that the
//! path carries ([`super::governor`]).
//!
//! Back-fill waits until the balance is not negative. Live data may go into debt by a little more than one portion of
//! back-fill. So live data never waits for back-fill, and waits for the rate only where live data alone exceeds it.

use std::time::Duration;

use tokio::time::Instant;

/// Debt up to which live data is sent: one portion of back-fill takes 30 ms, and an estimate and an ownship state after
/// it must not wait.
const LIVE_DEBT_S: f64 = 0.05;
/// The least such debt, bytes, for rates so low that the above is less than one or two packets.
const LIVE_DEBT_LEAST: f64 = 300.0;
/// Credit for a burst that is saved while nothing is sent, seconds of the rate.
const SAVED_S: f64 = 0.004;

/// The priority class of data.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Priority {
    /// Live data.
    Live,
    /// Back-fill, and pictures.
    Low,
}

/// A token bucket that may go into debt.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Bucket {
    rate: f64,
    balance: f64,
    filled: Instant,
}

impl Bucket {
    /// A bucket that fills at `rate` bytes a second.
    pub fn new(rate: f64, now: Instant) -> Self {
        Self { rate, balance: 0.0, filled: now }
    }

    fn fill(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(self.filled).as_secs_f64();
        self.filled = now;
        // At least as much as compensates for a timer of a millisecond.
        let most = (self.rate * SAVED_S).max(100.0);
        self.balance = (self.balance + passed * self.rate).min(most);
    }

    /// Debt up to which live data is sent now, bytes.
    fn live_debt(&self) -> f64 {
        (self.rate * LIVE_DEBT_S).max(LIVE_DEBT_LEAST)
    }

    /// Time until sending is allowed; zero when it is.
    pub fn delay(&mut self, way: Priority, now: Instant) -> Duration {
        self.fill(now);
        let debt = match way {
            Priority::Live => self.live_debt(),
            Priority::Low => 0.0,
        };
        Duration::from_secs_f64(((-debt - self.balance) / self.rate).max(0.0))
    }

    /// Share of the debt allowed to live data that is used.
    pub fn debt_used(&mut self, now: Instant) -> f64 {
        self.fill(now);
        (-self.balance / self.live_debt()).max(0.0)
    }

    /// Bytes a second.
    pub fn rate(&self) -> f64 {
        self.rate
    }

    /// Fills at another rate from now on.
    pub fn set_rate(&mut self, rate: f64) {
        self.rate = rate;
    }

    /// Nothing is sent until `bytes` have gone at the present rate; live data waits only for the part of that time that
    /// its debt at higher rates does not cover.
    pub fn pause(&mut self, bytes: f64, now: Instant) {
        self.fill(now);
        self.balance = self.balance.min(-LIVE_DEBT_LEAST - bytes);
    }

    /// Accounts for sent bytes.
    pub fn charge(&mut self, bytes: f64) {
        self.balance -= bytes;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(start: Instant, ms: u64) -> Instant {
        start + Duration::from_millis(ms)
    }

    #[test]
    fn a_bucket_passes_its_rate_and_no_more() {
        let start = Instant::now();
        let mut bucket = Bucket::new(6_000.0, start);
        let mut sent = 0.0;
        for ms in 0..10_000 {
            if bucket.delay(Priority::Low, at(start, ms)).is_zero() {
                bucket.charge(240.0);
                sent += 240.0;
            }
        }
        assert!((59_000.0..=60_500.0).contains(&sent), "{sent} bytes in 10 s");
    }

    #[test]
    fn live_data_waits_for_no_portion_and_still_obeys_the_rate() {
        let start = Instant::now();
        let mut bucket = Bucket::new(10_000.0, start);
        // Given: 80 bytes of live data every 10 ms, and all the rest used by back-fill.
        let (mut live, mut low) = (0.0, 0.0);
        for ms in 0..10_000 {
            let now = at(start, ms);
            if bucket.delay(Priority::Low, now).is_zero() {
                bucket.charge(300.0);
                low += 300.0;
            }
            if ms % 10 == 0 {
                assert!(bucket.delay(Priority::Live, now).is_zero(), "it waits after {ms} ms");
                bucket.charge(80.0);
                live += 80.0;
            }
        }
        assert!((98_000.0..101_000.0).contains(&(live + low)), "{} bytes in 10 s", live + low);
        // When: live data alone exceeds the rate, it gets all of the rate, and back-fill gets nothing.
        let (mut live, mut low) = (0.0, 0.0);
        for ms in 10_000..20_000 {
            let now = at(start, ms);
            while bucket.delay(Priority::Live, now).is_zero() {
                bucket.charge(80.0);
                live += 80.0;
            }
            if bucket.delay(Priority::Low, now).is_zero() {
                low += 300.0;
            }
        }
        assert_eq!(low, 0.0);
        assert!((99_000.0..101_000.0).contains(&live), "{live} bytes in 10 s");
    }
}
