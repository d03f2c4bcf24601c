//! PNI binary packets (TCM3, TCM5, TCM XB, TargetPoint, TRAX, TRAX2 and successors).
//!
//! A data response is a count and that many components, each an identity and its value. Heading, pitch, roll,
//! distortion and heading status are used, the others skipped by their lengths. An angle that is not a number or out of
//! range is left out alone. Bytes after a component of unknown
//! length cannot be read: the packet is used up to there, and the component is counted by its number.
//!
//! Packet: u16 length of the whole packet, frame identity, payload, u16 CRC, big-endian; the CRC is polynomial 0x1021
//! from 0 over everything before it. Source: PNI's manual.

use std::collections::VecDeque;

use crc::{CRC_16_XMODEM, Crc};

use super::reading::{CompassReading, ReceivedAttitude, received};
use crate::counts::{DecodeCounts, Refusal};
use crate::lines::LineSpan;
use windhover_base::time::MonoTime;

const CRC: Crc<u16> = Crc::<u16>::new(&CRC_16_XMODEM);
/// Length, identity and CRC alone.
const PACKET_MIN: usize = 5;
/// Largest packet that a compass sends unasked, so that noise is not waited on for long.
const PACKET_MAX: usize = 255;
/// Identity of a data response.
const DATA_RESPONSE: u8 = 5;

/// Collects bytes into packets.
#[derive(Clone, Debug, Default)]
pub(super) struct PacketFramer {
    buffer: VecDeque<u8>,
    little_endian: bool,
    /// Whether the buffer follows a valid packet.
    in_step: bool,
}

/// What the bytes at some place may be.
enum Candidate {
    /// A complete valid packet of this length.
    Sound(usize),
    /// The start of a packet.
    Incomplete,
    /// Of a packet's length, with a wrong CRC.
    Broken,
    /// Not a valid length.
    Noise,
}

impl PacketFramer {
    /// Takes the bytes of one read; appends the completed samples.
    pub(super) fn push(
        &mut self,
        bytes: &[u8],
        t_recv: MonoTime,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedAttitude>,
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
                match self.reading(&packet, counts) {
                    Ok(Some(reading)) => {
                        counts.used += 1;
                        out.push(received(reading, span, span, counts));
                    }
                    Ok(None) => counts.ignored += 1,
                    Err(why) => counts.refuse(why),
                }
            }
        }
    }

    /// Removes a complete valid packet from the buffer; drops bytes that cannot begin one.
    fn next_packet(&mut self, counts: &mut DecodeCounts) -> Option<Vec<u8>> {
        loop {
            match self.packet_at(0) {
                Candidate::Sound(length) => {
                    self.in_step = true;
                    return Some(self.buffer.drain(..length).collect());
                }
                Candidate::Incomplete if self.in_step || self.buffer.len() < 2 => return None,
                // Out of step the length may be any two bytes: a valid packet further on shows it.
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

    /// Takes the other byte order where it makes more of the angles plausible.
    fn settle_order(&mut self, components: &[Component]) {
        let plausible = |little: bool| {
            components.iter().filter(|part| part.angle().is_some() && part.is_plausible(little)).count()
        };
        if plausible(!self.little_endian) > plausible(self.little_endian) {
            self.little_endian = !self.little_endian;
        }
    }

    /// Components of a data response: a count, then identity and value of each.
    fn reading(
        &mut self,
        packet: &[u8],
        counts: &mut DecodeCounts,
    ) -> Result<Option<CompassReading>, Refusal> {
        let payload = &packet[2..packet.len() - 2];
        let (Some(&DATA_RESPONSE), Some(&count)) = (payload.first(), payload.get(1)) else {
            return Ok(None);
        };
        let (components, unknown) = components_of(&payload[2..], count)?;
        if let Some(identity) = unknown {
            counts.leave_out(format!("component {identity}, of unknown length, and the rest after it"));
            if !components.iter().any(|component| component.angle().is_some()) {
                return Err(Refusal::Malformed);
            }
        }
        self.settle_order(&components);
        let is_impossible =
            |part: &Component| part.angle().is_some() && !part.is_plausible(self.little_endian);
        let (impossible, components): (Vec<_>, Vec<_>) = components.into_iter().partition(is_impossible);
        if !impossible.is_empty() && !components.iter().any(|part| part.angle().is_some()) {
            return Err(Refusal::OutOfRange);
        }
        impossible.iter().filter_map(Component::angle).for_each(|name| counts.leave_out(name));
        let mut reading = CompassReading::default();
        let mut distorted = false;
        for component in &components {
            let angle = f64::from(component.float(self.little_endian));
            match component.identity {
                HEADING => reading.heading_deg = Some(angle),
                PITCH => reading.pitch_deg = Some(angle),
                ROLL => reading.roll_deg = Some(angle),
                DISTORTION => distorted |= component.bytes[0] != 0,
                HEADING_STATUS => distorted |= component.bytes[0] == STATUS_POOR,
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
const GYRO: std::ops::RangeInclusive<u8> = 74..=76;
const QUATERNION: u8 = 77;
const HEADING_STATUS: u8 = 79;
const MAGNETIC_ACCURACY: u8 = 88;
/// Heading status for an uncertainty beyond 10 degrees (1: within 2 degrees, 2: within 10).
const STATUS_POOR: u8 = 3;

/// Bytes of a component's value.
fn length_of(identity: u8) -> Option<usize> {
    match identity {
        DISTORTION | CALIBRATION_STATUS | HEADING_STATUS => Some(1),
        HEADING | TEMPERATURE | PITCH | ROLL | MAGNETIC_ACCURACY => Some(4),
        QUATERNION => Some(16),
        _ if [ACCELERATION, MAGNETIC, GYRO].iter().any(|of| of.contains(&identity)) => Some(4),
        _ => None,
    }
}

/// One component: its identity and the first bytes of its value, four for a float or one for a flag.
#[derive(Clone, Copy, Debug)]
struct Component {
    identity: u8,
    bytes: [u8; 4],
}

impl Component {
    fn float(&self, little_endian: bool) -> f32 {
        if little_endian { f32::from_le_bytes(self.bytes) } else { f32::from_be_bytes(self.bytes) }
    }

    /// Its name where it is an angle of the attitude.
    const fn angle(&self) -> Option<&'static str> {
        match self.identity {
            HEADING => Some("PNI heading"),
            PITCH => Some("PNI pitch"),
            ROLL => Some("PNI roll"),
            _ => None,
        }
    }

    /// Whether the float is plausible for a compass: in range, and zero or not tiny. In the wrong byte order most
    /// numbers become huge or tiny.
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

/// The components up to the first of unknown length, and that one's identity.
fn components_of(mut rest: &[u8], count: u8) -> Result<(Vec<Component>, Option<u8>), Refusal> {
    let mut components = Vec::with_capacity(usize::from(count));
    for _ in 0..count {
        let (&identity, after) = rest.split_first().ok_or(Refusal::Malformed)?;
        let Some(length) = length_of(identity) else {
            return Ok((components, Some(identity)));
        };
        let value = after.get(..length).ok_or(Refusal::Malformed)?;
        let mut bytes = [0; 4];
        bytes.iter_mut().zip(value).for_each(|(to, from)| *to = *from);
        components.push(Component { identity, bytes });
        rest = &after[length..];
    }
    if rest.is_empty() { Ok((components, None)) } else { Err(Refusal::Malformed) }
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
        (out.iter().map(|received| received.reading).collect(), counts)
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

    fn component(identity: u8, value: &[u8]) -> Vec<u8> {
        [&[identity], value].concat()
    }

    fn attitude() -> Vec<Vec<u8>> {
        [(HEADING, 123.5f32), (PITCH, -2.25), (ROLL, 4.0)]
            .map(|(identity, angle)| component(identity, &angle.to_be_bytes()))
            .to_vec()
    }

    fn response(components: &[Vec<u8>]) -> Vec<u8> {
        packet(DATA_RESPONSE, &[&[components.len() as u8], components.concat().as_slice()].concat())
    }

    #[test]
    fn heading_status_tells_a_poor_heading() {
        for (status, valid) in [(0, true), (1, true), (2, true), (3, false)] {
            let mut components = attitude();
            components.push(component(HEADING_STATUS, &[status]));
            let (out, counts) = readings(&response(&components));
            assert_eq!((out.len(), out[0].is_valid()), (1, valid), "{status}: {counts}");
        }
    }

    #[test]
    fn what_is_of_unknown_length_is_named() {
        let mut components = attitude();
        components.push(component(99, &[1, 2, 3]));
        let (out, counts) = readings(&response(&components));
        assert_eq!((out.len(), counts.used, counts.refused_total()), (1, 1, 0));
        assert!(
            counts.left_out().next().is_some_and(|(name, n)| name.starts_with("component 99,") && n == 1)
        );
        components.rotate_right(1);
        let (out, counts) = readings(&response(&components));
        assert_eq!((out.len(), counts.refused(Refusal::Malformed)), (0, 1));
        assert!(counts.to_string().contains("component 99,"), "{counts}");
    }

    #[test]
    fn an_impossible_angle_costs_only_itself() {
        let all = [Some(123.5), Some(-2.25), Some(4.0)];
        for (at, name) in ["PNI heading", "PNI pitch", "PNI roll"].into_iter().enumerate() {
            for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 400.0, -1e20, 1e-30] {
                for little in [false, true] {
                    let angles = [(HEADING, 123.5), (PITCH, -2.25), (ROLL, 4.0)];
                    let mut parts = angles.map(|(identity, angle): (u8, f32)| {
                        component(identity, &if little { angle.to_le_bytes() } else { angle.to_be_bytes() })
                    });
                    let bytes = if little { wrong.to_le_bytes() } else { wrong.to_be_bytes() };
                    parts[at] = component(angles[at].0, &bytes);
                    let (out, counts) = readings(&response(&parts));
                    let mut expected = all;
                    expected[at] = None;
                    assert_eq!(out.len(), 1, "{name} {wrong} {little}: {counts}");
                    assert_eq!(
                        [out[0].heading_deg, out[0].pitch_deg, out[0].roll_deg],
                        expected,
                        "{name} {wrong}"
                    );
                    assert_eq!(counts.left_out().collect::<Vec<_>>(), [(name, 1)]);
                    assert_eq!((counts.used, counts.refused_total()), (1, 0));
                }
            }
        }
        // Without any angle there is no reading.
        let none = [component(HEADING, &f32::NAN.to_be_bytes()), component(PITCH, &f32::NAN.to_be_bytes())];
        let (out, counts) = readings(&response(&none));
        assert_eq!((out.len(), counts.refused(Refusal::OutOfRange)), (0, 1));
    }

    proptest::proptest! {
        #[test]
        fn other_components_change_nothing_wherever_they_stand(
            others in proptest::collection::vec((proptest::sample::select(OTHERS.to_vec()), 0usize..4), 0..12),
            filling: u8,
        ) {
            let mut components = attitude();
            for (identity, at) in others {
                let value = vec![filling; length_of(identity).expect("in the table")];
                components.insert(at, component(identity, &value));
            }
            let (out, counts) = readings(&response(&components));
            proptest::prop_assert_eq!(out.len(), 1, "{}", counts);
            let angles = (out[0].heading_deg, out[0].pitch_deg, out[0].roll_deg);
            proptest::prop_assert_eq!(angles, (Some(123.5), Some(-2.25), Some(4.0)));
            proptest::prop_assert_eq!(counts.refused_total(), 0);
        }
    }

    /// Components without attitude.
    const OTHERS: [u8; 13] =
        [TEMPERATURE, CALIBRATION_STATUS, 21, 22, 23, 27, 28, 29, 74, 75, 76, QUATERNION, MAGNETIC_ACCURACY];
}
