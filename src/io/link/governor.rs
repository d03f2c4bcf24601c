//! What a path is found to carry, from the delays and losses on it.
//!
//! The rate grows until data begins to stand in the path. Then nothing is sent until that is gone, the rate
//! goes to just under what was delivered, and from there more is tried: little at first, the longer nothing
//! stands the more.

use std::time::Duration;

use tokio::time::Instant;

use super::pace::{Bucket, Way};
use super::sense::{CLASSES, Noted};

/// Standing delay in the path above which less is sent. Well under the 150 ms that live data may be late at;
/// above the few milliseconds by which stations are asked to acknowledge at the latest.
const QUEUE_LIMIT: Duration = Duration::from_millis(30);
/// A packet that happens to come behind this many bytes waits for them on a slow line, and no queue stands.
const BESIDE: f64 = 60.0;
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
/// Share of what was delivered that is sent once a queue was found.
const FOUND: f64 = 0.95;
/// A delay that pauses do not end in this time is the path's own.
const STANDS_MOST: Duration = Duration::from_secs(2);
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
    /// Since when a queue stands.
    stands: Option<Instant>,
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
            stands: None,
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
        let beside = Duration::from_secs_f64(BESIDE / self.delivered.max(RATE_LEAST));
        let stands = self.queue > QUEUE_LIMIT + beside;
        if stands && self.found.is_none() {
            // What the search began with is no measure of what was delivered.
            self.delivered = arrived / passed;
        }
        if self.lost > self.acked {
            self.set_rate(self.rate().min(self.delivered));
        } else if now >= self.settled {
            let rtt = noted.least_rtt.iter().flatten().min().copied().unwrap_or_default();
            if stands {
                self.drain(rtt, now);
            } else {
                self.stands = None;
                self.grow(limited, passed, now);
            }
        }
    }

    /// A queue stands: pauses until it is gone, `rtt` after which this shows.
    fn drain(&mut self, rtt: Duration, now: Instant) {
        let since = *self.stands.get_or_insert(now);
        if now.saturating_duration_since(since) > STANDS_MOST {
            self.delays = Delays::new(now);
            self.stands = None;
            self.queue = Duration::ZERO;
            return;
        }
        let carried = self.rate().min(self.delivered).max(RATE_LEAST);
        self.found = Some((carried, now));
        self.settled = now + rtt;
        self.set_rate(FOUND * carried);
        self.bucket.pause(carried * self.queue.as_secs_f64(), now);
    }

    fn grow(&mut self, limited: bool, passed: f64, now: Instant) {
        if self.queue >= QUEUE_EMPTY || !limited {
            return;
        }
        let growth = self.found.map_or(GROWTH_MOST, |(_, at)| {
            let seconds = now.saturating_duration_since(at).as_secs_f64();
            (GROWTH_LEAST * seconds.min(10.0).exp2()).min(GROWTH_MOST)
        });
        let grown = self.rate() * (1.0 + growth * passed);
        self.set_rate(grown.min(self.rate().max(1.5 * self.delivered + 1_000.0)));
    }

    fn set_rate(&mut self, rate: f64) {
        self.bucket.set_rate(rate.clamp(RATE_LEAST, RATE_MOST));
    }
}

#[cfg(test)]
#[path = "governor_tests.rs"]
mod tests;
