//! When time passes: the instants at which the pipeline looks at time-outs, live and in replay alike.

use windhover_base::time::{MonoTime, Span};

/// Time between two ticks.
const TICK: Span = Span::from_ns(100_000_000);

/// Ticks at whole multiples of [`TICK`] of host time, between one event and the next. They follow from
/// the events' times alone, so a replay has the same ones at the same places.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Ticks {
    last: Option<MonoTime>,
}

impl Ticks {
    /// Instants after the last call's `t` and not after this one's, in order. A gap of more than ten
    /// seconds gets its last hundred ticks only.
    pub(super) fn until(&mut self, t: MonoTime) -> impl Iterator<Item = MonoTime> + use<> {
        const MOST: i64 = 100;
        let from = self.last.map_or_else(|| grid(t), grid);
        let to = grid(t).max(from);
        self.last = Some(self.last.map_or(t, |last| last.max(t)));
        (from.max(to - MOST) + 1..=to).map(|n| MonoTime::from_ns(n * TICK.ns()))
    }

    /// The latest instant that is due at `now` and was not passed yet. The first call begins the count.
    pub(super) fn due(&mut self, now: MonoTime) -> Option<MonoTime> {
        let passed = grid(*self.last.get_or_insert(now));
        (grid(now) > passed).then(|| MonoTime::from_ns(grid(now) * TICK.ns()))
    }
}

/// The first tick after `now`: so long whoever feeds the pipeline may wait for an event.
pub fn next_tick(now: MonoTime) -> MonoTime {
    MonoTime::from_ns((grid(now) + 1) * TICK.ns())
}

/// Ticks from zero to `t`.
fn grid(t: MonoTime) -> i64 {
    t.ns().div_euclid(TICK.ns())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_follow_from_the_times_of_events() {
        let at = |ms: i64| MonoTime::from_ns(ms * 1_000_000);
        let run = |events: &[i64]| {
            let mut ticks = Ticks::default();
            events.iter().flat_map(|&ms| ticks.until(at(ms))).map(|t| t.ns() / 1_000_000).collect::<Vec<_>>()
        };
        assert_eq!(run(&[1_250, 1_260, 1_400, 1_650]), [1_300, 1_400, 1_500, 1_600]);
        // More frequent looks give the same ticks.
        let often: Vec<i64> = (1_250..=1_650).step_by(7).chain([1_650]).collect();
        assert_eq!(run(&often), [1_300, 1_400, 1_500, 1_600]);
        assert_eq!(run(&[1_000, 900, 1_050]), Vec::<i64>::new());
        assert_eq!(run(&[0, 3_600_000]).len(), 100);
    }

    #[test]
    fn a_tick_is_due_once() {
        let at = |ms: i64| MonoTime::from_ns(ms * 1_000_000);
        let mut ticks = Ticks::default();
        assert_eq!(ticks.due(at(1_250)), None, "time begins to count");
        assert_eq!(ticks.due(at(1_290)), None);
        let due = ticks.due(at(1_530)).expect("two are");
        assert_eq!(due, at(1_500));
        assert_eq!(ticks.until(due).collect::<Vec<_>>(), [at(1_300), at(1_400), at(1_500)]);
        assert_eq!((ticks.due(at(1_590)), next_tick(at(1_590))), (None, at(1_600)));
        assert_eq!(ticks.due(at(1_600)), Some(at(1_600)));
    }
}
