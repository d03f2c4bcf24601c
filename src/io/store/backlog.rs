//! What ground stations missed, read again from the card: the store as the link's deep backlog.

use std::sync::Arc;

use super::handle::StoreHandle;
use super::index::QueuedRecord;
use crate::io::link::{Backlog, Extent, Found, Unread};
use crate::io::records::{Record, Schema};
use windhover_base::time::MonoTime;

/// What a record takes beside its message.
const OVERHEAD: usize = 160;

/// The record as it was handed in; `None` where its schema is another program's.
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
        // Not open yet, or broken: it may answer later.
        let Some(index) = self.index() else { return Err(Unread { end }) };
        let mut bytes = 0;
        let mut found = Vec::new();
        for entry in index.queued(run, first, end) {
            let Ok((number, queued)) = entry else {
                // What came before the error is answered; behind it nothing is known.
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
