//! A station's numbers of a payload: each at most once, and those that are still missing.

use std::collections::BTreeMap;

use super::ranges::RangeSet;
use crate::io::proto::link as pb;

/// Ranges in one request.
const WANT_RANGES: usize = 64;
/// Which of the latest checks determines the requested numbers: the last but one.
const SETTLED: usize = OVERDUE_LOOKS - 2;
/// Checks after which a missing number is overdue: two seconds of them. Records that only go by back-fill take about
/// one second.
const OVERDUE_LOOKS: usize = 8;
/// Most runs that are tracked; a payload that announces more is ignored.
const RUNS: usize = 4_096;

/// One run of a payload.
#[derive(Clone, Debug, Default)]
struct RunNumbers {
    flight: String,
    first: u32,
    end: u32,
    /// `end` at the latest checks, oldest first: younger numbers may still be on their way.
    ends: [u32; OVERDUE_LOOKS],
    have: RangeSet,
    gone: RangeSet,
    stored: RangeSet,
}

impl RunNumbers {
    /// The missing numbers below a given one.
    fn missing(&self, end: u32) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.have.missing(self.first.max(self.gone_below()), end)
    }

    fn count_missing(&self, end: u32) -> u64 {
        self.missing(end).map(|(first, end)| u64::from(end - first)).sum()
    }

    /// Everything below this no longer exists or was never announced.
    fn gone_below(&self) -> u32 {
        self.gone.iter().next().filter(|&(first, _)| first == 0).map_or(0, |(_, end)| end)
    }
}

/// How complete a station is for one payload.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Progress {
    /// Records received, each counted once.
    pub received: u64,
    /// Records that exist and are not received, including those on their way.
    pub missing: u64,
    /// Those of them that have been known for two seconds and more: while a flight continues, "nothing missing" means
    /// that there are none.
    pub overdue: u64,
    /// Records that no longer exist on board.
    pub gone: u64,
    /// Records that arrived again and were dropped.
    pub repeated: u64,
}

/// Everything a station knows of one payload's numbers.
#[derive(Clone, Debug, Default)]
pub struct ReceivedNumbers {
    runs: BTreeMap<u32, RunNumbers>,
    repeated: u64,
}

impl ReceivedNumbers {
    /// Handles a payload's announcement of a run. The numbers that earlier runs of the station stored are asked for
    /// once (`recall`, by flight and run).
    pub fn announce(&mut self, extent: &pb::Extent, recall: impl FnOnce(&str, u32) -> RangeSet) {
        if !self.runs.contains_key(&extent.run) {
            if self.runs.len() >= RUNS {
                return;
            }
            let have = recall(&extent.flight, extent.run);
            let run = RunNumbers {
                stored: have.clone(),
                have,
                flight: extent.flight.clone(),
                ..RunNumbers::default()
            };
            self.runs.insert(extent.run, run);
        }
        if let Some(run) = self.runs.get_mut(&extent.run) {
            run.first = extent.first;
            run.end = run.end.max(extent.end);
        }
    }

    /// Takes a number; returns whether it is new and the run is known.
    pub fn take(&mut self, run: u32, number: u32) -> bool {
        let Some(run) = self.runs.get_mut(&run) else { return false };
        let fresh = run.have.insert(number);
        self.repeated += u64::from(!fresh);
        run.end = run.end.max(number.saturating_add(1));
        fresh
    }

    /// These numbers no longer exist on board.
    pub fn gone(&mut self, range: &pb::Range) {
        let Some(run) = self.runs.get_mut(&range.run) else { return };
        let end = range.end.min(run.end);
        let missing: Vec<_> = run.have.missing(range.first, end).collect();
        for (first, end) in missing {
            run.gone.insert_range(first, end);
            run.have.insert_range(first, end);
            run.stored.insert_range(first, end);
        }
    }

    /// Name of a run's flight.
    pub fn flight(&self, run: u32) -> Option<&str> {
        self.runs.get(&run).map(|run| run.flight.as_str())
    }

    /// These numbers are on the station's disk.
    pub fn stored(&mut self, run: u32, numbers: &RangeSet) {
        if let Some(run) = self.runs.get_mut(&run) {
            run.stored.union(numbers);
        }
    }

    /// These numbers are not on the station's disk, or no longer: as if they had never arrived.
    pub fn forget(&mut self, run: u32, numbers: &RangeSet) {
        let Some(run) = self.runs.get_mut(&run) else { return };
        for (first, end) in numbers.iter() {
            run.have.remove_range(first, end);
            run.stored.remove_range(first, end);
        }
    }

    /// The numbers to report as stored. The ranges of the oldest numbers are enough for the payload's cursor.
    pub fn stored_message(&self) -> pb::Stored {
        let ranges = self.runs.iter().flat_map(|(run, r)| {
            r.stored.iter().take(4).map(|(first, end)| pb::Range { run: *run, first, end })
        });
        pb::Stored { ranges: ranges.take(WANT_RANGES).collect() }
    }

    /// The numbers to request: everything missing that had time to arrive by itself, oldest first. Each call is a
    /// check: numbers that appeared since the last but one are given time.
    pub fn want(&mut self) -> pb::Want {
        for run in self.runs.values_mut() {
            run.ends.rotate_left(1);
            run.ends[OVERDUE_LOOKS - 1] = run.end;
        }
        let ranges = self.runs.iter().flat_map(|(run, r)| {
            r.missing(r.ends[SETTLED]).map(|(first, end)| pb::Range { run: *run, first, end })
        });
        pb::Want { ranges: ranges.take(WANT_RANGES).collect() }
    }

    /// How complete it is.
    pub fn progress(&self) -> Progress {
        let mut progress = Progress { repeated: self.repeated, ..Progress::default() };
        for run in self.runs.values() {
            progress.gone += run.gone.len();
            progress.received += run.have.len() - run.gone.len();
            progress.missing += run.count_missing(run.end);
            progress.overdue += run.count_missing(run.ends[0]);
        }
        progress
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn extent(first: u32, end: u32) -> pb::Extent {
        pb::Extent { run: 5, flight: "boot-5".into(), first, end }
    }

    fn ranges(want: &pb::Want) -> Vec<(u32, u32)> {
        want.ranges.iter().map(|r| (r.first, r.end)).collect()
    }

    #[test]
    fn what_is_young_is_given_time_and_what_is_missing_is_asked_for() {
        let mut received = ReceivedNumbers::default();
        received.announce(&extent(0, 10), |_, _| RangeSet::of(0, 3));
        assert!(ranges(&received.want()).is_empty(), "a first check requests nothing");
        assert!(received.take(5, 12), "live");
        assert!(!received.take(5, 12), "the same again");
        assert!(!received.take(5, 1), "stored in an earlier run");
        assert_eq!(ranges(&received.want()), [(3, 10)]);
        assert_eq!(ranges(&received.want()), [(3, 12)]);
        for number in 3..9 {
            assert!(received.take(5, number));
        }
        received.gone(&pb::Range { run: 5, first: 9, end: 12 });
        assert!(ranges(&received.want()).is_empty());
        let progress = received.progress();
        assert_eq!((progress.received, progress.missing, progress.gone, progress.repeated), (10, 0, 3, 2));
    }

    #[test]
    fn what_is_missing_becomes_overdue_with_time() {
        let mut received = ReceivedNumbers::default();
        received.announce(&extent(0, 10), |_, _| RangeSet::of(0, 6));
        let progress =
            |received: &ReceivedNumbers| (received.progress().missing, received.progress().overdue);
        for _ in 1..OVERDUE_LOOKS {
            received.want();
            assert_eq!(progress(&received), (4, 0));
        }
        received.take(5, 11);
        received.want();
        assert_eq!(progress(&received), (5, 4), "10 is still young");
        received.take(5, 6);
        assert_eq!(progress(&received), (4, 3));
    }

    #[test]
    fn a_payload_cannot_make_it_grow_without_bound_or_declare_the_future_gone() {
        let mut received = ReceivedNumbers::default();
        for run in 0..2 * RUNS as u32 {
            received.announce(&pb::Extent { run, ..extent(0, 1) }, |_, _| RangeSet::new());
        }
        assert_eq!(received.runs.len(), RUNS);
        received.gone(&pb::Range { run: 0, first: 0, end: u32::MAX });
        assert!(received.take(0, 1), "only what was announced can be gone");
    }

    #[test]
    fn what_the_disk_did_not_keep_is_asked_for_again() {
        let mut received = ReceivedNumbers::default();
        received.announce(&extent(0, 6), |_, _| RangeSet::new());
        (0..6).for_each(|number| assert!(received.take(5, number)));
        received.stored(5, &RangeSet::of(0, 6));
        received.forget(5, &RangeSet::of(2, 4));
        assert_eq!(received.stored_message().ranges.len(), 2);
        (0..4).for_each(|_| drop(received.want()));
        assert_eq!(ranges(&received.want()), [(2, 4)]);
        assert!(received.take(5, 2), "it is new again");
    }

    #[test]
    fn stored_is_what_is_on_disk_only() {
        let mut received = ReceivedNumbers::default();
        received.announce(&extent(0, 10), |_, _| RangeSet::new());
        for number in 0..6 {
            received.take(5, number);
        }
        received.stored(5, &RangeSet::of(0, 4));
        assert_eq!(received.stored_message().ranges, [pb::Range { run: 5, first: 0, end: 4 }]);
    }

    proptest::proptest! {
        #[test]
        fn nothing_is_taken_twice(numbers in proptest::collection::vec(0_u32..50, 0..200)) {
            let mut received = ReceivedNumbers::default();
            received.announce(&extent(0, 0), |_, _| RangeSet::new());
            let mut taken = std::collections::BTreeSet::new();
            for number in numbers {
                proptest::prop_assert_eq!(received.take(5, number), taken.insert(number));
            }
            let progress = received.progress();
            proptest::prop_assert_eq!(progress.received, taken.len() as u64);
            let end = taken.last().map_or(0, |n| u64::from(*n) + 1);
            proptest::prop_assert_eq!(progress.received + progress.missing, end);
        }
    }
}
