//! MAVLink 1 and 2 frames from a stream of bytes.
//!
//! Source: <https://mavlink.io/en/guide/serialization.html>.

use mavlink::dialects::development::MavMessage;
use mavlink::{MavlinkVersion, Message, calculate_crc};

use crate::counts::{DecodeCounts, Refusal};

/// First bytes of frames.
const MAGIC: [u8; 2] = [0xfe, 0xfd];
/// Header of each version, including the magic byte; checksum; signature.
const HEADER_V1: usize = 6;
const HEADER_V2: usize = 10;
const CHECKSUM: usize = 2;
const SIGNATURE: usize = 13;
/// Flag of a version 2 header: a signature follows. Other flags are not supported.
const SIGNED: u8 = 0x01;

/// A frame with a correct checksum.
#[derive(Clone, Debug)]
pub struct MavlinkFrame {
    /// System id of its sender.
    pub system: u8,
    /// Component id of its sender.
    pub component: u8,
    /// Its sequence number.
    pub sequence: u8,
    /// Its content.
    pub message: MavMessage,
    /// Its bytes as received.
    pub bytes: Vec<u8>,
}

/// Finds frames in a stream.
///
/// ```
/// use mavlink::dialects::development::{HEARTBEAT_DATA, MavMessage};
/// use mavlink::{MavHeader, write_v2_msg};
/// use windhover_decode::MavlinkFrames;
///
/// let mut bytes = b"noise".to_vec();
/// let header = MavHeader { system_id: 7, component_id: 1, sequence: 3 };
/// write_v2_msg(&mut bytes, header, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default())).expect("memory can be written");
/// let (mut frames, mut found) = (MavlinkFrames::default(), Vec::new());
/// // In two reads.
/// frames.push(&bytes[..9], &mut found);
/// assert!(found.is_empty());
/// frames.push(&bytes[9..], &mut found);
/// assert_eq!((found[0].system, found[0].sequence, frames.counts().noise_bytes), (7, 3, 5));
/// ```
#[derive(Clone, Debug, Default)]
pub struct MavlinkFrames {
    buffer: Vec<u8>,
    counts: DecodeCounts,
}

/// What some bytes begin with.
enum Found {
    /// A frame that is not complete yet.
    Part,
    /// Not a frame.
    Noise(Option<Refusal>),
    /// A frame of this length with a message that is not in the dialect.
    Unknown(usize),
    /// A frame of this length.
    Whole(usize, Box<MavlinkFrame>),
}

impl MavlinkFrames {
    /// Takes bytes; appends the frames that end in them.
    pub fn push(&mut self, bytes: &[u8], out: &mut Vec<MavlinkFrame>) {
        self.buffer.extend_from_slice(bytes);
        let buffer = std::mem::take(&mut self.buffer);
        let mut rest = buffer.as_slice();
        while !rest.is_empty() {
            let skip = rest.iter().position(|byte| MAGIC.contains(byte)).unwrap_or(rest.len());
            self.counts.noise_bytes += skip as u64;
            rest = &rest[skip..];
            let length = match first(rest) {
                Found::Part => break,
                Found::Noise(why) => {
                    self.counts.noise_bytes += 1;
                    why.into_iter().for_each(|why| self.counts.refuse(why));
                    1
                }
                Found::Unknown(length) => {
                    self.counts.ignored += 1;
                    length
                }
                Found::Whole(length, frame) => {
                    out.push(*frame);
                    length
                }
            };
            rest = &rest[length..];
        }
        self.buffer = rest.to_vec();
    }

    /// Counts of the bytes; frames count as used or ignored where they are decoded.
    pub fn counts_mut(&mut self) -> &mut DecodeCounts {
        &mut self.counts
    }

    /// The same.
    pub fn counts(&self) -> &DecodeCounts {
        &self.counts
    }
}

/// What `rest` begins with; its first byte is a magic byte.
fn first(rest: &[u8]) -> Found {
    let v2 = rest.first() == Some(&MAGIC[1]);
    let header = if v2 { HEADER_V2 } else { HEADER_V1 };
    if rest.len() < header {
        return Found::Part;
    }
    let signed = v2 && rest[2] & SIGNED != 0;
    if v2 && rest[2] & !SIGNED != 0 {
        return Found::Noise(None);
    }
    let body = header + usize::from(rest[1]);
    let length = body + CHECKSUM + if signed { SIGNATURE } else { 0 };
    if rest.len() < length {
        return Found::Part;
    }
    let (id, version) = match v2 {
        true => (u32::from_le_bytes([rest[7], rest[8], rest[9], 0]), MavlinkVersion::V2),
        false => (u32::from(rest[5]), MavlinkVersion::V1),
    };
    if MavMessage::default_message_from_id(id).is_none() {
        // Its checksum cannot be computed: the following byte shows whether it was a frame.
        return match rest.get(length) {
            None => Found::Part,
            Some(next) if MAGIC.contains(next) => Found::Unknown(length),
            Some(_) => Found::Noise(None),
        };
    }
    let checksum = u16::from_le_bytes([rest[body], rest[body + 1]]);
    if calculate_crc(&rest[1..body], MavMessage::extra_crc(id)) != checksum {
        return Found::Noise(Some(Refusal::BadChecksum));
    }
    let (sequence, system, component) = match v2 {
        true => (rest[4], rest[5], rest[6]),
        false => (rest[2], rest[3], rest[4]),
    };
    match MavMessage::parse(version, id, &rest[header..body]) {
        Ok(message) => {
            let bytes = rest[..length].to_vec();
            Found::Whole(length, Box::new(MavlinkFrame { system, component, sequence, message, bytes }))
        }
        Err(_) => Found::Noise(Some(Refusal::Malformed)),
    }
}
