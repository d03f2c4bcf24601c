//! What a station asked for again, and what of it already went.

use std::collections::BTreeMap;

use crate::io::link::ranges::RangeSet;
use crate::io::proto::link as pb;

/// Ranges a station may ask for at once; more would only be sent again.
const WANT_LIMIT: usize = 1_024;

/// What the station asked for, and what already went on a stream of this connection (which QUIC delivers).
#[derive(Default)]
pub(super) struct Wanted {
    open: BTreeMap<u32, RangeSet>,
    sent: BTreeMap<u32, RangeSet>,
}

impl Wanted {
    /// Replaces what was asked for.
    pub(super) fn replace(&mut self, ranges: &[pb::Range]) {
        self.open.clear();
        for range in ranges.iter().take(WANT_LIMIT) {
            let sent = self.sent.entry(range.run).or_default();
            let open = self.open.entry(range.run).or_default();
            for (first, end) in sent.missing(range.first, range.end) {
                open.insert_range(first, end);
            }
        }
    }

    /// The first range still to be sent.
    pub(super) fn first(&self) -> Option<(u32, u32, u32)> {
        self.open.iter().find_map(|(run, set)| set.iter().next().map(|(first, end)| (*run, first, end)))
    }

    /// They went on the stream.
    pub(super) fn done(&mut self, run: u32, first: u32, end: u32) {
        if let Some(open) = self.open.get_mut(&run) {
            open.remove_range(first, end);
        }
        self.sent.entry(run).or_default().insert_range(first, end);
    }

    /// They cannot be answered now; the station asks again.
    pub(super) fn postpone(&mut self, run: u32, first: u32, end: u32) {
        if let Some(open) = self.open.get_mut(&run) {
            open.remove_range(first, end);
        }
    }

    /// How many are still to be sent.
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
        wanted.replace(&[range(0, 10)]);
        wanted.done(3, 0, 4);
        assert_eq!(wanted.first(), Some((3, 4, 10)));
        wanted.postpone(3, 4, 8);
        assert_eq!((wanted.first(), wanted.count()), (Some((3, 8, 10)), 2));
        wanted.replace(&[range(0, 10)]);
        assert_eq!(wanted.first(), Some((3, 4, 10)), "asked for again");
    }
}
