//! Honeywell HMR3000 `$PTNTHPR`. Source: Honeywell's manual.

use super::fields::{heading, honour_alarms, tilt};
use super::nmea;
use super::reading::CompassReading;
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::Sentence;

/// The reading of a sentence; `None` where it has no attitude.
pub(super) fn read(
    sentence: &Sentence<'_>,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    match sentence.address() {
        "PTNTHPR" => hmr3000(sentence).map(Some),
        _ => nmea::read(sentence, counts),
    }
}

/// Honeywell `PTNTHPR,heading,S,pitch,S,roll,S`.
fn hmr3000(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    if sentence.fields() < 6 {
        return Err(Refusal::Malformed);
    }
    let mut reading = CompassReading {
        heading_deg: heading(sentence.field(1))?,
        pitch_deg: tilt(sentence.field(3))?,
        roll_deg: tilt(sentence.field(5))?,
        ..CompassReading::default()
    };
    honour_alarms(&mut reading, sentence.field(2), sentence.field(4), sentence.field(6));
    Ok(reading)
}
