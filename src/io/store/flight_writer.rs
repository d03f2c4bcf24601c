//! Writing one flight: its directory, its segments in order, its description at the end.

use std::collections::BTreeMap;

use super::flight::{self, FLIGHTS, FlightInfo};
use super::format::Compression;
use super::record::{Definitions, RawRecord};
use super::segment::{Head, SegmentWriter};
use super::summary::TopicStats;
use super::volume::{StoreResult, Volume};
use windhover_base::time::UtcTime;

/// File that counts the runs of the daemon on this card.
const SESSION_FILE: &str = "session";

/// Limits of a segment.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SegmentLimits {
    /// Longest duration, ns of host time.
    pub span_ns: u64,
    /// Largest size, bytes.
    pub bytes: u64,
    /// How frames are compressed in their chunks.
    pub frame_compression: Compression,
}

/// A segment that was finished.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct FinishedSegment {
    /// Its number.
    pub number: u32,
    /// Its length.
    pub bytes: u64,
    /// Counts and times by topic.
    pub topics: BTreeMap<String, TopicStats>,
}

/// A flight being written.
#[derive(Debug)]
pub struct FlightWriter {
    volume: Volume,
    name: String,
    session: u32,
    head: Head,
    limits: SegmentLimits,
    definitions: Definitions,
    segment: Option<(SegmentWriter, u64)>,
    number: u32,
    finished: FlightInfo,
}

/// The number of this run of the daemon on this card: one more than the last, stored durably.
pub fn next_session(volume: &Volume) -> StoreResult<u32> {
    let text = std::fs::read_to_string(volume.path(SESSION_FILE)).ok();
    let last = match text.and_then(|text| text.trim().parse::<u32>().ok()) {
        Some(last) => last,
        // Lost or never there: derived from the flights.
        None => flight::flight_names(volume.root())?
            .iter()
            .filter_map(|name| flight::session_of(&volume.root().join(FLIGHTS).join(name)))
            .max()
            .unwrap_or(0),
    };
    let next = last.saturating_add(1);
    volume.write_whole("", SESSION_FILE, format!("{next}\n").as_bytes())?;
    Ok(next)
}

impl FlightWriter {
    /// Makes the flight's directory and its first segment, durably. `head` is written to every segment; its metadata
    /// gets session and segment.
    pub fn begin(
        volume: &Volume,
        session: u32,
        start: Option<UtcTime>,
        head: Head,
        limits: SegmentLimits,
    ) -> StoreResult<Self> {
        let name = flight::create_flight(volume, session, start)?;
        let mut writer = Self {
            volume: volume.clone(),
            name,
            session,
            head,
            limits,
            definitions: Definitions::default(),
            segment: None,
            number: 0,
            finished: FlightInfo { session, ..FlightInfo::default() },
        };
        writer.open_segment(writer.head.time_ns)?;
        Ok(writer)
    }

    /// Name of the directory.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The run it belongs to.
    pub fn session(&self) -> u32 {
        self.session
    }

    /// Whether records can be pushed. After an error, [`Self::resume`] is needed first.
    pub fn is_open(&self) -> bool {
        self.segment.is_some()
    }

    fn dir(&self) -> String {
        format!("{FLIGHTS}/{}", self.name)
    }

    fn open_segment(&mut self, now_ns: u64) -> StoreResult<()> {
        let mut head = Head { time_ns: now_ns, ..self.head.clone() };
        head.metadata.insert("session".into(), self.session.to_string());
        head.metadata.insert("segment".into(), self.number.to_string());
        let dir = self.dir();
        let name = flight::segment_name(self.number);
        let compression = self.limits.frame_compression;
        // The number is used up even where creation fails.
        self.number += 1;
        let segment =
            SegmentWriter::create(&self.volume, (&dir, &name), &head, &self.definitions, compression)?;
        self.segment = Some((segment, now_ns));
        Ok(())
    }

    /// Adds a record.
    pub fn push(&mut self, record: &RawRecord) -> StoreResult<()> {
        let Some((segment, _)) = &mut self.segment else { return Ok(()) };
        segment.push(&mut self.definitions, record)
    }

    /// Makes everything pushed durable, then starts the next segment where it is due.
    pub fn commit(&mut self, now_ns: u64) -> StoreResult<Option<FinishedSegment>> {
        let Some((segment, begun_ns)) = &mut self.segment else { return Ok(None) };
        segment.commit()?;
        let due =
            now_ns.saturating_sub(*begun_ns) >= self.limits.span_ns || segment.len() >= self.limits.bytes;
        if !due || segment.is_empty() {
            return Ok(None);
        }
        let finished = self.finish_segment()?;
        self.open_segment(now_ns)?;
        Ok(finished)
    }

    /// Bytes of all its segments so far.
    pub fn bytes(&self) -> u64 {
        self.finished.bytes + self.segment.as_ref().map_or(0, |(segment, _)| segment.len())
    }

    fn finish_segment(&mut self) -> StoreResult<Option<FinishedSegment>> {
        let Some((segment, _)) = self.segment.take() else { return Ok(None) };
        let topics = segment.topics(&self.definitions);
        let (bytes, chunks) = segment.finish(&self.definitions)?;
        if chunks == 0 {
            return Ok(None);
        }
        for (topic, stats) in &topics {
            self.finished.topics.entry(topic.clone()).or_default().join(stats);
        }
        self.finished.segments += 1;
        self.finished.bytes += bytes;
        Ok(Some(FinishedSegment { number: self.number - 1, bytes, topics }))
    }

    /// Leaves the present segment after an error: it is sealed later.
    pub fn abandon_segment(&mut self) {
        self.segment = None;
        // The rest must be checked again, so the flight is not closed here.
        self.finished.repaired += 1;
    }

    /// Ends the present segment properly without opening another.
    pub fn pause(&mut self) -> StoreResult<Option<FinishedSegment>> {
        self.finish_segment()
    }

    /// Opens the next segment after an error or a pause. Where the directory no longer exists (another card), a new
    /// flight begins.
    pub fn resume(&mut self, now_ns: u64, start: Option<UtcTime>) -> StoreResult<()> {
        if self.volume.path(&self.dir()).is_dir() {
            return self.open_segment(now_ns);
        }
        let head = self.head.clone();
        let fresh =
            Self::begin(&self.volume, self.session, start, Head { time_ns: now_ns, ..head }, self.limits)?;
        *self = fresh;
        Ok(())
    }

    /// Sets the name of a flight without a date; one that has a date keeps its name.
    pub fn set_start(&mut self, start: UtcTime) -> StoreResult<bool> {
        if !self.name.starts_with("boot-") {
            return Ok(false);
        }
        self.name = flight::name_flight(&self.volume, &self.name, start)?;
        let path = self.volume.path(&self.dir()).join(flight::segment_name(self.number.saturating_sub(1)));
        if let Some((segment, _)) = &mut self.segment {
            segment.set_path(path);
        }
        Ok(true)
    }

    /// Ends the flight: last segment and, where nothing needs repair, `flight.json`.
    pub fn finish(&mut self) -> StoreResult<Option<FinishedSegment>> {
        let last = self.finish_segment()?;
        if self.finished.repaired == 0 && self.finished.segments > 0 {
            let metadata = self.head.metadata.clone();
            let info = FlightInfo { closed: true, metadata, ..self.finished.clone() };
            flight::write_info(&self.volume, &self.name, &info)?;
        }
        Ok(last)
    }
}
