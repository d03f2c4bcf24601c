//! Writing one segment: records gather into a chunk, a commit appends it and makes it durable.
//!
//! Layout of a segment: magic, header, metadata `windhover`, all schemas and channels of the
//! flight, attachment `config.toml`, padding; then per commit one append of chunk, message indexes
//! and padding to the next page; at the end data end, summary, footer, magic.
//! A commit starts on a page of its own, so that a card which loses power in mid-write can only
//! damage what was not acknowledged. Definitions are repeated inside the first chunk and every
//! tenth after it: a segment whose head is lost still reads.

use std::collections::BTreeMap;

use super::format::{self, Compression};
use super::record::{Definitions, RawRecord};
use super::summary::{PlacedChunk, Summary, TopicStats};
use super::volume::{AppendFile, StoreResult, Volume};

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

#[derive(Debug, Default)]
struct Chunk {
    records: Vec<u8>,
    messages: BTreeMap<u16, Vec<(u64, u64)>>,
    span_ns: Option<(u64, u64)>,
}

/// A segment being written.
#[derive(Debug)]
pub struct SegmentWriter {
    file: AppendFile,
    compression: Compression,
    chunk: Chunk,
    summary: Summary,
    pending: usize,
}

impl SegmentWriter {
    /// Creates the file, writes its head and makes both durable.
    pub fn create(
        volume: &Volume,
        (dir, name): (&str, &str),
        head: &Head,
        definitions: &Definitions,
        compression: Compression,
    ) -> StoreResult<Self> {
        let mut file = volume.create(&format!("{dir}/{name}"))?;
        let mut summary = Summary::default();
        let mut out = Vec::new();
        put_head(&mut out, &mut summary, head, definitions);
        file.reserve(out.len() as u64 + RESERVE_END, RESERVE_STEP)?;
        file.append(&out)?;
        file.sync()?;
        volume.sync_dir(dir)?;
        Ok(Self { file, compression, chunk: Chunk::default(), summary, pending: 0 })
    }

    /// Adds a record to the chunk in memory; nothing is written before [`Self::commit`].
    pub fn push(&mut self, definitions: &mut Definitions, record: &RawRecord) {
        let (channel, new) = definitions.number(&record.channel);
        let repeat = self.chunk.records.is_empty() && self.summary.chunk_count() % REPEAT_DEFINITIONS == 0;
        if repeat {
            definitions.put(&mut self.chunk.records);
        } else if new {
            definitions.put_one(&mut self.chunk.records, channel);
        }
        let offset = self.chunk.records.len() as u64;
        let RawRecord { log_ns, publish_ns, sequence, data, .. } = record;
        format::put_message(&mut self.chunk.records, channel, *sequence, *log_ns, *publish_ns, data);
        self.chunk.messages.entry(channel).or_default().push((*log_ns, offset));
        let (first, last) = self.chunk.span_ns.unwrap_or((*log_ns, *log_ns));
        self.chunk.span_ns = Some((first.min(*log_ns), last.max(*log_ns)));
        self.pending += 1;
    }

    /// Bytes in the chunk in memory.
    pub fn pending_bytes(&self) -> usize {
        self.chunk.records.len()
    }

    /// Messages in the chunk in memory.
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

    /// Writes the chunk, durable on return; gives the bytes written. On an error the chunk is lost,
    /// what was acknowledged before is not.
    pub fn commit(&mut self) -> StoreResult<u64> {
        let before = self.file.len();
        self.write_chunk()?;
        if self.file.len() > before {
            self.file.sync()?;
        }
        Ok(self.file.len() - before)
    }

    /// Writes the chunk without waiting for it to be durable.
    pub fn write_chunk(&mut self) -> StoreResult<()> {
        let chunk = std::mem::take(&mut self.chunk);
        self.pending = 0;
        let Some(span) = chunk.span_ns else { return Ok(()) };
        let start = self.file.len();
        let mut out = Vec::with_capacity(chunk.records.len() + 8192);
        let header = format::put_chunk(&mut out, &chunk.records, span, self.compression)
            .map_err(|e| super::volume::StoreError::new("compress a chunk for", self.file.path(), e))?;
        let placed =
            PlacedChunk { header, offset: start, length: out.len() as u64, messages: chunk.messages };
        let mut noted = self.summary.clone();
        noted.chunk(&mut out, start, &placed);
        format::pad_to_page(&mut out, start, PAGE);
        self.file.reserve(out.len() as u64 + RESERVE_END, RESERVE_STEP)?;
        self.file.append(&out)?;
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
        self.write_chunk()?;
        let mut out = Vec::new();
        self.summary.put_end(&mut out, self.file.len(), definitions);
        self.file.append(&out)?;
        self.file.sync()?;
        self.file.release()?;
        Ok((self.file.len(), self.summary.chunk_count()))
    }
}
