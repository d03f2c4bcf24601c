//! Reading the card without changing it: lists, dropouts, whether a process records.

use std::fs::File;
use std::path::Path;

use mcap::records::Record;
use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};

use super::flight::{self, FLIGHTS, FlightInfo, KEEP};
use super::record::DROPOUT_TOPIC;
use super::retention::age_order;
use super::scan::{SegmentFile, for_each_record};
use super::volume::{StoreError, StoreResult};

/// File that the recording process holds locked.
pub const LOCK: &str = "lock";

/// Held while recording; a second recorder on the same card is refused.
#[derive(Debug)]
pub struct RecorderLock {
    _file: File,
}

impl RecorderLock {
    /// Locks the store at `root`.
    pub fn acquire(root: &Path) -> StoreResult<Self> {
        let path = root.join(LOCK);
        let file = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .open(&path)
            .map_err(|e| StoreError::new("open", &path, e))?;
        match flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(Self { _file: file }),
            Err(rustix::io::Errno::WOULDBLOCK) => {
                let other = std::io::Error::other("another windhover process records there");
                Err(StoreError::new("record to", root, other))
            }
            Err(e) => Err(StoreError::new("lock", &path, e)),
        }
    }
}

/// Whether a process records to the store at `root`.
pub fn is_recording(root: &Path) -> bool {
    File::open(root.join(LOCK)).is_ok_and(|file| {
        flock(&file, FlockOperation::NonBlockingLockShared) == Err(rustix::io::Errno::WOULDBLOCK)
    })
}

/// The flight being recorded: the newest that is not closed, while a process records.
pub fn in_the_air(root: &Path) -> StoreResult<Option<String>> {
    if !is_recording(root) {
        return Ok(None);
    }
    let open = flight::flight_names(root)?
        .into_iter()
        .filter(|name| !root.join(FLIGHTS).join(name).join(flight::FLIGHT_FILE).exists());
    Ok(open.max_by_key(|name| age_order(root, name)))
}

/// A quick description of a flight: `flight.json`, or for one that is not closed the sizes of its segments and the
/// summaries of the sealed ones.
pub fn glance(root: &Path, name: &str) -> StoreResult<FlightInfo> {
    let dir = root.join(FLIGHTS).join(name);
    if dir.join(flight::FLIGHT_FILE).exists() {
        return flight::flight_info(root, name);
    }
    let mut info = FlightInfo {
        name: name.to_owned(),
        session: flight::session_of(&dir).unwrap_or(0),
        keep: dir.join(KEEP).exists(),
        ..FlightInfo::default()
    };
    for segment in flight::segment_names(&dir) {
        let segment = SegmentFile::open(&dir.join(segment))?;
        info.segments += 1;
        info.bytes += segment.len();
        for (topic, stats) in segment.sealed().map(|sealed| sealed.topics).unwrap_or_default() {
            info.topics.entry(topic).or_default().join(&stats);
        }
    }
    Ok(info)
}

/// All flights, oldest first. Those that cannot be read are returned as errors.
pub fn list(root: &Path) -> StoreResult<(Vec<FlightInfo>, Vec<StoreError>)> {
    let (mut flights, mut errors) = (Vec::new(), Vec::new());
    for name in flight::flight_names(root)? {
        match glance(root, &name) {
            Ok(info) => flights.push(info),
            Err(error) => errors.push(error),
        }
    }
    flights.sort_by(|a, b| (a.session, &a.name).cmp(&(b.session, &b.name)));
    Ok((flights, errors))
}

/// Data that the card did not take.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
pub struct Dropout {
    /// Log time of the first lost message, ns.
    pub from_ns: u64,
    /// Log time of the last, ns.
    pub to_ns: u64,
    /// Bytes lost.
    pub bytes: u64,
    /// Messages lost by topic.
    pub messages: std::collections::BTreeMap<String, u64>,
    /// The reason.
    pub reason: String,
}

/// The losses that a flight records. Only chunks with such records are read.
pub fn dropouts(root: &Path, name: &str) -> StoreResult<Vec<Dropout>> {
    let dir = root.join(FLIGHTS).join(name);
    let mut found = Vec::new();
    for segment in flight::segment_names(&dir) {
        let segment = SegmentFile::open(&dir.join(segment))?;
        let Some(sealed) = segment.sealed() else { continue };
        let channels = &sealed.definitions.channels;
        let Some(channel) = channels.values().find(|c| c.topic == DROPOUT_TOPIC) else { continue };
        for chunk in sealed.chunks.iter().filter(|c| c.message_index_offsets.contains_key(&channel.id)) {
            let Some((_, records)) = segment.chunk_at(chunk.chunk_start_offset) else { continue };
            for_each_record(&records, |_, record| {
                if let Record::Message { header, data } = record
                    && header.channel_id == channel.id
                {
                    found.extend(serde_json::from_slice::<Dropout>(&data));
                }
            });
        }
    }
    Ok(found)
}
