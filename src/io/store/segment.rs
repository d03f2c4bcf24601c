//! Writing one segment: records gather into chunks, a commit appends them and makes them durable.
//!
//! Layout of a segment: magic, header, metadata `windhover`, all schemas and channels of the
//! flight, attachment `config.toml`, padding; then per chunk one append of the chunk, its message
//! indexes and padding to the next page; at the end data end, summary, footer, magic.
//! A chunk starts on a page of its own, so that a card which loses power in mid-write can only
//! damage what was not acknowledged. Definitions are repeated inside the first chunk and every
//! tenth after it: a segment whose head is lost still reads.

use std::collections::BTreeMap;

use super::format::{self, Compression};
use super::record::{Definitions, RawRecord, Weight};
use super::summary::{PlacedChunk, Summary, TopicStats};
use super::volume::{AppendFile, StoreError, StoreResult, Volume};

/// What a card writes as a whole: appends start and end on it.
pub const PAGE: u64 = 4096;

/// Definitions are repeated in every chunk of which the number is a multiple of this.
const REPEAT_DEFINITIONS: usize = 10;

/// Blocks are asked for this many bytes at a time.
const RESERVE_STEP: u64 = 16 << 20;

/// Kept reserved beyond the last commit, so that the summary fits even when the card fills up.
const RESERVE_END: u64 = 256 << 10;

/// What every segment of a flight carries at its head.
#[derive(Clone, Debug, Default)]
pub struct Head {
    /// The configuration, as attachment `config.toml`.
    pub config: String,
    /// Metadata `windhover`: session, segment, versions.
    pub metadata: BTreeMap<String, String>,
    /// Host time when the segment begins, ns.
    pub time_ns: u64,
}

/// Appends the head to `out`, an empty file's content, and notes it in `summary`.
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

/// A chunk may span this much log time: readers put messages in order over a second.
const CHUNK_SPAN_NS: u64 = 900_000_000;

/// A chunk ends when it holds this many bytes, so that memory stays bounded.
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

/// A segment being written. Frames and everything else go into chunks of their own: what reads only
/// the latter (lists, back-fill, a replay without frames) then touches a hundredth of the bytes.
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
    /// Creates the file, writes its head and makes both durable. Frames are compressed as told,
    /// everything else with lz4.
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

    /// Adds a record; durable after the next [`Self::commit`]. Chunks that are long enough are
    /// written on the way; on an error their records are lost.
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

    /// Writes what is pending; all of it is durable on return. On an error what is pending is lost,
    /// what was acknowledged before is not.
    pub fn commit(&mut self) -> StoreResult<()> {
        self.write_chunks()?;
        if std::mem::take(&mut self.unsynced) {
            self.file.sync()?;
        }
        Ok(())
    }

    /// Writes what is pending without waiting for it to be durable.
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

    /// Follows a rename of the flight.
    pub fn set_path(&mut self, path: std::path::PathBuf) {
        self.file.set_path(path);
    }

    /// Commits what is left, writes the summary, gives back reserved blocks; durable on return.
    /// Gives the length of the file and its number of chunks.
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
