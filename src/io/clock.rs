//! The only reader of clocks: CLOCK_MONOTONIC plus one constant fixed at start.

use std::time::Duration;

use rustix::time::{ClockId, Timespec, clock_gettime};

use windhover_base::time::{MonoTime, NS_PER_S, Span};

/// Host time of this process. Copies share the same constant, so their times compare.
///
/// The constant is the difference of CLOCK_REALTIME and CLOCK_MONOTONIC when the clock was made: host time is close to
/// UTC where the computer's clock was right at start, and it never steps after that.
#[derive(Clone, Copy, Debug)]
pub struct HostClock {
    host_from_monotonic: Span,
}

impl HostClock {
    /// Fixes the constant. A program does this once, at its start.
    pub fn start() -> Self {
        Self { host_from_monotonic: realtime_from_monotonic() }
    }

    /// The present host time.
    pub fn now(&self) -> MonoTime {
        MonoTime::from_ns(raw(ClockId::Monotonic)) + self.host_from_monotonic
    }

    /// The constant: host time less CLOCK_MONOTONIC.
    pub fn less_monotonic(&self) -> Span {
        self.host_from_monotonic
    }

    /// Host time of a CLOCK_MONOTONIC stamp, as drivers give them.
    pub fn from_monotonic(&self, stamp: Duration) -> MonoTime {
        MonoTime::from_unsigned_ns(stamp.as_nanos()) + self.host_from_monotonic
    }

    /// Host time of a recent CLOCK_REALTIME stamp, as from the kernel's pulse-per-second. The realtime clock may have
    /// been stepped since the start, so its present difference is measured again.
    pub fn from_realtime(&self, stamp: Duration) -> MonoTime {
        let realtime = MonoTime::from_unsigned_ns(stamp.as_nanos());
        realtime - realtime_from_monotonic() + self.host_from_monotonic
    }

    /// Processor time this process has used, all threads.
    pub fn processor_time() -> Span {
        Span::from_ns(raw(ClockId::ProcessCPUTime))
    }

    /// Processor time the calling thread has used.
    pub fn thread_processor_time() -> Span {
        Span::from_ns(raw(ClockId::ThreadCPUTime))
    }
}

fn ns(stamp: Timespec) -> i64 {
    stamp.tv_sec.saturating_mul(NS_PER_S).saturating_add(stamp.tv_nsec)
}

fn raw(clock: ClockId) -> i64 {
    ns(clock_gettime(clock))
}

/// CLOCK_REALTIME minus CLOCK_MONOTONIC: the former is read between two readings of the latter.
fn realtime_from_monotonic() -> Span {
    let before = raw(ClockId::Monotonic);
    let realtime = raw(ClockId::Realtime);
    let after = raw(ClockId::Monotonic);
    Span::from_ns(realtime - (before + (after - before) / 2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn goes_forward_and_converts_stamps() {
        let clock = HostClock::start();
        let first = clock.now();
        let stamp = Duration::from_nanos(raw(ClockId::Monotonic) as u64);
        let second = clock.now();
        let converted = clock.from_monotonic(stamp);
        assert!(first <= converted && converted <= second, "{first:?} {converted:?} {second:?}");
    }

    #[test]
    fn realtime_stamps_land_on_the_same_scale() {
        let clock = HostClock::start();
        let stamp = Duration::from_nanos(raw(ClockId::Realtime) as u64);
        let distance = clock.now() - clock.from_realtime(stamp);
        assert!(distance.abs() < Span::from_ms(50.0), "{distance:?}");
    }
}
