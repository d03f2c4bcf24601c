//! MPEG transport streams (ISO/IEC 13818-1): one program of a video and its KLV, carried synchronously (MISB ST 1402).

use crc::{CRC_32_MPEG_2, Crc};

pub(super) const PACKET: usize = 188;
const SYNC: u8 = 0x47;
const PAT_PID: u16 = 0;
const PMT_PID: u16 = 0x1000;
const VIDEO_PID: u16 = 0x100;
const KLV_PID: u16 = 0x101;
/// AVC; metadata in PES packets.
const VIDEO_TYPE: u8 = 0x1b;
const KLV_TYPE: u8 = 0x15;
const VIDEO_STREAM_ID: u8 = 0xe0;
/// Metadata stream.
const KLV_STREAM_ID: u8 = 0xfc;
/// How far a player's clock is behind the displayed time, ticks of 90 kHz: 200 ms.
const BEHIND: u64 = 18_000;
/// Largest interval of the clock (ST 1402: 100 ms), and of the tables with it (250 ms).
const CLOCK_EVERY: u64 = 7_200;
/// Longest pause that is filled, ticks: a minute.
const LONGEST_PAUSE: u64 = 60 * 90_000;
/// Description of KLV for decoders (metadata descriptor): general application, format identifier, service 0, no
/// configuration.
const METADATA: [u8; 11] = [0x26, 9, 1, 0, 0xff, b'K', b'L', b'V', b'A', 0, 0x0f];
/// Its buffer model (metadata STD descriptor): 4 Mbit/s in, 32 KiB, no rate out, because it is synchronous.
const METADATA_STD: [u8; 11] = [0x27, 9, 0xc0, 0x27, 0x10, 0xc0, 0, 0x20, 0xc0, 0, 0];
const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_MPEG_2);

/// A carried unit.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Unit {
    /// An access unit of H.264, with its delimiter, and whether decoding can start at it.
    Video {
        /// An instantaneous refresh.
        key: bool,
    },
    /// A KLV packet.
    Klv,
}

/// Counts and cuts packets.
#[derive(Clone, Debug, Default)]
pub struct TransportStream {
    counters: [u8; 4],
    /// Numbers KLV.
    sequence: u8,
    /// Time of the last clock.
    clock: Option<u64>,
}

impl TransportStream {
    /// Appends the packets before a frame that is shown at `pts`: the tables, and the clock over the time since the
    /// last one.
    pub fn before(&mut self, pts: u64, out: &mut Vec<u8>) {
        let now = pts.saturating_sub(BEHIND);
        if let Some(last) = self.clock.filter(|last| now.saturating_sub(*last) < LONGEST_PAUSE) {
            for pcr in (last + CLOCK_EVERY..now).step_by(CLOCK_EVERY as usize) {
                self.tables(out);
                let mut field = clock_field(pcr, false);
                field.resize(PACKET - 5, 0xff);
                // A packet without payload is not counted.
                out.extend([
                    SYNC,
                    (VIDEO_PID >> 8) as u8,
                    VIDEO_PID as u8,
                    0x20 | (self.counters[2].wrapping_sub(1) & 0xf),
                ]);
                out.push(field.len() as u8);
                out.extend(field);
            }
        }
        self.clock = Some(now);
        self.tables(out);
    }

    fn tables(&mut self, out: &mut Vec<u8>) {
        let pat = [0, 1, 0xe0 | (PMT_PID >> 8) as u8, PMT_PID as u8];
        self.section(PAT_PID, 0, 0, &pat, out);
        let mut pmt = vec![0xe0 | (VIDEO_PID >> 8) as u8, VIDEO_PID as u8, 0xf0, 0];
        pmt.extend(stream(VIDEO_TYPE, VIDEO_PID, &[]));
        pmt.extend(stream(KLV_TYPE, KLV_PID, &[METADATA, METADATA_STD].concat()));
        self.section(PMT_PID, 1, 2, &pmt, out);
    }

    fn section(&mut self, pid: u16, counter: usize, table: u8, body: &[u8], out: &mut Vec<u8>) {
        // Table, length from after itself including the checksum, number 1, version 0 and current, section 0 of 0.
        let length = body.len() + 9;
        let mut section = vec![table, 0xb0 | (length >> 8) as u8, length as u8, 0, 1, 0xc1, 0, 0];
        section.extend_from_slice(body);
        section.extend(CRC.checksum(&section).to_be_bytes());
        let at = out.len();
        out.extend(self.head(pid, counter, true, 1));
        out.push(0);
        out.extend(section);
        out.resize(at + PACKET, 0xff);
    }

    /// Four bytes; `adaptation`: 1 payload alone, 3 an adaptation field before it.
    fn head(&mut self, pid: u16, counter: usize, begins: bool, adaptation: u8) -> [u8; 4] {
        let count = self.counters[counter];
        self.counters[counter] = (count + 1) & 0xf;
        let begin = if begins { 0x40 } else { 0 };
        [SYNC, begin | (pid >> 8) as u8, pid as u8, adaptation << 4 | count]
    }

    /// Appends a unit that is shown at `pts`, ticks of 90 kHz.
    pub fn unit(&mut self, unit: Unit, pts: u64, data: &[u8], out: &mut Vec<u8>) {
        let (pid, counter, stream_id) = match unit {
            Unit::Video { .. } => (VIDEO_PID, 2, VIDEO_STREAM_ID),
            Unit::Klv => (KLV_PID, 3, KLV_STREAM_ID),
        };
        // A video's length may be left open, and must be where it does not fit. KLV is one complete cell: service 0,
        // its number, complete and a random access point, its length.
        let (length, cell) = match unit {
            Unit::Video { .. } => (0, Vec::new()),
            Unit::Klv => {
                let size = data.len() as u16;
                self.sequence = self.sequence.wrapping_add(1);
                (size + 5 + 8, vec![0, self.sequence, 0xdf, (size >> 8) as u8, size as u8])
            }
        };
        let mut pes = vec![0, 0, 1, stream_id, (length >> 8) as u8, length as u8];
        // Aligned to the unit's start; only a presentation time follows.
        pes.extend([0x84, 0x80, 5]);
        pes.extend(time_stamp(pts));
        pes.extend(cell);
        pes.extend_from_slice(data);
        let clock = match unit {
            Unit::Video { key } => Some((pts.saturating_sub(BEHIND), key)),
            Unit::Klv => None,
        };
        let mut rest = &pes[..];
        let mut first = true;
        while !rest.is_empty() {
            let field = clock.filter(|_| first).map_or(Vec::new(), |(pcr, key)| clock_field(pcr, key));
            rest = self.packet(pid, counter, first, field, rest, out);
            first = false;
        }
    }

    /// Appends one packet; returns the rest of the payload. The adaptation field grows where the payload does not fill
    /// the packet.
    fn packet<'a>(
        &mut self,
        pid: u16,
        counter: usize,
        begins: bool,
        mut field: Vec<u8>,
        payload: &'a [u8],
        out: &mut Vec<u8>,
    ) -> &'a [u8] {
        let room = PACKET - 4;
        let with_length = |field: &[u8]| if field.is_empty() { 0 } else { field.len() + 1 };
        let taken = payload.len().min(room - with_length(&field));
        let stuffing = room - with_length(&field) - taken;
        let has_field = !field.is_empty() || stuffing > 0;
        if field.is_empty() && stuffing > 1 {
            // Length and flags are two of the bytes to fill.
            field = vec![0];
            field.resize(stuffing - 1, 0xff);
        } else if !field.is_empty() {
            field.resize(field.len() + stuffing, 0xff);
        }
        out.extend(self.head(pid, counter, begins, if has_field { 3 } else { 1 }));
        if has_field {
            out.push(field.len() as u8);
            out.extend(field);
        }
        out.extend_from_slice(&payload[..taken]);
        &payload[taken..]
    }
}

/// A stream's entry in the program's table.
fn stream(kind: u8, pid: u16, descriptors: &[u8]) -> Vec<u8> {
    let length = descriptors.len();
    let mut entry = vec![kind, 0xe0 | (pid >> 8) as u8, pid as u8, 0xf0 | (length >> 8) as u8, length as u8];
    entry.extend_from_slice(descriptors);
    entry
}

/// 33 bits of time among marker bits.
fn time_stamp(pts: u64) -> [u8; 5] {
    let bits = |shift: u32, mask: u64| (pts >> shift & mask) as u8;
    [0x21 | bits(30, 7) << 1, bits(22, 0xff), bits(15, 0x7f) << 1 | 1, bits(7, 0xff), bits(0, 0x7f) << 1 | 1]
}

/// An adaptation field with the program's clock: flags, 33 bits of 90 kHz, six reserved, nine of 27 MHz that are zero.
fn clock_field(pcr: u64, key: bool) -> Vec<u8> {
    let base = pcr & 0x1_ffff_ffff;
    let mut field = vec![if key { 0x50 } else { 0x10 }];
    field.extend(((base >> 1) as u32).to_be_bytes());
    field.extend([((base & 1) << 7) as u8 | 0x7e, 0]);
    field
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_length_fills_whole_packets() {
        for length in 0..600 {
            for unit in [Unit::Klv, Unit::Video { key: true }] {
                let mut out = Vec::new();
                let data: Vec<u8> = (0..length).map(|k| k as u8 | 1).collect();
                TransportStream::default().unit(unit, 90_000, &data, &mut out);
                assert_eq!(out.len() % PACKET, 0);
                let mut payload = Vec::new();
                for packet in out.chunks(PACKET) {
                    assert_eq!(packet[0], SYNC);
                    let skip = if packet[3] & 0x20 != 0 { 5 + usize::from(packet[4]) } else { 4 };
                    payload.extend_from_slice(&packet[skip..]);
                }
                let before = if unit == Unit::Klv { 19 } else { 14 };
                assert_eq!(payload[before..], data[..], "{length} bytes");
            }
        }
    }
}
