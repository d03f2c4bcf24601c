//! The station's requests, and which of them were already sent.

use std::collections::BTreeMap;

use crate::io::link::backlog::Extent;
use crate::io::link::ranges::RangeSet;
use crate::io::proto::link as pb;

/// Most ranges that a station may request at once; more would only repeat records.
const WANT_LIMIT: usize = 1_024;

/// The requested numbers, and those already sent on a stream of this connection (which QUIC delivers).
#[derive(Default)]
pub(super) struct Wanted {
    open: BTreeMap<u32, RangeSet>,
    sent: BTreeMap<u32, RangeSet>,
    /// The first existing number of each run, and one more than the last.
    there: BTreeMap<u32, (u32, u32)>,
}

impl Wanted {
    /// Replaces the request; `there` is what the payload has.
    pub(super) fn replace(&mut self, ranges: &[pb::Range], there: &[Extent]) {
        self.there = there.iter().map(|extent| (extent.run, (extent.first, extent.end))).collect();
        self.open.clear();
        for range in ranges.iter().take(WANT_LIMIT) {
            let open = self.open.entry(range.run).or_default();
            match self.sent.get(&range.run) {
                Some(sent) => {
                    let rest = sent.missing(range.first, range.end);
                    rest.for_each(|(first, end)| open.insert_range(first, end));
                }
                None => open.insert_range(range.first, range.end),
            }
        }
    }

    /// The first range still to be sent.
    pub(super) fn first(&self) -> Option<(u32, u32, u32)> {
        self.open.iter().find_map(|(run, set)| set.iter().next().map(|(first, end)| (*run, first, end)))
    }

    /// These were sent on the stream.
    pub(super) fn done(&mut self, run: u32, first: u32, end: u32) {
        if let Some(open) = self.open.get_mut(&run) {
            open.remove_range(first, end);
        }
        // Only existing numbers are remembered: unknown ones can be requested without limit.
        if let Some((held, held_end)) = self.there.get(&run) {
            self.sent.entry(run).or_default().insert_range(first.max(*held), end.min(*held_end));
        }
    }

    /// They cannot be answered now; the station requests them again.
    pub(super) fn postpone(&mut self, run: u32, first: u32, end: u32) {
        if let Some(open) = self.open.get_mut(&run) {
            open.remove_range(first, end);
        }
    }

    /// Number of records still to be sent.
    pub(super) fn count(&self) -> u64 {
        self.open.values().map(RangeSet::len).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn range(first: u32, end: u32) -> pb::Range {
        pb::Range { run: 3, first, end }
    }

    #[test]
    fn what_went_is_not_sent_again_and_what_was_postponed_is() {
        let mut wanted = Wanted::default();
        let there = [Extent { run: 3, flight: "boot-3".into(), first: 0, end: 10 }];
        wanted.replace(&[range(0, 10)], &there);
        wanted.done(3, 0, 4);
        assert_eq!(wanted.first(), Some((3, 4, 10)));
        wanted.postpone(3, 4, 8);
        assert_eq!((wanted.first(), wanted.count()), (Some((3, 8, 10)), 2));
        wanted.replace(&[range(0, 10)], &there);
        assert_eq!(wanted.first(), Some((3, 4, 10)), "requested again");
    }

    #[test]
    fn what_is_nowhere_takes_no_memory() {
        let mut wanted = Wanted::default();
        let there = [Extent { run: 3, flight: "boot-3".into(), first: 50_000, end: 50_010 }];
        for n in 0..10_000 {
            // Runs that never existed, and numbers before the existing ones, each apart from the others.
            let asked = [pb::Range { run: n + 4, first: 2 * n, end: 2 * n + 1 }, range(2 * n, 2 * n + 1)];
            wanted.replace(&asked, &there);
            while let Some((run, first, end)) = wanted.first() {
                wanted.done(run, first, end);
            }
        }
        wanted.done(3, 49_990, 50_020);
        assert_eq!(wanted.sent.values().map(RangeSet::ranges).sum::<usize>(), 1);
        assert_eq!((wanted.sent[&3].len(), wanted.open.len()), (10, 2));
    }
}
