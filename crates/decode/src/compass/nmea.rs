//! Headings and transducers of plain NMEA 0183, which most compasses can send in addition to their own sentences.

use super::fields::{heading, optional, tilt};
use super::reading::CompassReading;
use super::{by_gnss, sbg};
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::Sentence;

/// HDG, HDM, HDT, THS and XDR of any talker, and the sentences of receivers with several antennas and of SBG.
pub(super) fn read(
    sentence: &Sentence<'_>,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    let mut reading = CompassReading::default();
    match sentence.formatter() {
        Some("HDG") => {
            // Sensor heading plus deviation is magnetic heading; the variation is applied by this program.
            let deviation = optional(counts, "HDG deviation", signed_east(sentence, 2)).unwrap_or(0.0);
            reading.heading_deg = heading(sentence.field(1))?.map(|deg| (deg + deviation).rem_euclid(360.0));
        }
        Some("HDM") => reading.heading_deg = heading(sentence.field(1))?,
        Some("HDT") => {
            reading.heading_deg = heading(sentence.field(1))?;
            reading.heading_is_true = true;
        }
        Some("THS") => {
            reading.heading_is_true = true;
            reading.flagged = matches!(sentence.field(2), "V" | "S" | "M");
            reading.heading_deg = heading(sentence.field(1))?.filter(|_| !reading.flagged);
        }
        Some("XDR") => return Ok(transducers(sentence, counts)),
        _ => {
            let of_sbg = sbg::read(sentence, counts)?;
            return if of_sbg.is_some() { Ok(of_sbg) } else { by_gnss::read(sentence, counts) };
        }
    }
    reading.flagged |= reading.heading_deg.is_none();
    Ok(Some(reading))
}

/// Degrees and E or W in the next field; east positive.
fn signed_east(sentence: &Sentence<'_>, index: usize) -> Result<Option<f64>, Refusal> {
    let Some(size) = sentence.number(index, 0.0, 180.0)? else {
        return Ok(None);
    };
    match sentence.field(index + 1) {
        "E" => Ok(Some(size)),
        "W" => Ok(Some(-size)),
        _ if size == 0.0 => Ok(Some(0.0)),
        _ => Err(Refusal::Malformed),
    }
}

/// XDR: groups of type, value, unit, name; the angles (type A, unit D) named pitch and roll (or heel), together or in
/// separate sentences.
fn transducers(sentence: &Sentence<'_>, counts: &mut DecodeCounts) -> Option<CompassReading> {
    let mut reading = CompassReading::default();
    for group in 0..sentence.fields() / 4 {
        let at = 1 + group * 4;
        if (sentence.field(at), sentence.field(at + 2)) != ("A", "D") {
            continue;
        }
        let name = sentence.field(at + 3).to_ascii_uppercase();
        if name.starts_with("PITCH") || name.starts_with("PTCH") {
            reading.pitch_deg = optional(counts, "XDR pitch", tilt(sentence.field(at + 1)));
        } else if name.starts_with("ROLL") || name.starts_with("HEEL") {
            reading.roll_deg = optional(counts, "XDR roll", tilt(sentence.field(at + 1)));
        }
    }
    (reading.pitch_deg.is_some() || reading.roll_deg.is_some()).then_some(reading)
}
