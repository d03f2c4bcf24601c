//! When time passes: the instants at which the pipeline is told so, live and in replay alike.

use windhover_base::time::{MonoTime, Span};

/// Time between two ticks.
pub const TICK: Span = Span::from_ns(100_000_000);

/// Ticks at whole multiples of [`TICK`] of host time, between one event and the next. They follow from
/// the events' times alone, so a replay has the same ones at the same places.
#[derive(Clone, Copy, Debug, Default)]
pub struct Ticks {
    last: Option<MonoTime>,
}

impl Ticks {
    /// Instants after the last call's `t` and not after this one's, in order. A gap of more than ten
    /// seconds gets its last hundred ticks only.
    pub fn until(&mut self, t: MonoTime) -> impl Iterator<Item = MonoTime> + use<> {
        const MOST: i64 = 100;
        let grid = |t: MonoTime| t.ns().div_euclid(TICK.ns());
        let from = self.last.map_or_else(|| grid(t), grid);
        let to = grid(t).max(from);
        self.last = Some(self.last.map_or(t, |last| last.max(t)));
        (from.max(to - MOST) + 1..=to).map(|n| MonoTime::from_ns(n * TICK.ns()))
    }
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
}
