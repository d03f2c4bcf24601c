//! Description of a segment without reading its messages: the MCAP summary section, and the counts, times and gaps for
//! `store show`.

use std::collections::BTreeMap;

use mcap::records::{AttachmentIndex, ChunkHeader, ChunkIndex, MetadataIndex, Statistics, op};
use serde::{Deserialize, Serialize};

use super::format;
use super::record::Definitions;

/// Messages of one topic.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
pub struct TopicStats {
    /// Their number.
    pub count: u64,
    /// Log time of the first, ns.
    pub first_ns: u64,
    /// Log time of the last, ns.
    pub last_ns: u64,
    /// Longest gap between two, ns.
    pub gap_ns: u64,
    /// Log time at which that gap began, ns.
    pub gap_from_ns: u64,
}

impl TopicStats {
    /// Counts a message. Times are expected nearly in order.
    pub fn add(&mut self, log_ns: u64) {
        if self.count == 0 {
            *self = Self { count: 1, first_ns: log_ns, last_ns: log_ns, ..Self::default() };
            return;
        }
        self.count += 1;
        let silence = log_ns.saturating_sub(self.last_ns);
        if silence > self.gap_ns {
            (self.gap_ns, self.gap_from_ns) = (silence, self.last_ns);
        }
        self.first_ns = self.first_ns.min(log_ns);
        self.last_ns = self.last_ns.max(log_ns);
    }

    /// Adds the statistics of a later part.
    pub fn join(&mut self, later: &Self) {
        if later.count == 0 {
            return;
        }
        if self.count == 0 {
            *self = *later;
            return;
        }
        let silence = later.first_ns.saturating_sub(self.last_ns);
        if later.gap_ns > self.gap_ns {
            (self.gap_ns, self.gap_from_ns) = (later.gap_ns, later.gap_from_ns);
        }
        if silence > self.gap_ns {
            (self.gap_ns, self.gap_from_ns) = (silence, self.last_ns);
        }
        self.count += later.count;
        self.first_ns = self.first_ns.min(later.first_ns);
        self.last_ns = self.last_ns.max(later.last_ns);
    }
}

/// One chunk at its place in the file, with its messages by channel: (log time ns, offset in the chunk).
#[derive(Clone, Debug)]
pub struct PlacedChunk {
    /// Its header.
    pub header: ChunkHeader,
    /// Offset of its record in the file.
    pub offset: u64,
    /// Length of its record.
    pub length: u64,
    /// Messages by channel.
    pub messages: BTreeMap<u16, Vec<(u64, u64)>>,
}

/// The summary of a segment that is being written.
#[derive(Clone, Debug, Default)]
pub struct Summary {
    chunks: Vec<ChunkIndex>,
    attachments: Vec<AttachmentIndex>,
    metadata: Vec<MetadataIndex>,
    by_channel: BTreeMap<u16, TopicStats>,
}

impl Summary {
    /// Enters an attachment record of `length` bytes at `offset`.
    pub fn attachment(
        &mut self,
        (offset, length): (u64, u64),
        (name, media_type): (&str, &str),
        time_ns: u64,
        data_size: u64,
    ) {
        self.attachments.push(AttachmentIndex {
            offset,
            length,
            log_time: time_ns,
            create_time: time_ns,
            data_size,
            name: name.into(),
            media_type: media_type.into(),
        });
    }

    /// Enters a metadata record.
    pub fn metadata(&mut self, (offset, length): (u64, u64), name: &str) {
        self.metadata.push(MetadataIndex { offset, length, name: name.into() });
    }

    /// Writes the message indexes that follow `chunk` in the file, and enters both.
    pub fn chunk(&mut self, out: &mut Vec<u8>, out_start: u64, chunk: &PlacedChunk) {
        let index_start = out_start + out.len() as u64;
        let mut offsets = BTreeMap::new();
        for (channel, entries) in &chunk.messages {
            offsets.insert(*channel, out_start + out.len() as u64);
            format::put_message_index(out, *channel, entries);
            let stats = self.by_channel.entry(*channel).or_default();
            entries.iter().for_each(|(log_ns, _)| stats.add(*log_ns));
        }
        self.chunks.push(ChunkIndex {
            message_start_time: chunk.header.message_start_time,
            message_end_time: chunk.header.message_end_time,
            chunk_start_offset: chunk.offset,
            chunk_length: chunk.length,
            message_index_offsets: offsets,
            message_index_length: out_start + out.len() as u64 - index_start,
            compression: chunk.header.compression.clone(),
            compressed_size: chunk.header.compressed_size,
            uncompressed_size: chunk.header.uncompressed_size,
        });
    }

    /// Number of chunks.
    pub fn chunk_count(&self) -> usize {
        self.chunks.len()
    }

    /// Counts and times by topic.
    pub fn topics(&self, definitions: &Definitions) -> BTreeMap<String, TopicStats> {
        let mut topics: BTreeMap<String, TopicStats> = BTreeMap::new();
        for (id, stats) in &self.by_channel {
            let topic =
                definitions.channels.get(id).map_or_else(|| format!("channel {id}"), |c| c.topic.clone());
            topics.entry(topic).or_default().join(stats);
        }
        topics
    }

    /// Writes the end of a file after its first `out_start + out.len()` bytes: data end, summary, summary offsets,
    /// footer and magic.
    pub fn put_end(&self, out: &mut Vec<u8>, out_start: u64, definitions: &Definitions) {
        format::put_record(out, op::DATA_END, |b| format::put_u32(b, 0));
        let summary = out.len();
        let at = |out: &Vec<u8>| out_start + out.len() as u64;
        let summary_start = at(out);
        let mut groups = Vec::new();
        let mut group = |out: &mut Vec<u8>, code: u8, put: &dyn Fn(&mut Vec<u8>)| {
            let start = at(out);
            put(out);
            if at(out) > start {
                groups.push((code, start, at(out) - start));
            }
        };
        group(out, op::SCHEMA, &|out| {
            Definitions { schemas: definitions.schemas.clone(), ..Definitions::default() }.put(out);
        });
        group(out, op::CHANNEL, &|out| {
            definitions.channels.values().for_each(|c| format::put_channel(out, c))
        });
        group(out, op::STATISTICS, &|out| format::put_statistics(out, &self.statistics(definitions)));
        group(out, op::CHUNK_INDEX, &|out| self.chunks.iter().for_each(|c| format::put_chunk_index(out, c)));
        group(out, op::ATTACHMENT_INDEX, &|out| self.put_attachment_indexes(out));
        group(out, op::METADATA_INDEX, &|out| {
            for m in &self.metadata {
                format::put_record(out, op::METADATA_INDEX, |b| {
                    format::put_u64(b, m.offset);
                    format::put_u64(b, m.length);
                    format::put_str(b, &m.name);
                });
            }
        });
        let offsets_start = at(out);
        for (code, start, length) in groups {
            format::put_record(out, op::SUMMARY_OFFSET, |b| {
                b.push(code);
                format::put_u64(b, start);
                format::put_u64(b, length);
            });
        }
        format::put_footer(out, summary, summary_start, offsets_start);
    }

    fn put_attachment_indexes(&self, out: &mut Vec<u8>) {
        for a in &self.attachments {
            format::put_record(out, op::ATTACHMENT_INDEX, |b| {
                format::put_u64(b, a.offset);
                format::put_u64(b, a.length);
                format::put_u64(b, a.log_time);
                format::put_u64(b, a.create_time);
                format::put_u64(b, a.data_size);
                format::put_str(b, &a.name);
                format::put_str(b, &a.media_type);
            });
        }
    }

    fn statistics(&self, definitions: &Definitions) -> Statistics {
        let counted = self.by_channel.values().filter(|s| s.count > 0);
        Statistics {
            message_count: counted.clone().map(|s| s.count).sum(),
            schema_count: definitions.schemas.len() as u16,
            channel_count: definitions.channels.len() as u32,
            attachment_count: self.attachments.len() as u32,
            metadata_count: self.metadata.len() as u32,
            chunk_count: self.chunks.len() as u32,
            message_start_time: counted.clone().map(|s| s.first_ns).min().unwrap_or(0),
            message_end_time: counted.map(|s| s.last_ns).max().unwrap_or(0),
            channel_message_counts: self.by_channel.iter().map(|(id, s)| (*id, s.count)).collect(),
        }
    }
}
