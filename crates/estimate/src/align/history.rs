//! A short history of measurements with the filter's state after each, so that a late one is fused
//! in its place and everything after it again.

use std::collections::VecDeque;

use windhover_base::msg::Disposition;
use windhover_base::time::{MonoTime, Span};

/// When a measurement was valid and when it was received, and its place in the stream.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Stamp {
    /// When it was true.
    pub t_valid: MonoTime,
    /// When it was received.
    pub t_recv: MonoTime,
    /// Position in the stream of events; orders measurements of one instant.
    pub seq: u64,
}

/// One measurement and the state just after it.
#[derive(Clone, Debug, Default)]
pub struct Entry<M, S> {
    /// Its times.
    pub stamp: Stamp,
    /// The measurement.
    pub value: M,
    /// The state after it was fused.
    pub after: S,
}

/// The history. It follows `t_recv`: one wrong stamp cannot move it into the future, because a measurement valid later
/// than it was received is refused.
#[derive(Clone, Debug)]
pub struct History<M, S> {
    entries: VecDeque<Entry<M, S>>,
    /// Entries out of use, kept so that steady state allocates nothing.
    spare: Vec<Entry<M, S>>,
    /// The state before the first entry, and when it holds.
    base: S,
    t_base: MonoTime,
    span: Span,
    capacity: usize,
    newest_recv: Option<MonoTime>,
}

/// How much later than its reception a stamp may lie, ms: the accuracy of the fits behind stamps.
const FUTURE_TOLERANCE_MS: f64 = 20.0;

/// Entries made at once when none is to spare: the number in use then settles early.
const BATCH: usize = 8;

impl<M: Default, S: Default + Clone> History<M, S> {
    /// An empty history that starts from `base`, valid at `t_base`. It reaches `span` back from the newest `t_recv` and
    /// holds at most `capacity` measurements.
    pub fn new(span: Span, capacity: usize, base: S, t_base: MonoTime) -> Self {
        Self {
            entries: VecDeque::with_capacity(capacity + 1),
            spare: Vec::with_capacity(capacity + 1),
            base,
            t_base,
            span,
            capacity,
            newest_recv: None,
        }
    }

    /// Whether a measurement can be fused.
    ///
    /// # Errors
    /// [`Disposition::TooNew`] or [`Disposition::TooOld`], where it cannot.
    pub fn admit(&mut self, stamp: Stamp) -> Result<(), Disposition> {
        let newest = self.newest_recv.map_or(stamp.t_recv, |t| t.max(stamp.t_recv));
        self.newest_recv = Some(newest);
        if stamp.t_valid > stamp.t_recv + Span::from_ms(FUTURE_TOLERANCE_MS) {
            return Err(Disposition::TooNew);
        }
        if stamp.t_valid < self.t_base || newest - stamp.t_valid > self.span {
            return Err(Disposition::TooOld);
        }
        Ok(())
    }

    /// Puts a measurement in its place and gives its index; `fill` writes it into a recycled value.
    /// Everything from that index on has to be fused again, starting from [`Self::before`].
    pub fn insert(&mut self, stamp: Stamp, fill: impl FnOnce(&mut M)) -> usize {
        if self.spare.is_empty() {
            // States like the base, so that writing into them allocates no more.
            let more = || Entry { stamp: Stamp::default(), value: M::default(), after: self.base.clone() };
            self.spare.extend(std::iter::repeat_with(more).take(BATCH));
        }
        let mut entry = self.spare.pop().unwrap_or_default();
        entry.stamp = stamp;
        fill(&mut entry.value);
        let at = self
            .entries
            .iter()
            .rposition(|e| (e.stamp.t_valid, e.stamp.seq) <= (stamp.t_valid, stamp.seq))
            .map_or(0, |i| i + 1);
        self.entries.insert(at, entry);
        at
    }

    /// Forgets what lies farther back than the span, or is too many; the state after the last one
    /// forgotten becomes the base. Call when every entry has been fused.
    pub fn trim(&mut self) {
        let Some(newest) = self.newest_recv else { return };
        while let Some(first) = self.entries.front() {
            if newest - first.stamp.t_valid <= self.span && self.entries.len() <= self.capacity {
                break;
            }
            if let Some(mut gone) = self.entries.pop_front() {
                std::mem::swap(&mut self.base, &mut gone.after);
                self.t_base = gone.stamp.t_valid;
                self.spare.push(gone);
            }
        }
    }

    /// The state just before entry `index`.
    pub fn before(&self, index: usize) -> &S {
        if index == 0 { &self.base } else { &self.entries[index - 1].after }
    }

    /// The state after the last measurement that was true no later than `t`.
    pub fn at(&self, t: MonoTime) -> &S {
        self.before(self.entries.partition_point(|entry| entry.stamp.t_valid <= t))
    }

    /// The newest state.
    pub fn head(&self) -> &S {
        self.before(self.entries.len())
    }

    /// Entry `index`.
    pub fn entry_mut(&mut self, index: usize) -> &mut Entry<M, S> {
        &mut self.entries[index]
    }

    /// How many entries there are.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Starts again from another state.
    pub fn restart(&mut self, t_base: MonoTime, write_base: impl FnOnce(&mut S)) {
        self.spare.extend(self.entries.drain(..));
        self.t_base = t_base;
        write_base(&mut self.base);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamp(valid_ms: i64, recv_ms: i64, seq: u64) -> Stamp {
        let t = |ms: i64| MonoTime::from_ns(ms * 1_000_000);
        Stamp { t_valid: t(valid_ms), t_recv: t(recv_ms), seq }
    }

    /// Fuses by appending to a list: the state is the order in which values were seen.
    fn feed(history: &mut History<u32, Vec<u32>>, stamp: Stamp, value: u32) -> Result<(), Disposition> {
        history.admit(stamp)?;
        let at = history.insert(stamp, |v| *v = value);
        let mut state = history.before(at).clone();
        for i in at..history.len() {
            let entry = history.entry_mut(i);
            state.push(entry.value);
            entry.after.clone_from(&state);
        }
        history.trim();
        Ok(())
    }

    #[test]
    fn late_ones_are_fused_in_their_place() {
        let mut history = History::new(Span::from_ms(500.0), 64, Vec::new(), MonoTime::from_ns(0));
        for (valid, recv, value) in [(100, 110, 1), (200, 210, 3), (150, 260, 2), (220, 270, 4), (90, 280, 0)]
        {
            feed(&mut history, stamp(valid, recv, u64::from(value)), value).expect("within the history");
        }
        assert_eq!(history.head(), &vec![0, 1, 2, 3, 4]);
        let at = |ms: i64| history.at(MonoTime::from_ns(ms * 1_000_000));
        assert_eq!(
            (at(89), at(150), at(219), at(900)),
            (&vec![], &vec![0, 1, 2], &vec![0, 1, 2, 3], history.head())
        );
    }

    #[test]
    fn older_than_the_history_is_too_old_and_the_future_is_refused() {
        let mut history = History::new(Span::from_ms(500.0), 64, Vec::new(), MonoTime::from_ns(0));
        feed(&mut history, stamp(100, 110, 0), 0).expect("first");
        assert_eq!(feed(&mut history, stamp(9_000_000, 120, 1), 1), Err(Disposition::TooNew));
        feed(&mut history, stamp(700, 710, 2), 2).expect("a wild stamp did not drag the history along");
        assert_eq!(feed(&mut history, stamp(200, 720, 3), 3), Err(Disposition::TooOld));
        feed(&mut history, stamp(230, 720, 4), 4).expect("within 500 ms of the newest arrival");
        assert_eq!(history.head(), &vec![0, 4, 2]);
    }

    #[test]
    fn one_instant_keeps_the_order_of_the_stream() {
        let mut history = History::new(Span::from_ms(500.0), 64, Vec::new(), MonoTime::from_ns(0));
        for (seq, value) in [(5, 5), (3, 3), (4, 4)] {
            feed(&mut history, stamp(100, 120, seq), value).expect("within the history");
        }
        assert_eq!(history.head(), &vec![3, 4, 5]);
    }
}
