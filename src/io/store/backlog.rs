//! Records for ground stations, read again from the card: the store as the link's deep backlog.

use std::sync::Arc;

use super::handle::StoreHandle;
use super::index::QueuedRecord;
use crate::io::link::{Backlog, Extent, Found, Unread};
use crate::io::records::{Record, Schema};
use windhover_base::time::MonoTime;

/// Memory of a record apart from its message.
const OVERHEAD: usize = 160;

/// The record as it was stored; `None` where its schema is of another program.
fn record_of(queued: QueuedRecord) -> Option<Record> {
    Some(Record {
        schema: Schema::named(&queued.schema)?,
        log_time: MonoTime::from_unsigned_ns(queued.log_ns),
        publish_time: MonoTime::from_unsigned_ns(queued.publish_ns),
        topic: queued.topic.into(),
        data: queued.data,
    })
}

impl Backlog for StoreHandle {
    fn extents(&self) -> Vec<Extent> {
        let Some(index) = self.index() else { return Vec::new() };
        let extent =
            |(run, first, end)| Extent { run, flight: index.flight(run).unwrap_or_default(), first, end };
        index.queued_runs().into_iter().map(extent).collect()
    }

    fn read(&self, run: u32, first: u32, end: u32, max_bytes: usize) -> Found {
        // The index is not open yet, or broken: it may answer later.
        let Some(index) = self.index() else { return Err(Unread { end }) };
        let mut bytes = 0;
        let mut found = Vec::new();
        for entry in index.queued(run, first, end) {
            let Ok((number, queued)) = entry else {
                // Records before the error are returned; beyond it nothing is known.
                return if found.is_empty() { Err(Unread { end }) } else { Ok(found) };
            };
            let Some(record) = record_of(queued) else { continue };
            bytes += record.data.len() + OVERHEAD;
            if bytes > max_bytes && !found.is_empty() {
                break;
            }
            found.push((number, Arc::new(record)));
        }
        Ok(found)
    }

    fn acknowledge(&self, station: &str, run: u32, through: u32) {
        StoreHandle::acknowledge(self, station, run, through);
    }
}
