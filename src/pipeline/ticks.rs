//! When time passes: the instants at which the pipeline acts by itself, live and in replay alike.

use windhover_base::time::{MonoTime, Span};

/// Time between two checks of time-outs.
const TIME_OUTS: Span = Span::from_ns(100_000_000);

/// In a gap between two events, everything that time alone causes has happened after this long: the filter gives up
/// after a minute.
const EVENTFUL: Span = Span::from_ns(120_000_000_000);

/// What is due at an instant; at the same instant in this order.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(super) enum Due {
    /// Time-outs are checked.
    TimeOuts,
    /// The helicopter's own state is output.
    Ownship,
}

/// Instants at whole multiples of a period of host time, between one event and the next. They depend on the events'
/// times only, so a replay has the same instants at the same places.
#[derive(Clone, Copy, Debug)]
struct Ticks {
    period: Span,
    last: Option<MonoTime>,
}

impl Ticks {
    fn every(period: Span) -> Self {
        Self { period, last: None }
    }

    /// Instants after the `t` of the last call up to and including this one's, in order. In a longer gap only those of
    /// its first [`EVENTFUL`] are given.
    fn until(&mut self, t: MonoTime) -> impl Iterator<Item = MonoTime> + use<> {
        let (most, period) = (EVENTFUL.ns() / self.period.ns(), self.period);
        let from = self.last.map_or_else(|| self.grid(t), |last| self.grid(last));
        let to = self.grid(t).max(from);
        self.last = Some(self.last.map_or(t, |last| last.max(t)));
        (from + 1..=to.min(from + most)).map(move |n| MonoTime::from_ns(n * period.ns()))
    }

    /// The latest instant that is due at `now` and has not passed yet. The first call begins the count.
    fn due(&mut self, now: MonoTime) -> Option<MonoTime> {
        let passed = *self.last.get_or_insert(now);
        let due = self.grid(now);
        (due > self.grid(passed)).then(|| MonoTime::from_ns(due * self.period.ns()))
    }

    /// The first instant after `now`.
    fn next(&self, now: MonoTime) -> MonoTime {
        MonoTime::from_ns((self.grid(now) + 1) * self.period.ns())
    }

    /// Number of periods from zero to `t`.
    fn grid(&self, t: MonoTime) -> i64 {
        t.ns().div_euclid(self.period.ns())
    }
}

/// Everything that is due by time alone.
#[derive(Clone, Copy, Debug)]
pub(super) struct Schedule {
    time_outs: Ticks,
    ownship: Ticks,
}

impl Schedule {
    /// With the helicopter's own state `ownship_hz` times a second.
    pub(super) fn new(ownship_hz: f64) -> Self {
        Self { time_outs: Ticks::every(TIME_OUTS), ownship: Ticks::every(Span::from_s(1.0 / ownship_hz)) }
    }

    /// What became due after the `t` of the last call up to and including this one's, in order.
    pub(super) fn until(&mut self, t: MonoTime) -> Vec<(MonoTime, Due)> {
        let time_outs = self.time_outs.until(t).map(|t| (t, Due::TimeOuts));
        let mut due: Vec<_> = time_outs.chain(self.ownship.until(t).map(|t| (t, Due::Ownship))).collect();
        due.sort_unstable();
        due
    }

    /// The latest instant at which something is due at `now` and has not passed yet. The first call begins the count.
    pub(super) fn due(&mut self, now: MonoTime) -> Option<MonoTime> {
        self.time_outs.due(now).max(self.ownship.due(now))
    }

    /// The first instant after `now` at which something is due.
    pub(super) fn next(&self, now: MonoTime) -> MonoTime {
        self.time_outs.next(now).min(self.ownship.next(now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64) -> MonoTime {
        MonoTime::from_ns(ms * 1_000_000)
    }

    #[test]
    fn ticks_follow_from_the_times_of_events() {
        let run = |events: &[i64]| {
            let mut ticks = Ticks::every(TIME_OUTS);
            events.iter().flat_map(|&ms| ticks.until(at(ms))).map(|t| t.ns() / 1_000_000).collect::<Vec<_>>()
        };
        assert_eq!(run(&[1_250, 1_260, 1_400, 1_650]), [1_300, 1_400, 1_500, 1_600]);
        // More frequent calls give the same ticks.
        let often: Vec<i64> = (1_250..=1_650).step_by(7).chain([1_650]).collect();
        assert_eq!(run(&often), [1_300, 1_400, 1_500, 1_600]);
        assert_eq!(run(&[1_000, 900, 1_050]), Vec::<i64>::new());
        assert_eq!(run(&[0, 3_600_000]).len(), 1_200);
    }

    #[test]
    fn a_tick_is_due_once() {
        let mut ticks = Ticks::every(TIME_OUTS);
        assert_eq!(ticks.due(at(1_250)), None, "time begins to count");
        assert_eq!(ticks.due(at(1_290)), None);
        let due = ticks.due(at(1_530)).expect("two are");
        assert_eq!(due, at(1_500));
        assert_eq!(ticks.until(due).collect::<Vec<_>>(), [at(1_300), at(1_400), at(1_500)]);
        assert_eq!((ticks.due(at(1_590)), ticks.next(at(1_590))), (None, at(1_600)));
        assert_eq!(ticks.due(at(1_600)), Some(at(1_600)));
    }

    #[test]
    fn two_rhythms_are_one_row_of_instants() {
        let mut schedule = Schedule::new(20.0);
        assert_eq!(schedule.until(at(1_010)), []);
        let (time_outs, ownship) = (Due::TimeOuts, Due::Ownship);
        let want = [(1_050, ownship), (1_100, time_outs), (1_100, ownship), (1_150, ownship)];
        assert_eq!(schedule.next(at(1_010)), at(1_050));
        assert_eq!(schedule.due(at(1_160)), Some(at(1_150)));
        assert_eq!(schedule.until(at(1_160)), want.map(|(ms, due)| (at(ms), due)));
        assert_eq!((schedule.due(at(1_199)), schedule.next(at(1_160))), (None, at(1_200)));
    }
}
