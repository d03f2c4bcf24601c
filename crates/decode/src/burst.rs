//! The order of sentences in a device's burst, learnt from the stream: which sentence ends a cycle, and which ones come
//! before the time of their burst.

use super::lines::LineSpan;
use windhover_base::time::Span;

/// Bytes of an address that distinguish sentences.
type Address = [u8; 6];
/// Most sentence types that are remembered; no receiver sends more.
const ADDRESSES_MAX: usize = 48;
/// Most sentences remembered since the last one with a time.
const SINCE_MAX: usize = 48;
/// A shorter silence is not evaluated.
const SILENCE_MIN: Span = Span::from_ns(20_000_000);
/// Largest number of votes.
const VOTES_MAX: i8 = 8;
/// Votes after which a sentence is assumed to lead its burst.
const VOTES_LEADING: i8 = 2;

/// Which sentences come before the first one with a time in a burst.
///
/// A sentence without time between two of different times belongs to the nearer burst: the longer silence is between
/// the bursts. Single silences may mislead (the host stalls), so each one is only a vote; without votes, as in files,
/// sentences follow the time to which they belong.
#[derive(Clone, Debug, Default)]
pub(super) struct BurstOrder {
    votes: Vec<(Address, i8)>,
    since: Vec<Arrival>,
    last: Option<LineSpan>,
}

#[derive(Clone, Copy, Debug)]
struct Arrival {
    address: Address,
    silence_before: Span,
    span: LineSpan,
}

fn key(address: &str) -> Address {
    let mut key = Address::default();
    for (to, from) in key.iter_mut().zip(address.bytes()) {
        *to = from;
    }
    key
}

impl BurstOrder {
    /// Takes a valid sentence of any kind, in order of arrival.
    pub(super) fn received(&mut self, address: &str, span: LineSpan) {
        let silence_before = self.last.map_or(Span::ZERO, |last| span.t_first - last.t_last);
        if self.since.len() == SINCE_MAX {
            self.since.remove(0);
        }
        self.since.push(Arrival { address: key(address), silence_before, span });
        self.last = Some(span);
    }

    /// The last sentence has the open epoch's time: all sentences before it were of this burst.
    pub(super) fn same_burst(&mut self) {
        self.since.clear();
    }

    /// The last sentence opens an epoch; returns where its burst began. `earlier`: an earlier sentence that is known to
    /// be of the same burst.
    pub(super) fn new_burst(&mut self, earlier: Option<LineSpan>) -> LineSpan {
        self.vote();
        let known = earlier.and_then(|span| self.since.iter().position(|arrival| arrival.span == span));
        let first_known = known.unwrap_or(self.since.len().saturating_sub(1));
        let leaders = self.since[..first_known]
            .iter()
            .rev()
            .take_while(|arrival| self.votes_of(arrival.address) >= VOTES_LEADING)
            .count();
        let first = self.since.get(first_known - leaders).map(|arrival| arrival.span);
        self.since.clear();
        first.or(self.last).unwrap_or_default()
    }

    /// Whether an earlier sentence is nearer to the last one than to the one before it.
    pub(super) fn is_of_this_burst(&self, span: LineSpan) -> bool {
        let Some(at) = self.since.iter().position(|arrival| arrival.span == span) else {
            return false;
        };
        let after = self.since[at + 1..].iter().map(|arrival| arrival.silence_before).max();
        after.is_none_or(|after| after <= self.since[at].silence_before)
    }

    /// Whether this sentence comes before the one with its time.
    pub(super) fn leads(&self, address: &str) -> bool {
        self.votes_of(key(address)) >= VOTES_LEADING
    }

    fn votes_of(&self, address: Address) -> i8 {
        self.votes.iter().find(|(known, _)| *known == address).map_or(0, |(_, votes)| *votes)
    }

    fn vote(&mut self) {
        let longest = self.since.iter().enumerate().max_by_key(|(_, arrival)| arrival.silence_before);
        let Some((gap, longest)) = longest.map(|(index, arrival)| (index, arrival.silence_before)) else {
            return;
        };
        let others = self.since.iter().enumerate().filter(|(index, _)| *index != gap);
        let second = others.map(|(_, arrival)| arrival.silence_before).max().unwrap_or(Span::ZERO);
        if longest < SILENCE_MIN || longest.ns() < 2 * second.ns() {
            return;
        }
        for (index, arrival) in self.since.iter().enumerate() {
            let vote = if index < gap { -1 } else { 1 };
            let room = self.votes.len() < ADDRESSES_MAX;
            match self.votes.iter_mut().find(|(known, _)| *known == arrival.address) {
                Some((_, votes)) => *votes = (*votes + vote).clamp(-VOTES_MAX, VOTES_MAX),
                None if room => self.votes.push((arrival.address, vote)),
                None => {}
            }
        }
    }
}

/// Cycles of the same sentences before their end counts as known.
const CYCLES_FIRST: u32 = 3;
/// Most cycles that are required after the end was wrong.
const CYCLES_MAX: u32 = 64;

/// The learnt sentences of a cycle, so that an epoch (or a compass's reading) can be output with its last sentence and
/// not only when the next one begins.
#[derive(Clone, Debug)]
pub(super) struct Cycle<K> {
    expected: Vec<K>,
    seen: u32,
    needed: u32,
}

impl<K> Default for Cycle<K> {
    fn default() -> Self {
        Self { expected: Vec::new(), seen: 0, needed: CYCLES_FIRST }
    }
}

impl<K: PartialEq + Clone> Cycle<K> {
    /// An epoch ended because the next one began; these were its sentences.
    pub(super) fn ended(&mut self, kinds: &[K]) {
        if kinds == self.expected {
            self.seen = self.seen.saturating_add(1);
        } else if !is_subsequence(kinds, &self.expected) {
            self.expected = kinds.to_vec();
            self.seen = 1;
        }
    }

    /// A sentence came after the epoch had been output: requires more cycles from now on.
    pub(super) fn was_longer(&mut self) {
        self.seen = 0;
        self.expected.clear();
        self.needed = (self.needed * 2).min(CYCLES_MAX);
    }

    /// Whether these are all expected sentences (some may have been lost before the last).
    pub(super) fn is_complete(&self, kinds: &[K]) -> bool {
        let Some(last) = self.expected.last() else {
            return false;
        };
        let count = |list: &[K]| list.iter().filter(|kind| *kind == last).count();
        self.seen >= self.needed
            && kinds.last() == Some(last)
            && count(kinds) == count(&self.expected)
            && is_subsequence(kinds, &self.expected)
    }
}

fn is_subsequence<K: PartialEq>(part: &[K], whole: &[K]) -> bool {
    let mut whole = whole.iter();
    part.iter().all(|kind| whole.any(|other| other == kind))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Kind;
    use windhover_base::time::MonoTime;

    fn span(ms: i64) -> LineSpan {
        let t = MonoTime::from_ns(ms * 1_000_000);
        LineSpan { t_first: t, t_last: t + Span::from_ms(5.0), ..LineSpan::default() }
    }

    #[test]
    fn sentences_near_the_next_time_lead_it() {
        // Given bursts of VTG, RMC, GSV with silence after GSV
        let mut order = BurstOrder::default();
        let mut begins = Vec::new();
        for burst in 0..4 {
            let t = burst * 200;
            order.received("GPVTG", span(t));
            order.received("GPRMC", span(t + 10));
            begins.push(order.new_burst(None).t_first.ns() / 1_000_000);
            order.received("GPGSV", span(t + 20));
        }
        // Then VTG is known to lead after two silences, and the burst begins with it
        assert!(order.leads("GPVTG") && !order.leads("GPGSV"));
        assert_eq!(begins, [10, 210, 400, 600]);
    }

    #[test]
    fn one_stall_of_the_host_changes_nothing() {
        let mut order = BurstOrder::default();
        for burst in 0..6 {
            let t = burst * 200;
            let stall = if burst == 4 { 170 } else { 0 };
            order.received("GPRMC", span(t));
            order.new_burst(None);
            order.received("PGRMV", span(t + 10 + stall));
        }
        assert!(!order.leads("PGRMV"));
    }

    #[test]
    fn a_cycle_is_believed_after_three_and_doubted_after_an_error() {
        let kinds = [Kind::Rmc, Kind::Gga, Kind::Pgrmv];
        let mut cycle = Cycle::default();
        for _ in 0..3 {
            assert!(!cycle.is_complete(&kinds));
            cycle.ended(&kinds);
        }
        assert!(cycle.is_complete(&kinds));
        assert!(cycle.is_complete(&[Kind::Rmc, Kind::Pgrmv]), "GGA was lost");
        assert!(!cycle.is_complete(&[Kind::Rmc, Kind::Gga]));
        cycle.was_longer();
        (0..5).for_each(|_| cycle.ended(&kinds));
        assert!(!cycle.is_complete(&kinds));
        cycle.ended(&kinds);
        assert!(cycle.is_complete(&kinds));
    }
}
