//! Words of tagged numbers, `C328.3P28.4R-12.4`, as PNI TCM2 and OceanServer OS5000 send them.

use super::fields::{heading, optional, tilt};
use super::reading::CompassReading;
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::number;

/// `C328.3P28.4…`: a `C` that is directly followed by a number or another tag.
pub(super) fn is_tagged(address: &str) -> bool {
    let mut bytes = address.bytes();
    let first = bytes.next();
    let second = bytes.next();
    matches!(first, Some(b'C' | b'P' | b'R' | b'X' | b'T' | b'E' | b'M'))
        && second.is_some_and(|byte| {
            byte.is_ascii_digit() || matches!(byte, b'-' | b'+' | b'.' | b'x' | b'y' | b'z')
        })
}

/// Inclinometer out of range (TCM2 error word): neither the tilt nor the heading computed with it is valid.
const TCM2_TILT: u16 = 0x002;
/// Magnetometer out of range.
const TCM2_MAGNETOMETER: u16 = 0x004;
/// Magnetic distortion (TCM2; reserved, so never set, on the 2.5 and 2.6).
const TCM2_DISTORTION: u16 = 0x001;

/// PNI TCM2 and OceanServer: letters, then a number, for each item; any item may be absent. Items other than heading C,
/// pitch P, roll R and error word E are checked and ignored.
pub(super) fn tagged(body: &str, counts: &mut DecodeCounts) -> Result<Option<CompassReading>, Refusal> {
    let mut reading = CompassReading::default();
    let mut errors = 0u16;
    let mut rest = body;
    while !rest.is_empty() {
        let letters = rest.len() - rest.trim_start_matches(|c: char| c.is_ascii_alphabetic()).len();
        // The error word is hexadecimal and its letters look like tags.
        let (tag, value) = if rest.starts_with('E') {
            ("E", rest.get(1..4).ok_or(Refusal::Malformed)?)
        } else {
            let figures = &rest[letters..];
            let end = figures.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(figures.len());
            (&rest[..letters], &figures[..end])
        };
        if tag.is_empty() || value.is_empty() {
            return Err(Refusal::Malformed);
        }
        match tag {
            "C" => reading.heading_deg = heading(value)?,
            "P" => reading.pitch_deg = tilt(value)?,
            "R" => reading.roll_deg = tilt(value)?,
            "E" => errors = u16::from_str_radix(value, 16).map_err(|_| Refusal::Malformed)?,
            _ => {
                optional(counts, "a value beside heading, pitch and roll", number(value, -1e6, 1e6));
            }
        }
        rest = &rest[tag.len() + value.len()..];
    }
    if errors & TCM2_TILT != 0 {
        reading.pitch_deg = None;
        reading.roll_deg = None;
    }
    if errors & (TCM2_TILT | TCM2_MAGNETOMETER | TCM2_DISTORTION) != 0 {
        reading.heading_deg = None;
        reading.flagged = true;
    }
    Ok(Some(reading))
}
