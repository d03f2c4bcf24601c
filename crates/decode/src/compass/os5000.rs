//! OceanServer OS5000: tagged words, `OHPR`, and bare lines without checksum. Source: OceanServer's manual.

use super::fields::{heading, tilt};
use super::nmea;
use super::reading::CompassReading;
use super::tagged::{is_tagged, tagged};
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::{Sentence, number};

/// The reading of a sentence; `None` where it has no attitude.
pub(super) fn read(
    sentence: &Sentence<'_>,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    match sentence.address() {
        "OHPR" => heading_pitch_roll(sentence).map(Some),
        address if is_tagged(address) => tagged(sentence.body, counts),
        _ => nmea::read(sentence, counts),
    }
}

/// OceanServer `OHPR,heading,pitch,roll,temperature,…`.
fn heading_pitch_roll(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    if sentence.fields() < 3 {
        return Err(Refusal::Malformed);
    }
    Ok(CompassReading {
        heading_deg: heading(sentence.field(1))?,
        pitch_deg: tilt(sentence.field(2))?,
        roll_deg: tilt(sentence.field(3))?,
        ..CompassReading::default()
    })
}

/// OceanServer format 8: `heading,pitch,roll[,…]`, without frame and checksum, so every field must be a number.
pub(super) fn bare(line: &[u8]) -> Result<Option<CompassReading>, Refusal> {
    let line = std::str::from_utf8(line).map_err(|_| Refusal::NotAscii)?;
    let fields: Vec<&str> = line.split(',').map(str::trim).collect();
    if fields.len() < 3 || fields.iter().any(|field| field.is_empty()) {
        return Err(Refusal::Malformed);
    }
    for field in &fields[3..] {
        number(field, -1e6, 1e6)?;
    }
    Ok(Some(CompassReading {
        heading_deg: heading(fields[0])?,
        pitch_deg: tilt(fields[1])?,
        roll_deg: tilt(fields[2])?,
        ..CompassReading::default()
    }))
}
