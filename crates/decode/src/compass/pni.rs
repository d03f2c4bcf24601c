//! PNI binary packets (TCM3, TCM5, TCM XB and successors).
//!
//! Packet: u16 length of the whole packet, frame identity, payload, u16 CRC, big-endian; the CRC is
//! polynomial 0x1021 from 0 over everything before it. Source: PNI's manual.

use std::collections::VecDeque;

use crc::{CRC_16_XMODEM, Crc};

use super::reading::{CompassReading, HeardAttitude, heard};
use crate::counts::{DecodeCounts, Refusal};
use crate::lines::LineSpan;
use windhover_base::time::MonoTime;

const CRC: Crc<u16> = Crc::<u16>::new(&CRC_16_XMODEM);
/// Length, identity and CRC alone.
const PACKET_MIN: usize = 5;
/// No packet a compass sends on its own is longer, so noise is not waited on for long.
const PACKET_MAX: usize = 255;
/// Identity of a data response.
const DATA_RESPONSE: u8 = 5;

/// Collects bytes into packets.
#[derive(Clone, Debug, Default)]
pub(super) struct PacketFramer {
    buffer: VecDeque<u8>,
    little_endian: bool,
    /// Whether what is in the buffer follows a sound packet.
    in_step: bool,
}

/// What the bytes at some place may be.
enum Candidate {
    /// A whole packet of this length.
    Sound(usize),
    /// The begin of a packet.
    Incomplete,
    /// As long as a packet, and its CRC does not match.
    Broken,
    /// Not a length.
    Noise,
}

impl PacketFramer {
    /// Takes the bytes of one read; appends the samples they complete.
    pub(super) fn push(
        &mut self,
        bytes: &[u8],
        t_recv: MonoTime,
        counts: &mut DecodeCounts,
        out: &mut Vec<HeardAttitude>,
    ) {
        for (index, &byte) in bytes.iter().enumerate() {
            self.buffer.push_back(byte);
            while let Some(packet) = self.next_packet(counts) {
                let span = LineSpan {
                    t_last: t_recv,
                    bytes_after: bytes.len() - 1 - index,
                    bytes: packet.len(),
                    ..LineSpan::default()
                };
                match self.reading(&packet) {
                    Ok(Some(reading)) => out.push(heard(reading, span, counts)),
                    Ok(None) => counts.ignored += 1,
                    Err(why) => counts.refuse(why),
                }
            }
        }
    }

    /// Takes a whole sound packet off the buffer; drops what cannot begin one.
    fn next_packet(&mut self, counts: &mut DecodeCounts) -> Option<Vec<u8>> {
        loop {
            match self.packet_at(0) {
                Candidate::Sound(length) => {
                    self.in_step = true;
                    return Some(self.buffer.drain(..length).collect());
                }
                Candidate::Incomplete if self.in_step || self.buffer.len() < 2 => return None,
                // Out of step the length may be any two bytes: a sound packet further on tells.
                Candidate::Incomplete => match self.sound_packet_ahead() {
                    Some(at) => self.skip(at, counts),
                    None => return None,
                },
                Candidate::Broken => {
                    counts.refuse(Refusal::BadChecksum);
                    self.skip(1, counts);
                }
                Candidate::Noise => self.skip(1, counts),
            }
        }
    }

    fn packet_at(&self, at: usize) -> Candidate {
        let (Some(&high), Some(&low)) = (self.buffer.get(at), self.buffer.get(at + 1)) else {
            return Candidate::Incomplete;
        };
        let length = usize::from(u16::from_be_bytes([high, low]));
        if !(PACKET_MIN..=PACKET_MAX).contains(&length) {
            return Candidate::Noise;
        }
        if self.buffer.len() < at + length {
            return Candidate::Incomplete;
        }
        let packet: Vec<u8> = self.buffer.range(at..at + length).copied().collect();
        // Over a packet and its own CRC the sum is zero.
        if CRC.checksum(&packet) == 0 { Candidate::Sound(length) } else { Candidate::Broken }
    }

    fn sound_packet_ahead(&self) -> Option<usize> {
        (1..self.buffer.len()).find(|&at| matches!(self.packet_at(at), Candidate::Sound(_)))
    }

    fn skip(&mut self, bytes: usize, counts: &mut DecodeCounts) {
        self.in_step = false;
        counts.noise_bytes += bytes as u64;
        self.buffer.drain(..bytes);
    }

    /// Components of a data response: a count, then identity and value of each.
    fn reading(&mut self, packet: &[u8]) -> Result<Option<CompassReading>, Refusal> {
        let payload = &packet[2..packet.len() - 2];
        let (Some(&DATA_RESPONSE), Some(&count)) = (payload.first(), payload.get(1)) else {
            return Ok(None);
        };
        let components = components_of(&payload[2..], count)?;
        let plausible = |little: bool| components.iter().all(|component| component.is_plausible(little));
        if !plausible(self.little_endian) {
            if !plausible(!self.little_endian) {
                return Err(Refusal::OutOfRange);
            }
            self.little_endian = !self.little_endian;
        }
        let mut reading = CompassReading::default();
        let mut distorted = false;
        for component in &components {
            let angle = f64::from(component.float(self.little_endian));
            match component.identity {
                HEADING => reading.heading_deg = Some(angle),
                PITCH => reading.pitch_deg = Some(angle),
                ROLL => reading.roll_deg = Some(angle),
                DISTORTION => distorted = component.bytes[0] != 0,
                _ => {}
            }
        }
        if distorted {
            reading.heading_deg = None;
            reading.flagged = true;
        }
        let empty = reading == CompassReading::default();
        Ok((!empty).then_some(reading))
    }
}

const HEADING: u8 = 5;
const TEMPERATURE: u8 = 7;
const DISTORTION: u8 = 8;
const CALIBRATION_STATUS: u8 = 9;
const ACCELERATION: std::ops::RangeInclusive<u8> = 21..=23;
const PITCH: u8 = 24;
const ROLL: u8 = 25;
const MAGNETIC: std::ops::RangeInclusive<u8> = 27..=29;

/// One component: its identity and its bytes, four of a float or one of a flag.
#[derive(Clone, Copy, Debug)]
struct Component {
    identity: u8,
    bytes: [u8; 4],
}

impl Component {
    fn float(&self, little_endian: bool) -> f32 {
        if little_endian { f32::from_le_bytes(self.bytes) } else { f32::from_be_bytes(self.bytes) }
    }

    /// Whether the float is one a compass gives: in range, and zero or not tiny. Read in the wrong
    /// order most figures become huge or tiny.
    fn is_plausible(&self, little_endian: bool) -> bool {
        let (low, high) = match self.identity {
            HEADING => (0.0, 360.0),
            PITCH | ROLL => (-180.0, 180.0),
            _ => return true,
        };
        let value = self.float(little_endian);
        (low..=high).contains(&value) && (value == 0.0 || value.abs() > 1e-6)
    }
}

fn components_of(mut rest: &[u8], count: u8) -> Result<Vec<Component>, Refusal> {
    let mut components = Vec::with_capacity(usize::from(count));
    for _ in 0..count {
        let (&identity, after) = rest.split_first().ok_or(Refusal::Malformed)?;
        let size = match identity {
            DISTORTION | CALIBRATION_STATUS => 1,
            HEADING | TEMPERATURE | PITCH | ROLL => 4,
            _ if ACCELERATION.contains(&identity) || MAGNETIC.contains(&identity) => 4,
            _ => return Err(Refusal::Malformed),
        };
        let value = after.get(..size).ok_or(Refusal::Malformed)?;
        let mut bytes = [0; 4];
        bytes[..size].copy_from_slice(value);
        components.push(Component { identity, bytes });
        rest = &after[size..];
    }
    if rest.is_empty() { Ok(components) } else { Err(Refusal::Malformed) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(identity: u8, payload: &[u8]) -> Vec<u8> {
        let length = (payload.len() + PACKET_MIN) as u16;
        let mut bytes = length.to_be_bytes().to_vec();
        bytes.push(identity);
        bytes.extend_from_slice(payload);
        bytes.extend_from_slice(&CRC.checksum(&bytes).to_be_bytes());
        bytes
    }

    fn data(little: bool, distorted: bool) -> Vec<u8> {
        let float = |value: f32| if little { value.to_le_bytes() } else { value.to_be_bytes() };
        let mut payload = vec![4, HEADING];
        payload.extend(float(123.5));
        payload.push(PITCH);
        payload.extend(float(-2.25));
        payload.push(ROLL);
        payload.extend(float(4.0));
        payload.extend([DISTORTION, u8::from(distorted)]);
        packet(DATA_RESPONSE, &payload)
    }

    fn readings(bytes: &[u8]) -> (Vec<CompassReading>, DecodeCounts) {
        let (mut framer, mut counts, mut out) =
            (PacketFramer::default(), DecodeCounts::default(), Vec::new());
        framer.push(bytes, MonoTime::default(), &mut counts, &mut out);
        (out.iter().map(|heard| heard.reading).collect(), counts)
    }

    #[test]
    fn checksums_of_the_manual() {
        assert_eq!(packet(1, &[]), [0x00, 0x05, 0x01, 0xEF, 0xD4]);
        assert_eq!(packet(4, &[]), [0x00, 0x05, 0x04, 0xBF, 0x71]);
        assert_eq!(packet(0x0A, &[0, 0, 0, 0x14]), [0x00, 0x09, 0x0A, 0, 0, 0, 0x14, 0x5C, 0xF9]);
    }

    #[test]
    fn both_byte_orders_and_noise_between() {
        let mut stream = vec![0xFF, 0x00, 0x00];
        stream.extend(data(false, false));
        stream.push(0x7F);
        stream.extend(packet(1, &[]));
        stream.extend(data(true, false));
        let (out, counts) = readings(&stream);
        let expected = CompassReading {
            heading_deg: Some(123.5),
            pitch_deg: Some(-2.25),
            roll_deg: Some(4.0),
            ..CompassReading::default()
        };
        assert_eq!(out, [expected, expected]);
        assert_eq!((counts.used, counts.ignored, counts.noise_bytes), (2, 1, 4));
    }

    #[test]
    fn distortion_takes_the_heading() {
        let (out, counts) = readings(&data(false, true));
        assert_eq!((out[0].heading_deg, out[0].pitch_deg, counts.flagged), (None, Some(-2.25), 1));
    }

    #[test]
    fn damage_is_refused_and_the_next_packet_read() {
        let mut stream = data(false, false);
        stream[6] ^= 1;
        stream.extend(data(false, false));
        stream.extend(data(false, false));
        let (out, counts) = readings(&stream);
        assert_eq!(out.len(), 2, "{counts}");
        assert!(counts.refused(Refusal::BadChecksum) >= 1);
    }
}
