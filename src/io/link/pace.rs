//! How much may be sent now: a bandwidth ceiling, and what the path is found to carry.
//!
//! Both are buckets that may go into debt. What is sent again waits until the balance is not negative; what
//! is live may go into debt by a little more than one portion of the former, so that it waits for none, and
//! for nothing but the rate itself where live data alone is more than fits.

use std::time::Duration;

use tokio::time::Instant;

use super::sense::Noted;

/// Standing delay in the path above which less is sent. Well under the 150 ms that live data may be late at;
/// above the few milliseconds by which stations are asked to acknowledge at the latest.
const QUEUE_LIMIT: Duration = Duration::from_millis(30);
/// Standing delay below which more is tried.
const QUEUE_EMPTY: Duration = Duration::from_millis(15);
/// Where the search begins, bytes a second: carries two vehicles at 15 Hz over the slowest radios.
const RATE_AT_START: f64 = 10_000.0;
/// Never less than this, bytes a second: it finds out when the path is back.
const RATE_LEAST: f64 = 1_500.0;
/// Never more than this, bytes a second.
const RATE_MOST: f64 = 50e6;
/// Silence after which the path counts as cut.
const SILENCE: Duration = Duration::from_millis(600);
/// How long the least round-trip time is remembered: twice this at most.
const BASE_MEMORY: Duration = Duration::from_secs(30);

/// After a cut its losses are not held against the path: they are noted within this of the first
/// acknowledgement.
const FORGIVEN: Duration = Duration::from_millis(400);
/// Over how long losses are weighed against what arrived: a slow path carries a packet or two between two
/// looks, and one lost packet does not make a path lossy.
const LOSS_MEMORY_S: f64 = 2.0;

/// Debt up to which live data is sent: one portion of what is sent again takes 30 ms, and an estimate and an
/// ownship sent after it are to wait for nothing.
const LIVE_DEBT_S: f64 = 0.05;
/// The same at rates so low that this is less than a packet or two, bytes.
const LIVE_DEBT_LEAST: f64 = 300.0;
/// What is saved up for a burst while nothing is sent, seconds of the rate.
const SAVED_S: f64 = 0.004;

/// What is to be sent, as to its right of way.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Way {
    /// Live data.
    Live,
    /// What is sent again, and pictures.
    Low,
}

/// Share of losses above which acknowledgements are lost as well, and one look's least round-trip time may be
/// that of a packet whose own acknowledgement never came: then the least of the last looks counts.
const LOSSY: f64 = 0.05;
/// How many looks.
const LOOKS: usize = 3;

/// A token bucket that may go into debt.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Bucket {
    rate: f64,
    balance: f64,
    filled: Instant,
}

impl Bucket {
    /// Fills at `rate` bytes a second.
    pub fn new(rate: f64, now: Instant) -> Self {
        Self { rate, balance: 0.0, filled: now }
    }

    fn fill(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(self.filled).as_secs_f64();
        self.filled = now;
        // At the least as much as makes up for a timer of a millisecond.
        let most = (self.rate * SAVED_S).max(100.0);
        self.balance = (self.balance + passed * self.rate).min(most);
    }

    /// Time until sending is allowed; zero when it is.
    pub fn delay(&mut self, way: Way, now: Instant) -> Duration {
        self.fill(now);
        let debt = match way {
            Way::Live => (self.rate * LIVE_DEBT_S).max(LIVE_DEBT_LEAST),
            Way::Low => 0.0,
        };
        Duration::from_secs_f64(((-debt - self.balance) / self.rate).max(0.0))
    }

    /// Bytes a second.
    pub fn rate(&self) -> f64 {
        self.rate
    }

    /// Takes what was sent.
    pub fn charge(&mut self, bytes: f64) {
        self.balance -= bytes;
    }
}

/// Finds what a path carries from the delays and losses on it.
#[derive(Clone, Debug)]
pub struct Governor {
    bucket: Bucket,
    updated: Instant,
    heard: Instant,
    delivered: f64,
    /// Bytes lost and acknowledged lately, fading away over [`LOSS_MEMORY_S`].
    lost: f64,
    acked: f64,
    base: [Option<Duration>; 2],
    base_turned: Instant,
    queue: Duration,
    rtts: [Duration; LOOKS],
    limited: bool,
    cut: bool,
    restored: Option<Instant>,
}

impl Governor {
    /// At the beginning of a connection.
    pub fn new(now: Instant) -> Self {
        Self {
            bucket: Bucket::new(RATE_AT_START, now),
            updated: now,
            heard: now,
            delivered: RATE_AT_START,
            lost: 0.0,
            acked: 0.0,
            base: [None; 2],
            base_turned: now,
            queue: Duration::ZERO,
            rtts: [Duration::MAX; LOOKS],
            limited: false,
            cut: false,
            restored: None,
        }
    }

    /// Bytes a second allowed now.
    pub fn rate(&self) -> f64 {
        self.bucket.rate
    }

    /// Whether the path seems cut: nothing was acknowledged for a while.
    pub fn is_cut(&self) -> bool {
        self.cut
    }

    /// Time until sending is allowed.
    pub fn delay(&mut self, way: Way, now: Instant) -> Duration {
        let delay = self.bucket.delay(way, now);
        self.limited |= !delay.is_zero();
        delay
    }

    /// Takes what was sent.
    pub fn charge(&mut self, bytes: f64) {
        self.bucket.charge(bytes);
    }

    /// Learns from what was noted since the last call; call it about ten times a second.
    pub fn update(&mut self, noted: Noted, now: Instant) {
        let passed = now.saturating_duration_since(self.updated).as_secs_f64().clamp(1e-3, 1.0);
        self.updated = now;
        let limited = std::mem::take(&mut self.limited);
        let kept = (-passed / LOSS_MEMORY_S).exp();
        self.lost = self.lost * kept + noted.lost as f64;
        self.acked = self.acked * kept + noted.acked as f64;
        if noted.acked == 0 {
            if !self.cut && now.saturating_duration_since(self.heard) > SILENCE + self.queue {
                self.cut = true;
                // What was found before may be much more than what comes after.
                self.set_rate(self.bucket.rate.min(1.5 * RATE_AT_START));
            }
            return;
        }
        self.heard = now;
        if std::mem::take(&mut self.cut) {
            self.restored = Some(now);
        }
        if self.restored.is_some_and(|at| now.saturating_duration_since(at) < FORGIVEN) {
            self.lost = 0.0;
        }
        let weight = 1.0 - (-passed / 0.3).exp();
        self.delivered += weight * (noted.acked as f64 / passed - self.delivered);
        if let Some(rtt) = noted.least_rtt {
            self.learn_queue(rtt, now);
        }
        let lossy = self.lost > self.acked;
        if self.queue > QUEUE_LIMIT || lossy {
            self.set_rate(self.bucket.rate.min(self.delivered) * if lossy { 1.0 } else { 0.85 });
        } else if limited && self.queue < QUEUE_EMPTY {
            let grown = self.bucket.rate * (1.0 + passed);
            self.set_rate(grown.min(self.bucket.rate.max(1.5 * self.delivered + 1_000.0)));
        }
    }

    /// Delay above the least round-trip time of the last half to whole minute.
    fn learn_queue(&mut self, rtt: Duration, now: Instant) {
        if now.saturating_duration_since(self.base_turned) > BASE_MEMORY {
            self.base_turned = now;
            self.base = [self.base[1], None];
        }
        self.base[1] = Some(self.base[1].map_or(rtt, |least| least.min(rtt)));
        let base = self.base.iter().flatten().min().copied().unwrap_or(rtt);
        self.rtts.rotate_left(1);
        self.rtts[LOOKS - 1] = rtt;
        let lossy = self.lost > LOSSY * (self.lost + self.acked);
        let least = if lossy { self.rtts.iter().min().copied().unwrap_or(rtt) } else { rtt };
        self.queue = least.saturating_sub(base);
    }

    fn set_rate(&mut self, rate: f64) {
        self.bucket.rate = rate.clamp(RATE_LEAST, RATE_MOST);
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
            if bucket.delay(Way::Low, at(start, ms)).is_zero() {
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
        // Given: 80 bytes of live data every 10 ms, and all the rest given to what is sent again.
        let (mut live, mut low) = (0.0, 0.0);
        for ms in 0..10_000 {
            let now = at(start, ms);
            if bucket.delay(Way::Low, now).is_zero() {
                bucket.charge(300.0);
                low += 300.0;
            }
            if ms % 10 == 0 {
                assert!(bucket.delay(Way::Live, now).is_zero(), "it waits after {ms} ms");
                bucket.charge(80.0);
                live += 80.0;
            }
        }
        assert!((98_000.0..101_000.0).contains(&(live + low)), "{} bytes in 10 s", live + low);
        // When: live data alone is more than fits, it gets the rate, and the rest nothing.
        let (mut live, mut low) = (0.0, 0.0);
        for ms in 10_000..20_000 {
            let now = at(start, ms);
            while bucket.delay(Way::Live, now).is_zero() {
                bucket.charge(80.0);
                live += 80.0;
            }
            if bucket.delay(Way::Low, now).is_zero() {
                low += 300.0;
            }
        }
        assert_eq!(low, 0.0);
        assert!((99_000.0..101_000.0).contains(&live), "{live} bytes in 10 s");
    }

    /// A path with a queue: `capacity` bytes a second, `rtt` without queue. Gives the rate found and the
    /// greatest standing delay after the first five seconds.
    fn run(capacity: f64, rtt_ms: f64, seconds: u64, start: Instant) -> (f64, f64) {
        let mut governor = Governor::new(start);
        let (mut queued, mut worst) = (0.0_f64, 0.0_f64);
        for tick in 1..=seconds * 10 {
            let now = at(start, tick * 100);
            // Everything the bucket allows is sent in messages of 240 bytes.
            let mut offered = 0.0_f64;
            while governor.delay(Way::Low, now).is_zero() && offered < 1e6 {
                governor.charge(240.0);
                offered += 240.0;
            }
            let rate = governor.rate();
            let offered = offered.max(rate * 0.1);
            let served = (queued + offered).min(capacity * 0.1);
            queued += offered - served;
            let delay_ms = queued / capacity * 1e3;
            if tick > 50 {
                worst = worst.max(delay_ms);
            }
            let rtt = Duration::from_secs_f64((rtt_ms + delay_ms) * 1e-3);
            governor.update(Noted { acked: served as u64, lost: 0, least_rtt: Some(rtt) }, now);
        }
        (governor.rate(), worst)
    }

    #[test]
    fn the_governor_finds_slow_and_fast_paths() {
        let start = Instant::now();
        let (rate, worst) = run(6_000.0, 20.0, 60, start);
        assert!((3_500.0..9_000.0).contains(&rate), "{rate} bytes/s on a path of 6000");
        assert!(worst < 130.0, "{worst} ms of standing delay");
        let (rate, _) = run(1e6, 20.0, 60, start);
        assert!(rate > 4e5, "{rate} bytes/s on a path of 1e6");
    }

    #[test]
    fn a_third_of_the_packets_lost_does_not_throttle_a_path() {
        use rand::{Rng as _, SeedableRng as _};
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let start = Instant::now();
        let mut governor = Governor::new(start);
        let rtt = Some(Duration::from_millis(5));
        let mut early = 0.0;
        for tick in 1..=600 {
            let now = at(start, tick * 100);
            let mut noted = Noted { least_rtt: rtt, ..Noted::default() };
            // As many messages of 240 bytes as the rate allows in a tenth of a second, which is one or a few.
            for _ in 0..(governor.rate() * 0.1 / 240.0).ceil() as u64 {
                governor.charge(240.0);
                let fate = if random.random_bool(0.3) { &mut noted.lost } else { &mut noted.acked };
                *fate += 240;
            }
            assert!(!governor.delay(Way::Low, now).is_zero(), "the rate is the limit");
            governor.update(noted, now);
            early = if tick == 50 { governor.rate() } else { early };
        }
        assert!(early > RATE_AT_START, "{early} bytes/s after 5 s");
        assert!(governor.rate() > 2.0 * RATE_AT_START, "{} bytes/s after a minute", governor.rate());
    }

    #[test]
    fn what_a_cut_lost_does_not_slow_the_path_down_after_it() {
        let start = Instant::now();
        let mut governor = Governor::new(start);
        let rtt = Some(Duration::from_millis(40));
        let up = Noted { acked: 1_000, lost: 0, least_rtt: rtt };
        // Given: a second of life, six of silence.
        for tick in 1..=10 {
            governor.update(up, at(start, tick * 100));
        }
        for tick in 11..=70 {
            governor.update(Noted::default(), at(start, tick * 100));
        }
        let before = governor.rate();
        // When: the first acknowledgement declares all that was sent meanwhile lost, the next some more.
        for (tick, lost) in [(71, 45_000), (72, 2_000), (73, 0), (74, 0)] {
            governor.charge(10.0 * before);
            assert!(!governor.delay(Way::Low, at(start, tick * 100)).is_zero(), "the rate is the limit");
            governor.update(Noted { lost, ..up }, at(start, tick * 100));
        }
        // Then: more is tried at once.
        assert!(governor.rate() > 1.2 * before, "{} after {before} bytes/s", governor.rate());
    }

    #[test]
    fn a_late_acknowledgement_is_a_queue_only_where_none_are_lost() {
        let start = Instant::now();
        for (lost, slowed) in [(0, true), (200, false)] {
            let mut governor = Governor::new(start);
            let rate = governor.rate();
            for tick in 1..=30 {
                // Every tenth look sees but one packet, acknowledged 60 ms late.
                let late = if tick % 10 == 0 { 60 } else { 0 };
                let least_rtt = Some(Duration::from_millis(40 + late));
                governor.update(Noted { acked: 800, lost, least_rtt }, at(start, tick * 100));
            }
            assert_eq!(governor.rate() < rate, slowed, "{} bytes/s with {lost} lost a look", governor.rate());
        }
    }

    #[test]
    fn silence_is_a_cut_and_an_acknowledgement_ends_it() {
        let start = Instant::now();
        let mut governor = Governor::new(start);
        for tick in 1..20 {
            governor.update(Noted::default(), at(start, tick * 100));
        }
        assert!(governor.is_cut());
        let rtt = Some(Duration::from_millis(10));
        governor.update(Noted { acked: 100, lost: 0, least_rtt: rtt }, at(start, 2_000));
        assert!(!governor.is_cut() && governor.rate() >= RATE_LEAST);
    }
}
