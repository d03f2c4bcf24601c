//! Making the index again from the segments, and comparing the two.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use mcap::records::Record;

use super::encode::parse_state;
use super::flight::{self, FLIGHTS};
use super::index::{Change, Index, IndexError, QueuedRecord, SegmentEntry};
use super::record::{BACKFILL_KEY, STATE_TOPIC};
use super::scan::{SealedSegment, SegmentFile, for_each_record};
use super::volume::{StoreError, StoreResult};

/// Changes are written to the index this many at a time.
const BATCH: usize = 500;

/// The index entry of a sealed segment.
pub fn entry_of(segment: &SegmentFile, sealed: &SealedSegment) -> SegmentEntry {
    let first = sealed.topics.values().map(|t| t.first_ns).min().unwrap_or(0);
    let last = sealed.topics.values().map(|t| t.last_ns).max().unwrap_or(0);
    let messages = sealed.topics.values().map(|t| t.count).sum();
    SegmentEntry { bytes: segment.len(), messages, span_ns: (first, last) }
}

/// Adds a closed flight to the index: its name, its segments, at most `room` of its records for the ground (the newest
/// segments first), and states that the index does not have. Returns how many records were queued.
pub fn index_flight(root: &Path, name: &str, index: &Index, room: u64) -> StoreResult<u64> {
    let dir = root.join(FLIGHTS).join(name);
    let refused =
        |error: IndexError| StoreError::new("index", &dir, std::io::Error::other(error.to_string()));
    let Some(session) = flight::session_of(&dir) else { return Ok(0) };
    let mut changes = vec![Change::Flight(session, name.to_owned())];
    let mut queued = 0;
    for segment_name in flight::segment_names(&dir).iter().rev() {
        let segment = SegmentFile::open(&dir.join(segment_name))?;
        let (Some(sealed), Some(number)) = (segment.sealed(), number_of(segment_name)) else { continue };
        changes.push(Change::Segment(session, number, entry_of(&segment, &sealed)));
        if queued < room {
            let found = queue_of(&segment, &sealed, index);
            queued += found.iter().filter(|c| matches!(c, Change::Queue(..))).count() as u64;
            changes.extend(found);
        }
        while changes.len() >= BATCH {
            index.apply(&changes[..BATCH]).map_err(refused)?;
            changes.drain(..BATCH);
        }
    }
    index.apply(&changes).map_err(refused)?;
    Ok(queued)
}

/// Number of a segment, from its name.
pub fn number_of(segment_name: &str) -> Option<u32> {
    segment_name.strip_suffix(".mcap")?.parse().ok()
}

/// Records for the ground and states in a segment. Chunks without any are not read.
fn queue_of(segment: &SegmentFile, sealed: &SealedSegment, index: &Index) -> Vec<Change> {
    let channels = &sealed.definitions.channels;
    let wanted: BTreeSet<u16> = channels
        .values()
        .filter(|c| c.metadata.contains_key(BACKFILL_KEY) || c.topic == STATE_TOPIC)
        .map(|c| c.id)
        .collect();
    // Numbers of a run without a card at its start are not the card's: they stay in the segments.
    let number = |key: &str| sealed.metadata.get(key).and_then(|v| v.parse::<u32>().ok());
    let run = number("session").filter(|session| number("run").is_none_or(|run| run == *session));
    let mut changes = Vec::new();
    let mut states = BTreeMap::new();
    for chunk in &sealed.chunks {
        if !chunk.message_index_offsets.keys().any(|id| wanted.contains(id)) {
            continue;
        }
        let Some((_, records)) = segment.chunk_at(chunk.chunk_start_offset) else { continue };
        for_each_record(&records, |_, record| {
            let Record::Message { header, data } = record else { return };
            let Some(channel) = channels.get(&header.channel_id) else { return };
            if channel.topic == STATE_TOPIC {
                states.extend(parse_state(&data));
            } else if let (true, Some(run)) = (wanted.contains(&channel.id), run) {
                let schema = sealed.definitions.schemas.get(&channel.schema_id);
                let queued = QueuedRecord {
                    topic: channel.topic.clone(),
                    schema: schema.map_or_else(String::new, |(name, _, _)| name.clone()),
                    log_ns: header.log_time,
                    publish_ns: header.publish_time,
                    data: data.into_owned(),
                };
                changes.push(Change::Queue(run, header.sequence, queued));
            }
        });
    }
    let missing = states.into_iter().filter(|(name, _)| index.state(name).is_none());
    changes.extend(missing.map(|(name, blob)| Change::State(name, blob)));
    changes
}

/// A difference between index and segments.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Difference {
    /// The index has a flight that no longer exists.
    NotOnCard(String),
    /// The index lacks a flight or a segment.
    NotInIndex(String),
    /// The entry of a segment is wrong.
    Otherwise(String),
}

impl Difference {
    /// Whether the daemon corrects it at its next start.
    pub fn is_finished_at_start(&self) -> bool {
        !matches!(self, Self::Otherwise(_))
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NotOnCard(name) => write!(f, "{name}: in the index, not on the card"),
            Self::NotInIndex(name) => write!(f, "{name}: on the card, not in the index"),
            Self::Otherwise(name) => write!(f, "{name}: the index has another entry"),
        }
    }
}

/// Differences between the index and the closed flights on the card, one line each.
pub fn differences(root: &Path, index: &Index) -> StoreResult<Vec<Difference>> {
    let mut differences = Vec::new();
    let names = flight::flight_names(root)?;
    let known: BTreeMap<String, u32> = index.flights().into_iter().map(|(run, name)| (name, run)).collect();
    let entries: BTreeMap<(u32, u32), SegmentEntry> = index.segments().into_iter().collect();
    for name in known.keys().filter(|name| !names.contains(name)) {
        differences.push(Difference::NotOnCard(name.clone()));
    }
    for name in &names {
        let Some(run) = known.get(name) else {
            differences.push(Difference::NotInIndex(name.clone()));
            continue;
        };
        let dir = root.join(FLIGHTS).join(name);
        for segment_name in flight::segment_names(&dir) {
            let segment = SegmentFile::open(&dir.join(&segment_name))?;
            let (Some(sealed), Some(number)) = (segment.sealed(), number_of(&segment_name)) else { continue };
            match entries.get(&(*run, number)) {
                None => differences.push(Difference::NotInIndex(format!("{name}/{segment_name}"))),
                Some(entry) if *entry != entry_of(&segment, &sealed) => {
                    differences.push(Difference::Otherwise(format!("{name}/{segment_name}")));
                }
                Some(_) => {}
            }
        }
    }
    Ok(differences)
}
