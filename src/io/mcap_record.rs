//! MCAP records from untrusted bytes: every length is compared with the available bytes before memory of that length is
//! allocated.
//!
//! `mcap::parse_record` allocates a string's stated length, up to 4 GB for one record of thirty bytes, and assumes that
//! an attachment is longer than its checksum. [`parse`] first walks the fields (mcap.dev/spec) and passes on only
//! records whose lengths are right.

use std::io::Read;

use mcap::records::{ChunkHeader, Record, op};

/// Bytes before a record's body: op code and length.
pub const RECORD_HEAD: usize = 9;

/// Largest accepted chunk, compressed or not: a larger size is damage, not data.
pub const MAX_CHUNK_BYTES: u64 = 1 << 28;

/// Longest accepted record other than a chunk. One frame of 1280×1024 in colour has 4 MB.
pub const MAX_SMALL_RECORD: u64 = 1 << 26;

/// Memory allocated for a chunk before any of it is decompressed; it grows as the chunk is filled.
const FIRST_ROOM: u64 = 1 << 22;

/// The longest accepted body of a record of this kind.
pub const fn longest(opcode: u8) -> u64 {
    if opcode == op::CHUNK { MAX_CHUNK_BYTES } else { MAX_SMALL_RECORD }
}

/// The record, where its fields fit into its body; `None` where they do not.
pub fn parse(opcode: u8, body: &[u8]) -> Option<Record<'_>> {
    let mut fields = Fields(body);
    match opcode {
        op::HEADER => fields.strings(2)?,
        op::SCHEMA => {
            fields.fixed(2)?;
            fields.strings(3)?;
        }
        op::CHANNEL => {
            fields.fixed(4)?;
            fields.strings(2)?;
            fields.map()?;
        }
        op::CHUNK => {
            fields.fixed(28)?;
            fields.strings(1)?;
        }
        op::CHUNK_INDEX => {
            fields.fixed(32)?;
            // A map of numbers, the length of the indexes, the compression.
            fields.strings(1)?;
            fields.fixed(8)?;
            fields.strings(1)?;
        }
        op::ATTACHMENT => {
            fields.fixed(16)?;
            fields.strings(2)?;
            // The length of the data, and after the data their checksum.
            fields.fixed(12)?;
        }
        op::ATTACHMENT_INDEX => {
            fields.fixed(40)?;
            fields.strings(2)?;
        }
        op::METADATA => {
            fields.strings(1)?;
            fields.map()?;
        }
        op::METADATA_INDEX => {
            fields.fixed(16)?;
            fields.strings(1)?;
        }
        _ => {}
    }
    mcap::parse_record(opcode, body).ok()
}

/// The rest of a record's body.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn fixed(&mut self, bytes: usize) -> Option<()> {
        self.0 = self.0.get(bytes..)?;
        Some(())
    }

    /// Reads this many strings, each after its length in 4 bytes.
    fn strings(&mut self, count: usize) -> Option<()> {
        for _ in 0..count {
            (_, self.0) = sized_u32(self.0)?;
        }
        Some(())
    }

    /// A map of strings after its length in bytes.
    fn map(&mut self) -> Option<()> {
        let (inside, rest) = sized_u32(self.0)?;
        let mut inside = Fields(inside);
        while !inside.0.is_empty() {
            inside.strings(2)?;
        }
        self.0 = rest;
        Some(())
    }
}

/// The bytes after a length in 4 bytes, and the rest.
pub fn sized_u32(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let length = u32::from_le_bytes(bytes.get(..4)?.try_into().ok()?) as usize;
    let rest = bytes.get(4..)?;
    Some((rest.get(..length)?, rest.get(length..)?))
}

/// Op code, body and rest of the first record of `bytes`; `None` where it is not complete.
pub fn split(bytes: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let length = u64::from_le_bytes(bytes.get(1..RECORD_HEAD)?.try_into().ok()?);
    let end = RECORD_HEAD.checked_add(usize::try_from(length).ok()?)?;
    Some((bytes[0], bytes.get(RECORD_HEAD..end)?, &bytes[end..]))
}

/// The records inside a chunk; `None` where it cannot be decompressed, does not have the stated length, or its checksum
/// is wrong.
pub fn unpack_chunk(header: &ChunkHeader, packed: &[u8]) -> Option<Vec<u8>> {
    let size = header.uncompressed_size;
    if size > MAX_CHUNK_BYTES {
        return None;
    }
    let records = match header.compression.as_str() {
        "" => packed.to_vec(),
        "lz4" => unpacked(lz4::Decoder::new(packed).ok()?, size)?,
        "zstd" => unpacked(zstd::Decoder::with_buffer(packed).ok()?, size)?,
        _ => return None,
    };
    let whole = records.len() as u64 == size
        && (header.uncompressed_crc == 0 || crc32fast::hash(&records) == header.uncompressed_crc);
    whole.then_some(records)
}

/// The output of `input`, if it is no longer than `size`.
fn unpacked(input: impl Read, size: u64) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(size.min(FIRST_ROOM) as usize);
    input.take(size + 1).read_to_end(&mut out).ok()?;
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn string(text: &[u8], says: u32) -> Vec<u8> {
        [&says.to_le_bytes(), text].concat()
    }

    /// A complete record of each kind with strings, as bytes, and the places of its lengths.
    fn records() -> Vec<(u8, Vec<u8>, Vec<usize>)> {
        let s = |text: &str| string(text.as_bytes(), text.len() as u32);
        let map = string(&[s("k"), s("v")].concat(), 10);
        let z = |n: usize| vec![0; n];
        vec![
            (op::HEADER, [s("p"), s("lib")].concat(), vec![0, 5]),
            (op::SCHEMA, [z(2), s("n"), s("e"), s("data")].concat(), vec![2, 7, 12]),
            (op::CHANNEL, [z(4), s("/t"), s("e"), map.clone()].concat(), vec![4, 10, 15, 19, 24]),
            (op::CHUNK, [z(28), s("lz4"), z(8)].concat(), vec![28]),
            (op::CHUNK_INDEX, [z(32), string(&z(10), 10), z(8), s("lz4"), z(16)].concat(), vec![32, 54]),
            (op::ATTACHMENT, [z(16), s("n"), s("m"), z(12)].concat(), vec![16, 21]),
            (op::ATTACHMENT_INDEX, [z(40), s("n"), s("m")].concat(), vec![40, 45]),
            (op::METADATA, [s("n"), map].concat(), vec![0, 5, 9, 14]),
            (op::METADATA_INDEX, [z(16), s("n")].concat(), vec![16]),
        ]
    }

    #[test]
    fn whole_records_are_read_and_lengths_beyond_the_body_are_refused() {
        for (opcode, body, lengths) in records() {
            assert!(parse(opcode, &body).is_some(), "op code {opcode}");
            for at in lengths {
                for says in [body.len() as u32, 0x4000_0000, u32::MAX] {
                    let mut hostile = body.clone();
                    hostile[at..at + 4].copy_from_slice(&says.to_le_bytes());
                    assert!(parse(opcode, &hostile).is_none(), "op code {opcode}: {says} at {at}");
                }
            }
            for length in 0..body.len() {
                assert!(parse(opcode, &body[..length]).is_none(), "op code {opcode} cut at {length}");
            }
        }
    }

    #[test]
    fn a_chunk_longer_than_it_says_is_refused() {
        let much = vec![7; 1 << 20];
        let mut lz4 = lz4::EncoderBuilder::new().build(Vec::new()).expect("memory");
        std::io::Write::write_all(&mut lz4, &much).expect("memory");
        let packed = [("lz4", lz4.finish().0), ("zstd", zstd::bulk::compress(&much, 1).expect("packs"))];
        for (name, packed) in packed {
            let says = |uncompressed_size: u64| ChunkHeader {
                message_start_time: 0,
                message_end_time: 0,
                uncompressed_size,
                uncompressed_crc: 0,
                compression: name.into(),
                compressed_size: packed.len() as u64,
            };
            assert_eq!(unpack_chunk(&says(1 << 20), &packed).as_ref(), Some(&much), "{name}");
            for wrong in [0, 1000, (1 << 20) + 1, MAX_CHUNK_BYTES, u64::MAX] {
                assert_eq!(unpack_chunk(&says(wrong), &packed), None, "{name}: {wrong}");
            }
        }
    }
}
