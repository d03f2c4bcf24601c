//! What is current and what is not: age and status of everything that the station shows.

use tokio::time::Instant;

use crate::io::proto::windhover::TrackStatus;
use windhover_base::time::{MonoTime, Span, UtcTime};

/// The state of a visible vehicle is at most this old; an older one is treated as a prediction.
pub(super) const FRESH: Span = Span::from_ns(1_500_000_000);
/// A state older than this is not a current position. It is shown as the last known place.
pub(super) const CURRENT: Span = Span::from_ns(3_000_000_000);

/// The name of a status at an age.
pub(super) fn status_at(status: TrackStatus, age: Span) -> &'static str {
    match status {
        TrackStatus::Lost => "lost",
        _ if age > CURRENT => "lost",
        TrackStatus::Acquiring if age <= FRESH => "acquiring",
        TrackStatus::Acquiring => "lost",
        TrackStatus::Tracking if age <= FRESH => "tracking",
        TrackStatus::Tracking | TrackStatus::Coasting => "coasting",
    }
}

/// A payload's clock as seen from here: the newest host time received and when it was received; and the difference to
/// UTC by the payload's receiver.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PayloadClock {
    newest: Option<(MonoTime, Instant)>,
    utc_minus_host: Option<Span>,
}

impl PayloadClock {
    /// Something of this host time was received at `came`.
    pub(super) fn received(&mut self, t: MonoTime, came: Instant) {
        if self.newest.is_none_or(|(newest, _)| t > newest) {
            self.newest = Some((t, came));
        }
    }

    /// The payload reported UTC.
    pub(super) fn reported_utc(&mut self, utc_minus_host: Span) {
        self.utc_minus_host = Some(utc_minus_host);
    }

    /// The payload's host time now, as far as it can be known here: transmission makes it later.
    pub(super) fn at(&self, now: Instant) -> Option<MonoTime> {
        let (newest, came) = self.newest?;
        Some(newest + Span::from_s(now.saturating_duration_since(came).as_secs_f64()))
    }

    /// The present age of something of this host time.
    pub(super) fn age(&self, t: MonoTime, now: Instant) -> Span {
        self.at(now).map_or(Span::ZERO, |now| (now - t).max(Span::ZERO))
    }

    /// UTC of a host time; `None` where the payload's receiver has not reported it.
    pub(super) fn utc(&self, t: MonoTime) -> Option<UtcTime> {
        self.utc_minus_host.map(|ahead| UtcTime::from_unix_ns(t.ns().saturating_add(ahead.ns())))
    }

    /// UTC less host time, milliseconds.
    pub(super) fn utc_minus_host_ms(&self) -> Option<f64> {
        self.utc_minus_host.map(|ahead| ahead.ms())
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_state_that_is_not_renewed_is_guessed_and_then_lost() {
        use TrackStatus::{Acquiring, Coasting, Lost, Tracking};
        let over = |status| [0.0, 1.4, 1.6, 3.1, 60.0].map(|s| status_at(status, Span::from_s(s)));
        assert_eq!(over(Tracking), ["tracking", "tracking", "coasting", "lost", "lost"]);
        assert_eq!(over(Coasting), ["coasting", "coasting", "coasting", "lost", "lost"]);
        assert_eq!(over(Acquiring), ["acquiring", "acquiring", "lost", "lost", "lost"]);
        assert_eq!(over(Lost), ["lost"; 5]);
    }

    #[test]
    fn age_counts_from_the_newest_that_came() {
        let at = |s: f64| MonoTime::default() + Span::from_s(s);
        let mut clock = PayloadClock::default();
        let came = Instant::now();
        assert_eq!((clock.at(came), clock.utc(at(1.0))), (None, None));
        clock.received(at(100.0), came);
        clock.received(at(90.0), came + Duration::from_secs(1));
        let now = came + Duration::from_secs(5);
        assert!((clock.age(at(99.0), now) - Span::from_s(6.0)).abs() < Span::from_ms(1.0));
        assert_eq!(clock.age(at(200.0), now), Span::ZERO);
        clock.reported_utc(Span::from_s(1_000_000.0));
        assert_eq!(clock.utc(at(1.0)).map(UtcTime::unix_ns), Some(1_000_001_000_000_000));
    }
}
