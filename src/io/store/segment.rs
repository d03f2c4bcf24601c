//! Writing one segment: records gather into chunks, a commit appends them and makes them durable.
//!
//! Layout of a segment: magic, header, metadata `windhover`, all schemas and channels of the flight, attachment
//! `config.toml`, padding; then for each chunk one append of the chunk, its message indexes and padding to the next
//! page; at the end data end, summary, footer, magic. A chunk starts on a new page, so that a power loss in the middle
//! of a write can only damage data that were not acknowledged. Definitions are repeated inside the first chunk and
//! every tenth after it: a segment whose head is lost can still be read.

use std::collections::BTreeMap;

use super::format::{self, Compression};
use super::record::{Definitions, RawRecord, Weight};
use super::summary::{PlacedChunk, Summary, TopicStats};
use super::volume::{AppendFile, StoreError, StoreResult, Volume};

/// The unit in which a card writes: appends start and end on it.
pub const PAGE: u64 = 4096;

/// Definitions are repeated in every chunk whose number is a multiple of this.
const REPEAT_DEFINITIONS: usize = 10;

/// Blocks are reserved this many bytes at a time.
const RESERVE_STEP: u64 = 16 << 20;

/// Reserved beyond the last commit, so that the summary fits even when the card becomes full.
const RESERVE_END: u64 = 256 << 10;

/// The head of every segment of a flight.
#[derive(Clone, Debug, Default)]
pub struct Head {
    /// The configuration, as attachment `config.toml`.
    pub config: String,
    /// Metadata `windhover`: session, segment, versions.
    pub metadata: BTreeMap<String, String>,
    /// Host time when the segment begins, ns.
    pub time_ns: u64,
}

/// Appends the head to `out`, the content of an empty file, and enters it in `summary`.
pub(super) fn put_head(out: &mut Vec<u8>, summary: &mut Summary, head: &Head, definitions: &Definitions) {
    out.extend_from_slice(&format::MAGIC);
    format::put_header(out, concat!("windhover ", env!("CARGO_PKG_VERSION")));
    let at = out.len();
    format::put_metadata(out, "windhover", &head.metadata);
    summary.metadata((at as u64, (out.len() - at) as u64), "windhover");
    definitions.put(out);
    if !head.config.is_empty() {
        let at = out.len();
        format::put_attachment(out, "config.toml", "application/toml", head.time_ns, head.config.as_bytes());
        let place = (at as u64, (out.len() - at) as u64);
        summary.attachment(
            place,
            ("config.toml", "application/toml"),
            head.time_ns,
            head.config.len() as u64,
        );
    }
    format::pad_to_page(out, 0, PAGE);
}

/// A chunk may span this much log time: readers sort messages over one second.
const CHUNK_SPAN_NS: u64 = 900_000_000;

/// A chunk ends at this many bytes, so that memory stays bounded.
const CHUNK_BYTES: usize = 8 << 20;

#[derive(Debug, Default)]
struct Chunk {
    records: Vec<u8>,
    messages: BTreeMap<u16, Vec<(u64, u64)>>,
    span_ns: Option<(u64, u64)>,
}

impl Chunk {
    fn add(&mut self, channel: u16, record: &RawRecord) {
        let offset = self.records.len() as u64;
        let RawRecord { log_ns, publish_ns, sequence, data, .. } = record;
        format::put_message(&mut self.records, channel, *sequence, *log_ns, *publish_ns, data);
        self.messages.entry(channel).or_default().push((*log_ns, offset));
        let (first, last) = self.span_ns.unwrap_or((*log_ns, *log_ns));
        self.span_ns = Some((first.min(*log_ns), last.max(*log_ns)));
    }
}

/// A segment being written. Frames and other messages go into separate chunks: operations without frames (lists,
/// back-fill, a replay without frames) then read a hundredth of the bytes.
#[derive(Debug)]
pub struct SegmentWriter {
    file: AppendFile,
    small: Chunk,
    frames: Chunk,
    frame_compression: Compression,
    summary: Summary,
    begun_ns: Option<u64>,
    pending: usize,
    unsynced: bool,
}

impl SegmentWriter {
    /// Creates the file, writes its head and makes both durable. Frames are compressed as configured, everything else
    /// with lz4.
    pub fn create(
        volume: &Volume,
        (dir, name): (&str, &str),
        head: &Head,
        definitions: &Definitions,
        frame_compression: Compression,
    ) -> StoreResult<Self> {
        let mut file = volume.create(&format!("{dir}/{name}"))?;
        let mut summary = Summary::default();
        let mut out = Vec::new();
        put_head(&mut out, &mut summary, head, definitions);
        file.reserve(out.len() as u64 + RESERVE_END, RESERVE_STEP)?;
        file.append(&out)?;
        file.sync()?;
        volume.sync_dir(dir)?;
        Ok(Self {
            file,
            small: Chunk::default(),
            frames: Chunk::default(),
            frame_compression,
            summary,
            begun_ns: None,
            pending: 0,
            unsynced: false,
        })
    }

    /// Adds a record; durable after the next [`Self::commit`]. Chunks that are long enough are written at once; on an
    /// error their records are lost.
    pub fn push(&mut self, definitions: &mut Definitions, record: &RawRecord) -> StoreResult<()> {
        let begun = *self.begun_ns.get_or_insert(record.log_ns);
        if record.log_ns.saturating_sub(begun) >= CHUNK_SPAN_NS || self.pending_bytes() >= CHUNK_BYTES {
            self.write_chunks()?;
            self.begun_ns = Some(record.log_ns);
        }
        let (channel, new) = definitions.number(&record.channel);
        let chunk = if record.weight == Weight::Frame { &mut self.frames } else { &mut self.small };
        let repeat =
            chunk.records.is_empty() && self.summary.chunk_count().is_multiple_of(REPEAT_DEFINITIONS);
        if repeat {
            definitions.put(&mut chunk.records);
        } else if new {
            definitions.put_one(&mut chunk.records, channel);
        }
        chunk.add(channel, record);
        self.pending += 1;
        Ok(())
    }

    /// Bytes in the chunks in memory.
    pub fn pending_bytes(&self) -> usize {
        self.small.records.len() + self.frames.records.len()
    }

    /// Messages in the chunks in memory.
    pub fn pending(&self) -> usize {
        self.pending
    }

    /// Bytes in the file.
    pub fn len(&self) -> u64 {
        self.file.len()
    }

    /// Whether no chunk was written yet.
    pub fn is_empty(&self) -> bool {
        self.summary.chunk_count() == 0
    }

    /// Writes all pending data, durable on return. On an error the pending data are lost, but not what was acknowledged
    /// before.
    pub fn commit(&mut self) -> StoreResult<()> {
        self.write_chunks()?;
        if std::mem::take(&mut self.unsynced) {
            self.file.sync()?;
        }
        Ok(())
    }

    /// Writes pending data without waiting for durability.
    fn write_chunks(&mut self) -> StoreResult<()> {
        self.pending = 0;
        self.begun_ns = None;
        let (small, frames) = (std::mem::take(&mut self.small), std::mem::take(&mut self.frames));
        self.write_chunk(small, Compression::Lz4)?;
        self.write_chunk(frames, self.frame_compression)
    }

    fn write_chunk(&mut self, chunk: Chunk, compression: Compression) -> StoreResult<()> {
        let Some(span) = chunk.span_ns else { return Ok(()) };
        let start = self.file.len();
        let mut out = Vec::with_capacity(chunk.records.len() + 8192);
        let header = format::put_chunk(&mut out, &chunk.records, span, compression)
            .map_err(|e| StoreError::new("compress a chunk for", self.file.path(), e))?;
        let placed =
            PlacedChunk { header, offset: start, length: out.len() as u64, messages: chunk.messages };
        let mut noted = self.summary.clone();
        noted.chunk(&mut out, start, &placed);
        format::pad_to_page(&mut out, start, PAGE);
        self.file.reserve(out.len() as u64 + RESERVE_END, RESERVE_STEP)?;
        self.file.append(&out)?;
        self.unsynced = true;
        self.summary = noted;
        Ok(())
    }

    /// Counts and times by topic so far.
    pub fn topics(&self, definitions: &Definitions) -> BTreeMap<String, TopicStats> {
        self.summary.topics(definitions)
    }

    /// Updates the path after a rename of the flight.
    pub fn set_path(&mut self, path: std::path::PathBuf) {
        self.file.set_path(path);
    }

    /// Commits the rest, writes the summary, returns reserved blocks; durable on return. Returns the length of the file
    /// and its number of chunks.
    pub fn finish(mut self, definitions: &Definitions) -> StoreResult<(u64, usize)> {
        self.write_chunks()?;
        let mut out = Vec::new();
        self.summary.put_end(&mut out, self.file.len(), definitions);
        self.file.append(&out)?;
        self.file.sync()?;
        self.file.release()?;
        Ok((self.file.len(), self.summary.chunk_count()))
    }
}
