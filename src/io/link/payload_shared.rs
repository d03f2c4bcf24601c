//! Shared by the payload's handle and its sessions: records for back-fill, the stations, their state.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::watch;

use super::backlog::{Backlog, Extent, Found, MemoryBacklog, Unread};
use super::link_events::Events;
use super::pace::Bucket;
use super::peer::Peer;
use super::thumbnail::Picture;

/// State of the link with one station.
#[derive(Clone, PartialEq, Debug)]
pub struct StationStatus {
    /// Its name.
    pub name: String,
    /// Whether its acknowledgements arrive.
    pub hears_us: bool,
    /// Round-trip time, ms.
    pub rtt_ms: f64,
    /// Estimated rate of the path, kbit/s.
    pub rate_kbps: f64,
    /// Records sent live.
    pub live: u64,
    /// Records left to back-fill because newer ones replaced them.
    pub thinned: u64,
    /// Records sent again.
    pub backfilled: u64,
    /// How often the card could not be read for it.
    pub unread: u64,
    /// Records that it requested and that are still to be sent.
    pub wanted: u64,
}

/// State of the link.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct LinkStatus {
    /// Connected stations.
    pub stations: Vec<StationStatus>,
    /// Handshakes refused since the start.
    pub refused: u64,
    /// Records numbered so far in this run.
    pub records: u32,
    /// Memory held for back-fill, bytes.
    pub backlog_bytes: usize,
}

/// A station's latest connection.
pub(super) struct Connected {
    pub(super) peer: Peer,
    pub(super) status: StationStatus,
    /// Whether `link_up` was reported; a connection that takes over inherits it.
    pub(super) up_reported: Arc<AtomicBool>,
}

/// Shared by the sessions.
pub(super) struct PayloadShared {
    pub(super) recent: MemoryBacklog,
    pub(super) deep: Option<Arc<dyn Backlog>>,
    pub(super) ceiling: Option<Mutex<Bucket>>,
    pub(super) thumbnails: Option<Duration>,
    pub(super) thumbnail_width: u32,
    pub(super) picture: watch::Sender<Option<Arc<Picture>>>,
    pub(super) end: watch::Sender<u32>,
    pub(super) stations: Mutex<BTreeMap<String, Connected>>,
    pub(super) events: Events,
}

impl PayloadShared {
    /// Notifies of every new record.
    pub(super) fn news(&self) -> watch::Receiver<u32> {
        self.end.subscribe()
    }

    pub(super) fn stations(&self) -> MutexGuard<'_, BTreeMap<String, Connected>> {
        self.stations.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Every run of which any record exists; the present one last.
    pub(super) fn extents(&self) -> Vec<Extent> {
        let recent = self.recent.extents();
        let mut all = self.deep.as_ref().map_or(Vec::new(), |deep| deep.extents());
        for now in recent {
            match all.iter_mut().find(|e| e.run == now.run) {
                Some(same) => {
                    same.first = same.first.min(now.first);
                    same.end = same.end.max(now.end);
                }
                None => all.push(now),
            }
        }
        all
    }

    /// Reads records again, from memory where they are there, else from the card. Absent numbers no longer exist.
    pub(super) async fn read(self: &Arc<Self>, run: u32, first: u32, end: u32, max_bytes: usize) -> Found {
        let recent = self.recent.read(run, first, end, max_bytes)?;
        let covered = recent.first().is_some_and(|(number, _)| *number == first);
        match &self.deep {
            Some(deep) if !covered => {
                let deep = Arc::clone(deep);
                let end = recent.first().map_or(end, |(number, _)| *number);
                let read = move || deep.read(run, first, end, max_bytes);
                let found = tokio::task::spawn_blocking(read).await.unwrap_or(Err(Unread { end }))?;
                Ok(if found.is_empty() { recent } else { found })
            }
            _ => Ok(recent),
        }
    }

    pub(super) fn note_status(&self, status: StationStatus) {
        if let Some(connected) = self.stations().get_mut(&status.name) {
            connected.status = status;
        }
    }
}
