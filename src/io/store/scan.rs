//! Reading segments, complete or damaged: the quick look at a sealed one, and the search for every complete chunk of
//! one that a power cut damaged.

use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use mcap::records::{ChunkIndex, Record, op};

use super::format::{self, MAGIC};
use super::record::Definitions;
use super::segment::PAGE;
use super::summary::{PlacedChunk, Summary, TopicStats};
use super::volume::{StoreError, StoreResult};
use crate::io::mcap_record::{MAX_CHUNK_BYTES, RECORD_HEAD, longest, parse, split, unpack_chunk};

/// The summary of a sealed segment.
#[derive(Clone, Debug, Default)]
pub struct SealedSegment {
    /// Its schemas and channels.
    pub definitions: Definitions,
    /// Its chunks.
    pub chunks: Vec<ChunkIndex>,
    /// Counts and times by topic.
    pub topics: BTreeMap<String, TopicStats>,
    /// Metadata `windhover`.
    pub metadata: BTreeMap<String, String>,
    /// Where the summary section begins.
    pub summary_start: u64,
}

/// The complete parts of a segment.
#[derive(Debug, Default)]
pub struct Salvage {
    /// Whether magic, header and definitions at the head are complete.
    pub head_whole: bool,
    /// Configuration, where its attachment is complete.
    pub config: Option<String>,
    /// Metadata `windhover`, where complete.
    pub metadata: Option<BTreeMap<String, String>>,
    /// Schemas and channels found anywhere; those in chunks, which have checksums, take precedence.
    pub definitions: Definitions,
    /// Schemas and channels of the head.
    pub head_definitions: Definitions,
    /// Complete chunks, in the order of the file.
    pub chunks: Vec<PlacedChunk>,
    /// The head's part of the summary section.
    pub head: Summary,
    /// Whether each chunk follows the previous one without a gap, including message indexes.
    pub contiguous: bool,
    /// Where the last chunk's record ends; the head's end where there is none.
    pub chunks_end: u64,
    /// Where the last chunk's message indexes and padding end, where these are complete too.
    pub last_commit_end: Option<u64>,
    /// Length of the file.
    pub length: u64,
}

/// A segment open for reading.
#[derive(Debug)]
pub struct SegmentFile {
    file: File,
    path: std::path::PathBuf,
    length: u64,
}

impl SegmentFile {
    /// Opens it.
    pub fn open(path: &Path) -> StoreResult<Self> {
        let wrap = |e| StoreError::new("read", path, e);
        let file = File::open(path).map_err(wrap)?;
        let length = file.metadata().map_err(wrap)?.len();
        Ok(Self { file, path: path.to_owned(), length })
    }

    /// Length of the file.
    pub fn len(&self) -> u64 {
        self.length
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    fn read(&self, offset: u64, length: u64) -> StoreResult<Vec<u8>> {
        let mut bytes = vec![0; length as usize];
        self.file.read_exact_at(&mut bytes, offset).map_err(|e| StoreError::new("read", &self.path, e))?;
        Ok(bytes)
    }

    /// A record at `offset`: op code and body; `None` where there cannot be one. A page that the card cannot read
    /// counts as damaged.
    fn record(&self, offset: u64) -> Option<(u8, Vec<u8>)> {
        let head = self.read(offset, RECORD_HEAD as u64).ok()?;
        let length = u64::from_le_bytes(head[1..].try_into().ok()?);
        let room = self.length.checked_sub(offset + RECORD_HEAD as u64)?;
        if length > room.min(longest(head[0])) {
            return None;
        }
        Some((head[0], self.read(offset + RECORD_HEAD as u64, length).ok()?))
    }

    /// The summary of a segment that was sealed; `None` where it was not, or its end is damaged.
    pub fn sealed(&self) -> Option<SealedSegment> {
        const TAIL: u64 = RECORD_HEAD as u64 + 20 + MAGIC.len() as u64;
        let tail = self.read(self.length.checked_sub(TAIL)?, TAIL).ok()?;
        if tail[29..] != MAGIC || tail[0] != op::FOOTER {
            return None;
        }
        let summary_start = u64::from_le_bytes(tail[9..17].try_into().ok()?);
        let crc = u32::from_le_bytes(tail[25..29].try_into().ok()?);
        let covered = self.length.checked_sub(12)?.checked_sub(summary_start)?;
        if summary_start == 0 || covered > MAX_CHUNK_BYTES {
            return None;
        }
        let bytes = self.read(summary_start, covered).ok()?;
        if crc != 0 && crc32fast::hash(&bytes) != crc {
            return None;
        }
        let mut sealed = SealedSegment { summary_start, ..SealedSegment::default() };
        let mut rest = &bytes[..];
        while let Some((code, body, after)) = split(rest) {
            match parse(code, body)? {
                Record::ChunkIndex(index) => sealed.chunks.push(index),
                Record::MetadataIndex(index) if index.name == "windhover" => {
                    let (_, body) = self.record(index.offset)?;
                    if let Some(Record::Metadata(m)) = parse(op::METADATA, &body) {
                        sealed.metadata = m.metadata;
                    }
                }
                record => sealed.definitions.learn(&record),
            }
            rest = after;
        }
        sealed.topics = self.topics(&sealed)?;
        Some(sealed)
    }

    fn topics(&self, sealed: &SealedSegment) -> Option<BTreeMap<String, TopicStats>> {
        let mut topics: BTreeMap<String, TopicStats> = BTreeMap::new();
        for chunk in &sealed.chunks {
            let start = chunk.chunk_start_offset.checked_add(chunk.chunk_length)?;
            if chunk.message_index_length > self.length {
                return None;
            }
            let bytes = self.read(start, chunk.message_index_length).ok()?;
            let mut rest = &bytes[..];
            while let Some((code, body, after)) = split(rest) {
                if let Some(Record::MessageIndex(index)) = parse(code, body) {
                    let channel = sealed.definitions.channels.get(&index.channel_id)?;
                    let stats = topics.entry(channel.topic.clone()).or_default();
                    index.records.iter().for_each(|entry| stats.add(entry.log_time));
                }
                rest = after;
            }
        }
        Some(topics)
    }

    /// The messages of one chunk, uncompressed; `None` where it is damaged.
    pub fn chunk_at(&self, offset: u64) -> Option<(mcap::records::ChunkHeader, Vec<u8>)> {
        let (code, body) = self.record(offset)?;
        if code != op::CHUNK {
            return None;
        }
        match parse(code, &body)? {
            Record::Chunk { header, data } if header.uncompressed_crc != 0 => {
                let records = unpack_chunk(&header, &data)?;
                Some((header, records))
            }
            _ => None,
        }
    }

    /// Whether everything that `salvage` found in this file agrees with its summary, without a gap that could disturb a
    /// reader.
    pub fn agrees(&self, sealed: &SealedSegment, salvage: &Salvage) -> bool {
        let Some(end) = salvage.last_commit_end.or(salvage.chunks.is_empty().then_some(salvage.chunks_end))
        else {
            return false;
        };
        let mut data_end = Vec::new();
        format::put_record(&mut data_end, op::DATA_END, |b| format::put_u32(b, 0));
        salvage.head_whole
            && salvage.contiguous
            && salvage.config.is_some()
            && salvage.metadata.is_some()
            && salvage.head_definitions.agrees_with(&sealed.definitions)
            && salvage.definitions.agrees_with(&sealed.definitions)
            && salvage.chunks.len() == sealed.chunks.len()
            && self.read(end, data_end.len() as u64).is_ok_and(|bytes| bytes == data_end)
            && end + data_end.len() as u64 == sealed.summary_start
    }

    /// Finds everything that is complete. Chunks begin on pages, so after a gap the search continues page by page until
    /// one begins.
    pub fn salvage(&self) -> Salvage {
        let mut salvage = Salvage { length: self.length, contiguous: true, ..Salvage::default() };
        let mut at = self.salvage_head(&mut salvage);
        salvage.chunks_end = at;
        at = at.next_multiple_of(PAGE);
        while at < self.length {
            let Some(chunk) = self.salvage_chunk(at, &mut salvage.definitions) else {
                at += PAGE;
                continue;
            };
            let expected = match salvage.chunks.last() {
                Some(last) => self.indexes_end(last),
                None => Some(salvage.chunks_end),
            };
            salvage.contiguous &= expected.map(|end| end.next_multiple_of(PAGE)) == Some(at);
            salvage.chunks_end = at + chunk.length;
            at = salvage.chunks_end.next_multiple_of(PAGE);
            salvage.chunks.push(chunk);
        }
        salvage.definitions.complete_from(&salvage.head_definitions);
        salvage.last_commit_end = salvage.chunks.last().and_then(|last| self.indexes_end(last));
        salvage
    }

    /// Reads the head up to its padding; returns where it ends, or where reading had to stop.
    fn salvage_head(&self, salvage: &mut Salvage) -> u64 {
        if self.read(0, MAGIC.len() as u64).ok().as_deref() != Some(&MAGIC[..]) {
            return 0;
        }
        let mut at = MAGIC.len() as u64;
        loop {
            let record = self.record(at).filter(|(code, _)| *code != op::CHUNK);
            let Some((code, body)) = record else {
                // A head ends on a page; otherwise it is cut or has a gap.
                salvage.head_whole = at.is_multiple_of(PAGE);
                return at;
            };
            let place = (at, RECORD_HEAD as u64 + body.len() as u64);
            at += place.1;
            if code == format::PADDING {
                salvage.head_whole = true;
                return at;
            }
            match parse(code, &body) {
                Some(Record::Attachment { header, data, .. }) if header.name == "config.toml" => {
                    let names = (&*header.name, &*header.media_type);
                    salvage.head.attachment(place, names, header.log_time, data.len() as u64);
                    salvage.config = Some(String::from_utf8_lossy(&data).into_owned());
                }
                Some(Record::Metadata(m)) if m.name == "windhover" => {
                    salvage.head.metadata(place, &m.name);
                    salvage.metadata = Some(m.metadata);
                }
                Some(record @ (Record::Schema { .. } | Record::Channel(_))) => {
                    salvage.head_definitions.learn(&record);
                }
                Some(Record::Header(_)) => {}
                _ => return place.0,
            }
        }
    }

    /// Only the content of the head.
    pub fn salvage_head_only(&self) -> Salvage {
        let mut salvage = Salvage { length: self.length, ..Salvage::default() };
        salvage.chunks_end = self.salvage_head(&mut salvage);
        salvage
    }

    fn salvage_chunk(&self, at: u64, definitions: &mut Definitions) -> Option<PlacedChunk> {
        // The first byte excludes most pages inside chunks.
        if self.read(at, 1).ok()? != [op::CHUNK] {
            return None;
        }
        let (header, records) = self.chunk_at(at)?;
        let length = RECORD_HEAD as u64 + 40 + header.compression.len() as u64 + header.compressed_size;
        let mut messages: BTreeMap<u16, Vec<(u64, u64)>> = BTreeMap::new();
        for_each_record(&records, |offset, record| match record {
            Record::Message { header, .. } => {
                messages.entry(header.channel_id).or_default().push((header.log_time, offset));
            }
            other => definitions.learn(&other),
        });
        Some(PlacedChunk { header, offset: at, length, messages })
    }

    /// Where the message indexes and padding after a chunk end; `None` where they are not complete.
    fn indexes_end(&self, chunk: &PlacedChunk) -> Option<u64> {
        let mut at = chunk.offset + chunk.length;
        for (channel, entries) in &chunk.messages {
            let (code, body) = self.record(at)?;
            match parse(code, &body)? {
                Record::MessageIndex(index) if index.channel_id == *channel => {
                    let same = index.records.len() == entries.len()
                        && index.records.iter().zip(entries).all(|(a, b)| (a.log_time, a.offset) == *b);
                    same.then_some(())?;
                }
                _ => return None,
            }
            at += RECORD_HEAD as u64 + body.len() as u64;
        }
        match self.record(at) {
            Some((format::PADDING, body)) => Some(at + RECORD_HEAD as u64 + body.len() as u64),
            _ => (at.is_multiple_of(PAGE)).then_some(at),
        }
    }

    /// Bytes of the file from `offset`, unchanged.
    pub(super) fn copy_out(&self, offset: u64, length: u64) -> StoreResult<Vec<u8>> {
        self.read(offset, length)
    }
}

/// Calls `visit` with each record of an uncompressed chunk and its offset.
pub fn for_each_record(records: &[u8], mut visit: impl FnMut(u64, Record<'_>)) {
    let mut rest = records;
    while let Some((code, body, after)) = split(rest) {
        if let Some(record) = parse(code, body) {
            visit((records.len() - rest.len()) as u64, record);
        }
        rest = after;
    }
}

impl Salvage {
    /// Counts and times by topic.
    pub fn topics(&self) -> BTreeMap<String, TopicStats> {
        let mut summary = Summary::default();
        for chunk in &self.chunks {
            summary.chunk(&mut Vec::new(), chunk.offset + chunk.length, chunk);
        }
        summary.topics(&self.definitions)
    }
}
