//! Records that may have to be sent again: the runs of a payload by sequence number.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::io::records::Record;

/// A run of the program and which of its numbers exist.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Extent {
    /// Identity of the run; never reused.
    pub run: u32,
    /// Name of the flight's directory.
    pub flight: String,
    /// Least number that exists.
    pub first: u32,
    /// One more than the greatest assigned number.
    pub end: u32,
}

/// The requested numbers up to `end` could not be read now; this does not mean that they no longer exist.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Unread {
    /// One more than the last number concerned.
    pub end: u32,
}

/// The records that were read, by number, ascending.
pub type Found = Result<Vec<(u32, Arc<Record>)>, Unread>;

/// Source of the back-fill: memory, or the store's queue on the card.
pub trait Backlog: Send + Sync {
    /// The runs of which it has any number, oldest first.
    fn extents(&self) -> Vec<Extent>;

    /// Records `first..end` of a run that exist, ascending, at most about `max_bytes` of them (but at least one, where
    /// there is one). Numbers that are absent, up to the last one returned or up to `end` when none is, no longer
    /// exist. May block on the card.
    fn read(&self, run: u32, first: u32, end: u32, max_bytes: usize) -> Found;

    /// A station has every number below `through` of a run on its disk.
    fn acknowledge(&self, station: &str, run: u32, through: u32);
}

/// The latest records of the present run, in memory, bounded in bytes: the oldest are dropped first.
#[derive(Debug)]
pub struct MemoryBacklog {
    run: u32,
    flight: String,
    limit: usize,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    records: VecDeque<Arc<Record>>,
    first: u32,
    bytes: usize,
}

/// Memory of a record apart from its message: the struct, its topic, the queue's slot.
const OVERHEAD: usize = 160;

impl MemoryBacklog {
    /// A backlog of one run with at most `limit` bytes.
    pub fn new(run: u32, flight: impl Into<String>, limit: usize) -> Self {
        Self { run, flight: flight.into(), limit, held: Mutex::default() }
    }

    fn held(&self) -> MutexGuard<'_, Held> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Identity of the run.
    pub fn run(&self) -> u32 {
        self.run
    }

    /// Name of the flight.
    pub fn flight(&self) -> &str {
        &self.flight
    }

    /// Stores a record and returns its number.
    pub fn append(&self, record: Arc<Record>) -> u32 {
        let mut held = self.held();
        let number = held.first + held.records.len() as u32;
        held.bytes += record.data.len() + OVERHEAD;
        held.records.push_back(record);
        while held.bytes > self.limit && held.records.len() > 1 {
            if let Some(oldest) = held.records.pop_front() {
                held.bytes -= oldest.data.len() + OVERHEAD;
                held.first += 1;
            }
        }
        number
    }

    /// Takes over the records of another backlog, before any is appended here.
    pub fn adopt(&self, earlier: Self) {
        let earlier = earlier.held.into_inner().unwrap_or_else(PoisonError::into_inner);
        let mut held = self.held();
        debug_assert!(held.records.is_empty() && held.first == 0, "numbers are assigned once");
        *held = earlier;
    }

    /// The number the next record gets.
    pub fn end(&self) -> u32 {
        let held = self.held();
        held.first + held.records.len() as u32
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.held().bytes
    }

    /// The record of a number.
    pub fn get(&self, number: u32) -> Option<Arc<Record>> {
        let held = self.held();
        held.records.get(number.checked_sub(held.first)? as usize).cloned()
    }
}

impl Backlog for MemoryBacklog {
    fn extents(&self) -> Vec<Extent> {
        let held = self.held();
        let end = held.first + held.records.len() as u32;
        vec![Extent { run: self.run, flight: self.flight.clone(), first: held.first, end }]
    }

    fn read(&self, run: u32, first: u32, end: u32, max_bytes: usize) -> Found {
        let held = self.held();
        if run != self.run {
            return Ok(Vec::new());
        }
        let from = first.max(held.first);
        let to = end.min(held.first + held.records.len() as u32);
        let (mut bytes, mut found) = (0, Vec::new());
        for number in from..to {
            let record = &held.records[(number - held.first) as usize];
            bytes += record.data.len() + OVERHEAD;
            if !found.is_empty() && bytes > max_bytes {
                break;
            }
            found.push((number, Arc::clone(record)));
        }
        Ok(found)
    }

    fn acknowledge(&self, _station: &str, _run: u32, _through: u32) {
        // Memory is bounded in bytes, whatever the stations have: a new station may still connect.
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::records::Schema;
    use windhover_base::time::MonoTime;

    fn record(n: u32) -> Arc<Record> {
        Arc::new(Record {
            topic: "/log".into(),
            schema: Schema::Log,
            log_time: MonoTime::from_ns(i64::from(n)),
            publish_time: MonoTime::from_ns(i64::from(n)),
            data: vec![0; 40],
        })
    }

    #[test]
    fn numbers_go_on_while_the_oldest_go() {
        let backlog = MemoryBacklog::new(9, "boot-1", 10 * (40 + OVERHEAD));
        for n in 0..25 {
            assert_eq!(backlog.append(record(n)), n);
        }
        assert_eq!(backlog.extents(), [Extent { run: 9, flight: "boot-1".into(), first: 15, end: 25 }]);
        let numbers = |first, end, max| -> Vec<u32> {
            backlog.read(9, first, end, max).expect("memory").into_iter().map(|(n, _)| n).collect()
        };
        assert_eq!(numbers(10, 18, usize::MAX), [15, 16, 17]);
        assert_eq!(numbers(20, 99, 1), [20], "at least one");
        assert_eq!(backlog.read(8, 0, 99, usize::MAX).expect("memory").len(), 0, "another run");
        assert_eq!(backlog.get(24).map(|r| r.log_time.ns()), Some(24));
    }

    #[test]
    fn an_hour_without_a_station_stays_within_its_bound() {
        let backlog = MemoryBacklog::new(1, "boot-1", 1 << 20);
        // 15 Hz of estimate and ownship and 1 Hz of health for an hour.
        for n in 0..31 * 3_600 {
            backlog.append(record(n));
        }
        assert!(backlog.bytes() <= 1 << 20);
    }
}
