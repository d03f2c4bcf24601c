//! What a path is found to carry, from the delays and losses on it.
//!
//! The rate grows until data begins to stand in the path, goes below what was delivered until the queue is
//! gone, returns to just under that, and tries more: little at first, the longer nothing stands the more.

use std::time::Duration;

use tokio::time::Instant;

use super::pace::{Bucket, Way};
use super::sense::{CLASSES, Noted};

/// Standing delay in the path above which less is sent. Well under the 150 ms that live data may be late at;
/// above the few milliseconds by which stations are asked to acknowledge at the latest.
const QUEUE_LIMIT: Duration = Duration::from_millis(30);
/// Standing delay below which more is tried.
const QUEUE_EMPTY: Duration = Duration::from_millis(15);
/// Where the search begins, bytes a second: carries two vehicles at 15 Hz, so that on a path that can carry them
/// nothing waits for the search; on the slowest radios the first queue is found within half a second.
const RATE_AT_START: f64 = 10_000.0;
/// Never less than this, bytes a second: it finds out when the path is back.
const RATE_LEAST: f64 = 1_500.0;
/// Never more than this, bytes a second.
const RATE_MOST: f64 = 50e6;
/// While nothing is known of what the path carries, the rate grows by this share of itself a second.
const GROWTH_MOST: f64 = 5.0;
/// Just after it was found how much that is, by this; twice as much with every second without a queue.
const GROWTH_LEAST: f64 = 0.05;
/// Share of what was delivered that is sent while a queue drains.
const DRAINING: f64 = 0.75;
/// The same once it is gone.
const DRAINED: f64 = 0.95;
/// A delay that does not go away in this time is taken for jitter, not for a queue.
const DRAINING_MOST: Duration = Duration::from_secs(2);
/// Silence after which the path counts as cut.
const SILENCE: Duration = Duration::from_millis(600);
/// How long the least round-trip times are remembered: twice this at most.
const BASE_MEMORY: Duration = Duration::from_secs(30);
/// After a cut its losses are not held against the path: they are noted within this of the first
/// acknowledgement.
const FORGIVEN: Duration = Duration::from_millis(400);
/// Over how long losses are weighed against what arrived: a slow path carries a packet or two between two
/// looks, and one lost packet does not make a path lossy.
const LOSS_MEMORY_S: f64 = 2.0;
/// Share of losses above which acknowledgements are lost as well, and one look's least delay may be that of a
/// packet whose own acknowledgement never came: then the least of the last looks counts.
const LOSSY: f64 = 0.05;
/// How many looks.
const LOOKS: usize = 3;

/// Delay above the least of packets of the same size. A slow line takes a long packet longer than a short one:
/// at 48 kbit/s 100 bytes more are 17 ms, and no queue.
#[derive(Clone, Debug)]
struct Delays {
    base: [[Option<Duration>; CLASSES]; 2],
    turned: Instant,
    looks: [Duration; LOOKS],
}

impl Delays {
    fn new(now: Instant) -> Self {
        Self { base: [[None; CLASSES]; 2], turned: now, looks: [Duration::MAX; LOOKS] }
    }

    /// The least round-trip time of packets of a class or of a larger one, of the last half to whole minute.
    fn least(&self, class: usize) -> Option<Duration> {
        self.base.iter().flat_map(|epoch| &epoch[class..]).flatten().min().copied()
    }

    /// The standing delay seen since the last look; `None` where only sizes came that were not known before.
    fn look(
        &mut self,
        least_rtt: &[Option<Duration>; CLASSES],
        lossy: bool,
        now: Instant,
    ) -> Option<Duration> {
        if now.saturating_duration_since(self.turned) > BASE_MEMORY {
            self.turned = now;
            self.base = [self.base[1], [None; CLASSES]];
        }
        let seen = |class: usize| least_rtt[class].map(|rtt| (class, rtt));
        let queue = (0..CLASSES)
            .filter_map(seen)
            .filter_map(|(class, rtt)| Some(rtt.saturating_sub(self.least(class)?)))
            .min();
        for (class, rtt) in (0..CLASSES).filter_map(seen) {
            let least = &mut self.base[1][class];
            *least = Some(least.map_or(rtt, |least| least.min(rtt)));
        }
        self.looks.rotate_left(1);
        self.looks[LOOKS - 1] = queue?;
        if lossy { self.looks.iter().min().copied() } else { queue }
    }
}

/// Finds what a path carries.
#[derive(Clone, Debug)]
pub struct Governor {
    bucket: Bucket,
    /// IP and UDP headers of one packet, bytes.
    headers: f64,
    updated: Instant,
    heard: Instant,
    delivered: f64,
    /// Bytes lost and acknowledged lately, fading away over [`LOSS_MEMORY_S`].
    lost: f64,
    acked: f64,
    delays: Delays,
    queue: Duration,
    /// What was delivered, bytes a second, when a queue stood last, and when that was.
    found: Option<(f64, Instant)>,
    draining: bool,
    /// Until then what is seen is of packets sent before the rate was changed.
    settled: Instant,
    limited: bool,
    cut: bool,
    restored: Option<Instant>,
}

impl Governor {
    /// At the beginning of a connection whose packets have `headers` bytes of IP and UDP headers.
    pub fn new(headers: f64, now: Instant) -> Self {
        Self {
            bucket: Bucket::new(RATE_AT_START, now),
            headers,
            updated: now,
            heard: now,
            delivered: RATE_AT_START,
            lost: 0.0,
            acked: 0.0,
            delays: Delays::new(now),
            queue: Duration::ZERO,
            found: None,
            draining: false,
            settled: now,
            limited: false,
            cut: false,
            restored: None,
        }
    }

    /// Bytes a second allowed now.
    pub fn rate(&self) -> f64 {
        self.bucket.rate()
    }

    /// Whether the path seems cut: nothing was acknowledged for a while.
    pub fn is_cut(&self) -> bool {
        self.cut
    }

    /// Time until sending is allowed.
    pub fn delay(&mut self, way: Way, now: Instant) -> Duration {
        let delay = self.bucket.delay(way, now);
        // Half of the debt is a sign in time: the first record that waits for the rate would be late.
        self.limited |= !delay.is_zero() || (way == Way::Live && self.bucket.debt_used(now) > 0.5);
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
                self.found = None;
                self.set_rate(self.rate().min(1.5 * RATE_AT_START));
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
        let arrived = noted.acked as f64 + noted.packets as f64 * self.headers;
        self.delivered += weight * (arrived / passed - self.delivered);
        let lossy = self.lost > LOSSY * (self.lost + self.acked);
        if let Some(queue) = self.delays.look(&noted.least_rtt, lossy, now) {
            self.queue = queue;
        }
        let rtt = noted.least_rtt.iter().flatten().min().copied().unwrap_or_default();
        self.steer(limited, passed, rtt, now);
    }

    fn steer(&mut self, limited: bool, passed: f64, rtt: Duration, now: Instant) {
        let carried = self.rate().min(self.delivered);
        if self.lost > self.acked {
            self.set_rate(carried);
        } else if now < self.settled {
            // What was done shows later.
        } else if self.queue > QUEUE_LIMIT && !self.drained_in_vain(now) {
            let since = self.found.filter(|_| self.draining).map_or(now, |(_, since)| since);
            self.found = Some((carried, since));
            self.draining = true;
            self.settled = now + rtt;
            self.set_rate(DRAINING * carried);
        } else if self.queue < QUEUE_EMPTY || self.drained_in_vain(now) {
            if std::mem::take(&mut self.draining) {
                let (carried, _) = self.found.unwrap_or((carried, now));
                self.found = Some((carried, now));
                self.set_rate(self.rate().max(DRAINED * carried));
            } else if limited {
                let growth = self.found.map_or(GROWTH_MOST, |(_, at)| {
                    let seconds = now.saturating_duration_since(at).as_secs_f64();
                    (GROWTH_LEAST * seconds.min(10.0).exp2()).min(GROWTH_MOST)
                });
                let grown = self.rate() * (1.0 + growth * passed);
                self.set_rate(grown.min(self.rate().max(1.5 * self.delivered + 1_000.0)));
            }
        }
    }

    /// Whether less has been sent for so long that what still looks like a queue is none.
    fn drained_in_vain(&self, now: Instant) -> bool {
        let since = self.found.map_or(now, |(_, since)| since);
        self.draining && now.saturating_duration_since(since) > DRAINING_MOST
    }

    fn set_rate(&mut self, rate: f64) {
        self.bucket.set_rate(rate.clamp(RATE_LEAST, RATE_MOST));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(start: Instant, ms: u64) -> Instant {
        start + Duration::from_millis(ms)
    }

    /// Packets of 240 bytes: acknowledged and lost bytes, least round-trip time.
    fn noted(acked: u64, lost: u64, rtt: Duration) -> Noted {
        let mut noted = Noted { lost, ..Noted::default() };
        if acked > 0 {
            noted.acknowledge(240, rtt);
        }
        Noted { acked, ..noted }
    }

    /// A path with a queue: `capacity` bytes a second, `rtt` without queue. Gives the rate found and the
    /// greatest standing delay after the first five seconds.
    fn run(capacity: f64, rtt_ms: f64, seconds: u64, start: Instant) -> (f64, f64) {
        let mut governor = Governor::new(0.0, start);
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
            governor.update(noted(served as u64, 0, rtt), now);
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
        let mut governor = Governor::new(0.0, start);
        let rtt = Duration::from_millis(5);
        let mut early = 0.0;
        for tick in 1..=600 {
            let now = at(start, tick * 100);
            let (mut acked, mut lost) = (0, 0);
            // As many messages of 240 bytes as the rate allows in a tenth of a second, which is one or a few.
            for _ in 0..(governor.rate() * 0.1 / 240.0).ceil() as u64 {
                governor.charge(240.0);
                let fate = if random.random_bool(0.3) { &mut lost } else { &mut acked };
                *fate += 240;
            }
            assert!(!governor.delay(Way::Low, now).is_zero(), "the rate is the limit");
            governor.update(noted(acked, lost, rtt), now);
            early = if tick == 50 { governor.rate() } else { early };
        }
        assert!(early > RATE_AT_START, "{early} bytes/s after 5 s");
        assert!(governor.rate() > 2.0 * RATE_AT_START, "{} bytes/s after a minute", governor.rate());
    }

    #[test]
    fn what_a_cut_lost_does_not_slow_the_path_down_after_it() {
        let start = Instant::now();
        let mut governor = Governor::new(0.0, start);
        let up = noted(1_000, 0, Duration::from_millis(40));
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
            let mut governor = Governor::new(0.0, start);
            let rate = governor.rate();
            for tick in 1..=30 {
                // Every tenth look sees but one packet, acknowledged 60 ms late.
                let late = if tick % 10 == 0 { 60 } else { 0 };
                governor.update(noted(800, lost, Duration::from_millis(40 + late)), at(start, tick * 100));
            }
            assert_eq!(governor.rate() < rate, slowed, "{} bytes/s with {lost} lost a look", governor.rate());
        }
    }

    #[test]
    fn silence_is_a_cut_and_an_acknowledgement_ends_it() {
        let start = Instant::now();
        let mut governor = Governor::new(0.0, start);
        for tick in 1..20 {
            governor.update(Noted::default(), at(start, tick * 100));
        }
        assert!(governor.is_cut());
        governor.update(noted(100, 0, Duration::from_millis(10)), at(start, 2_000));
        assert!(!governor.is_cut() && governor.rate() >= RATE_LEAST);
    }

    /// A line of `capacity` bytes a second and 20 ms each way: thirty records a second of 241 bytes, the newest
    /// in place of one that waits, and once a second one of 110. Gives how many of the former arrived in each
    /// second, and how late they were beyond the line's own time, ms.
    fn line(capacity: f64, seconds: u64, start: Instant) -> (Vec<u64>, Vec<f64>) {
        let mut governor = Governor::new(0.0, start);
        let (mut free_ms, mut waits) = (0.0_f64, None);
        let mut flying: Vec<(f64, u64, u64)> = Vec::new();
        let (mut arrived, mut late) = (vec![0; seconds as usize], Vec::new());
        let mut look = Noted::default();
        for ms in 0..seconds * 1_000 {
            let (now, clock) = (at(start, ms), ms as f64);
            if ms % 1_000 * 30 % 1_000 < 30 {
                waits = Some(ms);
            }
            let live = waits.filter(|_| governor.delay(Way::Live, now).is_zero());
            for (born, bytes) in
                [live.map(|born| (born, 241)), (ms % 1_000 == 7).then_some((ms, 110))].into_iter().flatten()
            {
                governor.charge(bytes as f64);
                free_ms = free_ms.max(clock) + bytes as f64 / capacity * 1e3;
                flying.push((free_ms + 40.0, ms, bytes));
                if bytes == 241 {
                    waits = None;
                    arrived[((free_ms + 20.0) as usize / 1_000).min(seconds as usize - 1)] += 1;
                    late.push(free_ms - born as f64);
                }
            }
            flying.retain(|(back, sent, bytes)| {
                if *back <= clock {
                    look.acknowledge(*bytes, Duration::from_millis(ms - sent));
                }
                *back > clock
            });
            if ms % 100 == 99 {
                governor.update(std::mem::take(&mut look), now);
            }
        }
        (arrived, late)
    }

    #[test]
    fn a_slow_line_is_filled_and_no_queue_stands_in_it() {
        // Given: a line that carries 6000 of the 7340 bytes that come a second; 24 records of 241 bytes fit.
        let (arrived, mut late) = line(6_000.0, 60, Instant::now());
        let settled: u64 = arrived[5..].iter().sum();
        assert!(settled as f64 / 55.0 > 20.0, "records a second: {arrived:?}");
        late.sort_by(f64::total_cmp);
        let p99 = late[late.len() * 99 / 100];
        assert!(p99 < 150.0, "{p99} ms late, 40 of them the line's own; median {}", late[late.len() / 2]);
        // Half of a line that carries more is none of its business: everything arrives.
        let (arrived, late) = line(60_000.0, 20, Instant::now());
        assert!(arrived[2..19].iter().all(|n| *n >= 29), "records a second: {arrived:?}");
        assert!(late.iter().filter(|ms| **ms > 10.0).count() <= 5, "late at the start");
    }

    #[test]
    fn a_long_packet_takes_a_slow_line_longer_and_is_no_queue() {
        let start = Instant::now();
        let mut delays = Delays::new(start);
        let mut look = |packets: &[(u64, u64)], ms: u64| {
            let mut noted = Noted::default();
            for (bytes, rtt) in packets {
                noted.acknowledge(*bytes, Duration::from_millis(*rtt));
            }
            delays.look(&noted.least_rtt, false, at(start, ms)).map(|queue| queue.as_millis())
        };
        assert_eq!(look(&[(80, 54)], 100), None, "nothing to compare with");
        assert_eq!(look(&[(240, 81)], 200), None, "the first of its size");
        assert_eq!(look(&[(240, 81), (80, 90)], 300), Some(0));
        assert_eq!(look(&[(240, 121), (80, 94)], 400), Some(40));
        assert_eq!(look(&[(80, 94), (1_100, 400)], 500), Some(40), "a new size hides no queue");
        // A long packet that was quick bounds what a short one takes.
        assert_eq!(look(&[(1_100, 50)], 600), Some(0));
        assert_eq!(look(&[(80, 60)], 700), Some(10));
    }
}
