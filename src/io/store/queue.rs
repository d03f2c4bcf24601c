//! A bounded queue that never makes its producer wait: when it is full the oldest frames are dropped first, and the
//! dropped messages are counted by topic for their record.

use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::record::Weight;

/// A waiting item.
#[derive(Debug)]
pub struct Entry<T> {
    /// The item.
    pub value: T,
    /// Bytes it holds.
    pub bytes: usize,
    /// Whether it may be dropped early.
    pub weight: Weight,
    /// Its topic, for the record of drops.
    pub topic: Cow<'static, str>,
    /// Its log time, ns.
    pub log_ns: u64,
}

/// Messages dropped since the last call.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Drops {
    /// Messages by topic.
    pub messages: BTreeMap<String, u64>,
    /// Their bytes.
    pub bytes: u64,
    /// Log time of the first and last, ns.
    pub span_ns: Option<(u64, u64)>,
}

impl Drops {
    /// Number of messages.
    pub fn count(&self) -> u64 {
        self.messages.values().sum()
    }

    /// Counts one.
    pub fn add(&mut self, topic: &str, bytes: usize, log_ns: u64) {
        *self.messages.entry(topic.to_owned()).or_default() += 1;
        self.bytes += bytes as u64;
        let (first, last) = self.span_ns.unwrap_or((log_ns, log_ns));
        self.span_ns = Some((first.min(log_ns), last.max(log_ns)));
    }

    /// Adds other drops.
    pub fn join(&mut self, other: Self) {
        for (topic, count) in other.messages {
            *self.messages.entry(topic).or_default() += count;
        }
        self.bytes += other.bytes;
        self.span_ns = match (self.span_ns, other.span_ns) {
            (Some((a, b)), Some((c, d))) => Some((a.min(c), b.max(d))),
            (a, b) => a.or(b),
        };
    }
}

#[derive(Debug)]
struct Inner<T> {
    entries: VecDeque<Entry<T>>,
    bytes: usize,
    frames: usize,
    drops: Drops,
    closed: bool,
}

/// A bounded queue between one thread and another.
#[derive(Debug)]
pub struct Queue<T> {
    inner: Mutex<Inner<T>>,
    filled: Condvar,
    limit_bytes: usize,
}

/// The result of a pop.
#[derive(Debug)]
pub enum Popped<T> {
    /// An entry.
    Entry(Entry<T>),
    /// No entry within the time.
    Nothing,
    /// No entry, and none will come.
    Closed,
}

impl<T> Queue<T> {
    /// An empty queue that holds up to `limit_bytes`.
    pub fn new(limit_bytes: usize) -> Self {
        let inner =
            Inner { entries: VecDeque::new(), bytes: 0, frames: 0, drops: Drops::default(), closed: false };
        Self { inner: Mutex::new(inner), filled: Condvar::new(), limit_bytes }
    }

    fn lock(&self) -> MutexGuard<'_, Inner<T>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds an entry; makes room by dropping the oldest frames, or drops the entry itself. After [`Self::close`]
    /// everything is dropped.
    pub fn push(&self, entry: Entry<T>) {
        let mut inner = self.lock();
        while inner.bytes + entry.bytes > self.limit_bytes && inner.frames > 0 {
            let oldest = inner.entries.iter().position(|e| e.weight == Weight::Frame);
            let Some(frame) = oldest.and_then(|at| inner.entries.remove(at)) else { break };
            inner.bytes -= frame.bytes;
            inner.frames -= 1;
            inner.drops.add(&frame.topic, frame.bytes, frame.log_ns);
        }
        if inner.closed || inner.bytes + entry.bytes > self.limit_bytes {
            inner.drops.add(&entry.topic, entry.bytes, entry.log_ns);
            return;
        }
        inner.bytes += entry.bytes;
        inner.frames += usize::from(entry.weight == Weight::Frame);
        inner.entries.push_back(entry);
        drop(inner);
        self.filled.notify_one();
    }

    /// Takes the oldest entry, waiting up to `wait` for one.
    pub fn pop(&self, wait: Duration) -> Popped<T> {
        let inner = self.lock();
        let (mut inner, _) = self
            .filled
            .wait_timeout_while(inner, wait, |i| i.entries.is_empty() && !i.closed)
            .unwrap_or_else(PoisonError::into_inner);
        match inner.entries.pop_front() {
            Some(entry) => {
                inner.bytes -= entry.bytes;
                inner.frames -= usize::from(entry.weight == Weight::Frame);
                Popped::Entry(entry)
            }
            None if inner.closed => Popped::Closed,
            None => Popped::Nothing,
        }
    }

    /// Closes the queue: waiting entries can still be taken, none is added.
    pub fn close(&self) {
        self.lock().closed = true;
        self.filled.notify_all();
    }

    /// Bytes waiting.
    pub fn bytes(&self) -> usize {
        self.lock().bytes
    }

    /// Messages dropped since the last call.
    pub fn take_drops(&self) -> Drops {
        std::mem::take(&mut self.lock().drops)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(n: u64, bytes: usize, weight: Weight) -> Entry<u64> {
        Entry {
            value: n,
            bytes,
            weight,
            topic: if weight == Weight::Frame { "f" } else { "s" }.into(),
            log_ns: n,
        }
    }

    fn drain(queue: &Queue<u64>) -> Vec<u64> {
        let next = || match queue.pop(Duration::ZERO) {
            Popped::Entry(e) => Some(e.value),
            _ => None,
        };
        std::iter::from_fn(next).collect()
    }

    #[test]
    fn frames_go_first_and_oldest_first() {
        let queue = Queue::new(100);
        for n in 0..5 {
            queue.push(entry(n, 20, if n % 2 == 0 { Weight::Frame } else { Weight::Small }));
        }
        queue.push(entry(5, 30, Weight::Small));
        assert_eq!(drain(&queue), [1, 3, 4, 5]);
        let drops = queue.take_drops();
        assert_eq!((drops.count(), drops.bytes, drops.span_ns), (2, 40, Some((0, 2))));
        assert_eq!(queue.take_drops(), Drops::default());
    }

    #[test]
    fn without_frames_the_newest_is_given_up() {
        let queue = Queue::new(50);
        (0..4).for_each(|n| queue.push(entry(n, 20, Weight::Small)));
        assert_eq!(drain(&queue), [0, 1]);
        assert_eq!(queue.take_drops().messages["s"], 2);
        queue.close();
        queue.push(entry(9, 1, Weight::Small));
        assert!(matches!(queue.pop(Duration::from_secs(5)), Popped::Closed));
    }
}
