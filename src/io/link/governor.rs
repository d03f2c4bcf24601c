//! Estimates the rate that a path carries, from delays and losses.
//!
//! The rate grows until a queue begins to stand in the path. Then nothing is sent until the queue has drained, and the
//! rate is set to just below the delivered rate. From there it grows again: slowly at first, faster the longer there is
//! no queue.

use std::time::Duration;

use tokio::time::Instant;

use super::pace::{Bucket, Priority};
use super::sense::{CLASSES, Noted};

/// Standing delay in the path above which the rate is reduced. Well below the 150 ms that live data may be late; above
/// the few milliseconds within which stations are asked to acknowledge.
const QUEUE_LIMIT: Duration = Duration::from_millis(30);
/// On a slow line, a packet that happens to follow this many bytes waits for them without a standing queue.
const BESIDE: f64 = 60.0;
/// Standing delay below which the rate grows.
const QUEUE_EMPTY: Duration = Duration::from_millis(15);
/// Initial rate, bytes a second: enough for two vehicles at 15 Hz, so that on a path that can carry them nothing waits
/// for the search; on the slowest radios the first queue is detected within half a second.
const RATE_AT_START: f64 = 10_000.0;
/// Lowest rate, bytes a second: it detects when the path works again.
const RATE_LEAST: f64 = 1_500.0;
/// Highest rate, bytes a second.
const RATE_MOST: f64 = 50e6;
/// While the capacity of the path is unknown, the rate grows by this share of itself a second.
const GROWTH_MOST: f64 = 5.0;
/// Growth just after the capacity was found; it doubles with every second without a queue.
const GROWTH_LEAST: f64 = 0.05;
/// Share of the delivered rate that is sent after a queue was found.
const FOUND: f64 = 0.95;
/// A delay that pauses do not remove within this time belongs to the path.
const STANDS_MOST: Duration = Duration::from_secs(2);
/// Silence after which the path counts as cut.
const SILENCE: Duration = Duration::from_millis(600);
/// How long the least round-trip times are remembered: at most twice this.
const BASE_MEMORY: Duration = Duration::from_secs(30);
/// Losses from a cut do not count against the path: they are reported within this time of the first acknowledgement.
const FORGIVEN: Duration = Duration::from_millis(400);
/// Time over which losses are compared with arrivals: a slow path carries one or two packets between two updates, and
/// one lost packet does not make a path lossy.
const LOSS_MEMORY_S: f64 = 2.0;
/// Share of losses above which acknowledgements are also lost, so that the least delay of one update may be that of a
/// packet whose own acknowledgement was lost: then the least of the last updates counts.
const LOSSY: f64 = 0.05;
/// Number of those updates.
const LOOKS: usize = 3;

/// Delay above the least of packets of the same size. A slow line takes longer for a long packet: at 48 kbit/s 100
/// bytes more take 17 ms, which is not a queue.
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

    /// The least round-trip time of packets of this or a larger class, over the last half to whole minute.
    fn least(&self, class: usize) -> Option<Duration> {
        self.base.iter().flat_map(|epoch| &epoch[class..]).flatten().min().copied()
    }

    /// The standing delay since the last update; `None` where only new sizes of packets were acknowledged.
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

/// Estimates the rate that a path carries.
#[derive(Clone, Debug)]
pub struct Governor {
    bucket: Bucket,
    /// IP and UDP headers of one packet, bytes.
    headers: f64,
    updated: Instant,
    last_report: Instant,
    delivered: f64,
    /// Recent lost and acknowledged bytes, with exponential forgetting over [`LOSS_MEMORY_S`].
    lost: f64,
    acked: f64,
    delays: Delays,
    queue: Duration,
    /// The delivered rate, bytes a second, when a queue last stood, and the time of it.
    found: Option<(f64, Instant)>,
    /// Since when a queue stands.
    stands: Option<Instant>,
    /// Until this time, acknowledgements are of packets that were sent before the rate changed.
    settled: Instant,
    limited: bool,
    cut: bool,
    restored: Option<Instant>,
}

impl Governor {
    /// For a new connection whose packets have `headers` bytes of IP and UDP headers.
    pub fn new(headers: f64, now: Instant) -> Self {
        Self {
            bucket: Bucket::new(RATE_AT_START, now),
            headers,
            updated: now,
            last_report: now,
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

    /// Allowed rate, bytes a second.
    pub fn rate(&self) -> f64 {
        self.bucket.rate()
    }

    /// Whether the path seems cut: there was no acknowledgement for a while.
    pub fn is_cut(&self) -> bool {
        self.cut
    }

    /// Time until sending is allowed.
    pub fn delay(&mut self, way: Priority, now: Instant) -> Duration {
        let delay = self.bucket.delay(way, now);
        // Half of the debt is an early sign: the first record that waits for the rate would be late.
        self.limited |= !delay.is_zero() || (way == Priority::Live && self.bucket.debt_used(now) > 0.5);
        delay
    }

    /// Accounts for sent bytes.
    pub fn charge(&mut self, bytes: f64) {
        self.bucket.charge(bytes);
    }

    /// Updates the estimate from the acknowledgements since the last call; called about ten times a second.
    pub fn update(&mut self, noted: Noted, now: Instant) {
        let passed = now.saturating_duration_since(self.updated).as_secs_f64().clamp(1e-3, 1.0);
        self.updated = now;
        let limited = std::mem::take(&mut self.limited);
        let kept = (-passed / LOSS_MEMORY_S).exp();
        self.lost = self.lost * kept + noted.lost as f64;
        self.acked = self.acked * kept + noted.acked as f64;
        if noted.acked == 0 {
            if !self.cut && now.saturating_duration_since(self.last_report) > SILENCE + self.queue {
                self.cut = true;
                // The earlier result may be much more than the path carries afterwards.
                self.found = None;
                self.set_rate(self.rate().min(1.5 * RATE_AT_START));
            }
            return;
        }
        self.last_report = now;
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
            // The initial rate is no measure of what was delivered.
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

    /// A queue stands: pauses until it has drained; the result shows after `rtt`.
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
