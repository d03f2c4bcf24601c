//! MCAP records as bytes: the few the segment writer needs, exactly as in mcap.dev/spec.
//!
//! The `mcap` crate writes complete files. A segment here consists of appends that are durable one by one, repeats its
//! schemas, and can be repaired from its remains. Reading uses [`mcap_record`](crate::io::mcap_record).

use std::collections::BTreeMap;
use std::io::Write;

use mcap::records::{ChunkHeader, ChunkIndex, op};
use serde::{Deserialize, Serialize};

use crate::io::mcap_record::RECORD_HEAD;

/// First and last bytes of every MCAP file.
pub const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];

/// Private record (op codes from 0x80 on are for applications) that pads an append to a page.
pub const PADDING: u8 = 0xF0;

/// How chunks are compressed.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Compression {
    /// Without compression.
    None,
    /// lz4 frames: fast; halves text and protobuf, and adds nothing to JPEG.
    #[default]
    Lz4,
    /// zstd at level 1: for lossless frames.
    Zstd,
}

impl Compression {
    /// Its name in MCAP.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "",
            Self::Lz4 => "lz4",
            Self::Zstd => "zstd",
        }
    }
}

/// Appends one record; `body` writes the part after its length.
pub fn put_record(out: &mut Vec<u8>, opcode: u8, body: impl FnOnce(&mut Vec<u8>)) {
    out.push(opcode);
    let at = out.len();
    out.extend_from_slice(&[0; 8]);
    body(out);
    let length = (out.len() - at - 8) as u64;
    out[at..at + 8].copy_from_slice(&length.to_le_bytes());
}

/// Appends a string: length in 4 bytes, then UTF-8.
pub fn put_str(out: &mut Vec<u8>, text: &str) {
    put_u32(out, text.len() as u32);
    out.extend_from_slice(text.as_bytes());
}

/// Appends 2 bytes, little-endian.
pub fn put_u16(out: &mut Vec<u8>, value: u16) {
    out.extend_from_slice(&value.to_le_bytes());
}

/// Appends 4 bytes, little-endian.
pub fn put_u32(out: &mut Vec<u8>, value: u32) {
    out.extend_from_slice(&value.to_le_bytes());
}

/// Appends 8 bytes, little-endian.
pub fn put_u64(out: &mut Vec<u8>, value: u64) {
    out.extend_from_slice(&value.to_le_bytes());
}

fn put_map(out: &mut Vec<u8>, map: &BTreeMap<String, String>) {
    put_u32(out, map.iter().map(|(k, v)| 8 + k.len() + v.len()).sum::<usize>() as u32);
    for (key, value) in map {
        put_str(out, key);
        put_str(out, value);
    }
}

/// Appends the Header record.
pub fn put_header(out: &mut Vec<u8>, library: &str) {
    put_record(out, op::HEADER, |b| {
        put_str(b, "");
        put_str(b, library);
    });
}

/// Appends a Schema record.
pub fn put_schema(out: &mut Vec<u8>, id: u16, name: &str, encoding: &str, data: &[u8]) {
    put_record(out, op::SCHEMA, |b| {
        put_u16(b, id);
        put_str(b, name);
        put_str(b, encoding);
        put_u32(b, data.len() as u32);
        b.extend_from_slice(data);
    });
}

/// Appends a Channel record.
pub fn put_channel(out: &mut Vec<u8>, channel: &mcap::records::Channel) {
    put_record(out, op::CHANNEL, |b| {
        put_u16(b, channel.id);
        put_u16(b, channel.schema_id);
        put_str(b, &channel.topic);
        put_str(b, &channel.message_encoding);
        put_map(b, &channel.metadata);
    });
}

/// Appends a Message record; times in nanoseconds of host time.
pub fn put_message(
    out: &mut Vec<u8>,
    channel: u16,
    sequence: u32,
    log_ns: u64,
    publish_ns: u64,
    data: &[u8],
) {
    put_record(out, op::MESSAGE, |b| {
        put_u16(b, channel);
        put_u32(b, sequence);
        put_u64(b, log_ns);
        put_u64(b, publish_ns);
        b.extend_from_slice(data);
    });
}

/// Appends an Attachment record with its checksum.
pub fn put_attachment(out: &mut Vec<u8>, name: &str, media_type: &str, time_ns: u64, data: &[u8]) {
    put_record(out, op::ATTACHMENT, |b| {
        let start = b.len();
        put_u64(b, time_ns);
        put_u64(b, time_ns);
        put_str(b, name);
        put_str(b, media_type);
        put_u64(b, data.len() as u64);
        b.extend_from_slice(data);
        let crc = crc32fast::hash(&b[start..]);
        put_u32(b, crc);
    });
}

/// Appends a Metadata record.
pub fn put_metadata(out: &mut Vec<u8>, name: &str, map: &BTreeMap<String, String>) {
    put_record(out, op::METADATA, |b| {
        put_str(b, name);
        put_map(b, map);
    });
}

/// Appends a Chunk record around `records`, with messages from `start_ns` to `end_ns`.
pub fn put_chunk(
    out: &mut Vec<u8>,
    records: &[u8],
    (start_ns, end_ns): (u64, u64),
    compression: Compression,
) -> std::io::Result<ChunkHeader> {
    let packed = match compression {
        Compression::None => records.to_vec(),
        Compression::Lz4 => {
            let mut encoder = lz4::EncoderBuilder::new().level(0).build(Vec::with_capacity(records.len()))?;
            encoder.write_all(records)?;
            let (packed, done) = encoder.finish();
            done?;
            packed
        }
        Compression::Zstd => zstd::bulk::compress(records, 1)?,
    };
    let header = ChunkHeader {
        message_start_time: start_ns,
        message_end_time: end_ns,
        uncompressed_size: records.len() as u64,
        uncompressed_crc: crc32fast::hash(records),
        compression: compression.name().to_owned(),
        compressed_size: packed.len() as u64,
    };
    put_packed_chunk(out, &header, &packed);
    Ok(header)
}

/// Appends a Chunk record unchanged: header and compressed bytes.
pub fn put_packed_chunk(out: &mut Vec<u8>, header: &ChunkHeader, packed: &[u8]) {
    put_record(out, op::CHUNK, |b| {
        put_u64(b, header.message_start_time);
        put_u64(b, header.message_end_time);
        put_u64(b, header.uncompressed_size);
        put_u32(b, header.uncompressed_crc);
        put_str(b, &header.compression);
        put_u64(b, packed.len() as u64);
        b.extend_from_slice(packed);
    });
}

/// Appends a MessageIndex record: (log time, offset in the uncompressed chunk) of one channel.
pub fn put_message_index(out: &mut Vec<u8>, channel: u16, entries: &[(u64, u64)]) {
    put_record(out, op::MESSAGE_INDEX, |b| {
        put_u16(b, channel);
        put_u32(b, entries.len() as u32 * 16);
        for (log_ns, offset) in entries {
            put_u64(b, *log_ns);
            put_u64(b, *offset);
        }
    });
}

/// Appends a ChunkIndex record.
pub fn put_chunk_index(out: &mut Vec<u8>, index: &ChunkIndex) {
    put_record(out, op::CHUNK_INDEX, |b| {
        put_u64(b, index.message_start_time);
        put_u64(b, index.message_end_time);
        put_u64(b, index.chunk_start_offset);
        put_u64(b, index.chunk_length);
        put_u32(b, index.message_index_offsets.len() as u32 * 10);
        for (channel, offset) in &index.message_index_offsets {
            put_u16(b, *channel);
            put_u64(b, *offset);
        }
        put_u64(b, index.message_index_length);
        put_str(b, &index.compression);
        put_u64(b, index.compressed_size);
        put_u64(b, index.uncompressed_size);
    });
}

/// Appends a Statistics record.
pub fn put_statistics(out: &mut Vec<u8>, s: &mcap::records::Statistics) {
    put_record(out, op::STATISTICS, |b| {
        put_u64(b, s.message_count);
        put_u16(b, s.schema_count);
        put_u32(b, s.channel_count);
        put_u32(b, s.attachment_count);
        put_u32(b, s.metadata_count);
        put_u32(b, s.chunk_count);
        put_u64(b, s.message_start_time);
        put_u64(b, s.message_end_time);
        put_u32(b, s.channel_message_counts.len() as u32 * 10);
        for (channel, count) in &s.channel_message_counts {
            put_u16(b, *channel);
            put_u64(b, *count);
        }
    });
}

/// Appends the footer, whose checksum covers the summary that starts at `out[summary..]`.
pub fn put_footer(out: &mut Vec<u8>, summary: usize, summary_start: u64, offsets_start: u64) {
    out.push(op::FOOTER);
    put_u64(out, 20);
    put_u64(out, summary_start);
    put_u64(out, offsets_start);
    let crc = crc32fast::hash(&out[summary..]);
    put_u32(out, crc);
    out.extend_from_slice(&MAGIC);
}

/// Appends a padding record so that `start + out.len()` is a multiple of `page` bytes.
pub fn pad_to_page(out: &mut Vec<u8>, start: u64, page: u64) {
    let over = (start + out.len() as u64) % page;
    if over == 0 {
        return;
    }
    let mut missing = (page - over) as usize;
    if missing < RECORD_HEAD {
        missing += page as usize;
    }
    put_record(out, PADDING, |b| b.resize(b.len() + missing - RECORD_HEAD, 0));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::mcap_record::unpack_chunk;

    #[test]
    fn chunks_go_there_and_back_and_damage_shows() {
        let mut records = Vec::new();
        for i in 0..50 {
            put_message(&mut records, 1, i, u64::from(i), u64::from(i), &[i as u8; 40]);
        }
        for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
            let mut out = Vec::new();
            let header = put_chunk(&mut out, &records, (0, 49), compression).expect("packs");
            let at = out.len() - header.compressed_size as usize;
            assert_eq!(unpack_chunk(&header, &out[at..]), Some(records.clone()), "{compression:?}");
            let middle = at + (out.len() - at) / 2;
            out[middle] ^= 0x55;
            assert_eq!(unpack_chunk(&header, &out[at..]), None, "{compression:?}");
        }
    }

    #[test]
    fn padding_ends_on_a_page_from_every_offset() {
        for start in 0..4096u64 {
            let mut out = vec![1; 17];
            pad_to_page(&mut out, start, 4096);
            assert_eq!((start + out.len() as u64) % 4096, 0, "from {start}");
        }
    }
}
