//! `$PASHR`, attitude of receivers with an inertial unit.

use super::fields::{heading, optional, tilt};
use super::reading::CompassReading;
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::Sentence;

/// The reading of a sentence; `None` where it has no attitude.
pub(super) fn read(
    sentence: &Sentence<'_>,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    if sentence.address() == "PASHR" { pashr(sentence, counts) } else { Ok(None) }
}

/// `PASHR,hhmmss.sss,heading,T,roll,pitch,heave,…,GPS quality,IMU status`: roll comes before pitch. Without GPS
/// (quality 0) the heading drifts and is not used.
fn pashr(sentence: &Sentence<'_>, counts: &mut DecodeCounts) -> Result<Option<CompassReading>, Refusal> {
    if !sentence.field(1).bytes().next().is_some_and(|byte| byte.is_ascii_digit()) {
        // PASHR,ATT and similar sentences: another grammar under the same address.
        return Ok(None);
    }
    if sentence.fields() < 5 {
        return Err(Refusal::Malformed);
    }
    let mut reading = CompassReading {
        heading_deg: heading(sentence.field(2))?,
        heading_is_true: sentence.field(3) == "T",
        roll_deg: optional(counts, "PASHR roll", tilt(sentence.field(4))),
        pitch_deg: optional(counts, "PASHR pitch", tilt(sentence.field(5))),
        ..CompassReading::default()
    };
    if sentence.field(10) == "0" {
        reading.heading_deg = None;
        reading.flagged = true;
    }
    Ok(Some(reading))
}
