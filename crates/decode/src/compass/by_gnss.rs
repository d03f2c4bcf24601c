//! Headings that a receiver measures between its antennas. They are true.
//!
//! | sentence | of | used |
//! |---|---|---|
//! | `HPR` | Unicore (UM982) | heading, where its quality is that of an RTK solution |
//! | `PTNL,AVR` | Trimble | yaw as heading; tilt and roll where both are given; where its quality is not 0 |
//! | `PSAT,HPR` | Hemisphere | heading, pitch, roll, each where given |
//! | `PSSN,HRP` | Septentrio | heading; pitch and roll where both are given; where its mode is not 0 |
//! | `PRDID` | RDI, SBG | pitch, roll, heading |
//! | `PASHR` | many, with an inertial unit | as the format of that name |
//!
//! Two antennas give the heading and one tilt of the line between them: a tilt is used only where the device provides
//! both angles. Sources: the vendors' manuals.

use super::fields::{heading, optional, tilt};
use super::pashr;
use super::reading::CompassReading;
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::Sentence;

/// The reading of such a sentence; `None` for other sentences.
pub(super) fn read(
    sentence: &Sentence<'_>,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    let address_and_type = (sentence.address(), sentence.field(1));
    let (heading_at, pitch_at, roll_at, quality_at) = match address_and_type {
        ("PTNL", "AVR") => (3, 5, 7, Some(10)),
        ("PSAT", "HPR") => (3, 4, 5, None),
        ("PSSN", "HRP") => (4, 6, 5, Some(11)),
        ("PRDID", _) => (3, 1, 2, None),
        ("PASHR", _) => return pashr::read(sentence, counts),
        _ if sentence.formatter() == Some("HPR") => (2, 0, 0, Some(5)),
        _ => return Ok(None),
    };
    if sentence.fields() < heading_at.max(pitch_at) {
        return Err(Refusal::Malformed);
    }
    let mut angle = |name, at: usize| {
        if at == 0 { None } else { optional(counts, name, tilt(sentence.field(at))) }
    };
    let (pitch_deg, roll_deg) =
        (angle("pitch between antennas", pitch_at), angle("roll between antennas", roll_at));
    let mut reading = CompassReading {
        heading_deg: heading_of(sentence.field(heading_at))?,
        heading_is_true: true,
        ..CompassReading::default()
    };
    if pitch_deg.is_some() && roll_deg.is_some() {
        (reading.pitch_deg, reading.roll_deg) = (pitch_deg, roll_deg);
    }
    if quality_at.is_some_and(|at| matches!(sentence.field(at), "" | "0")) {
        (reading.heading_deg, reading.pitch_deg, reading.roll_deg) = (None, None, None);
    }
    reading.flagged = reading.heading_deg.is_none();
    Ok(Some(reading))
}

/// Some report the heading from −180 to 180.
fn heading_of(text: &str) -> Result<Option<f64>, Refusal> {
    match text.strip_prefix('-') {
        Some(size) => {
            Ok(heading(size)?.filter(|deg| *deg <= 180.0).map(|deg| (360.0 - deg).rem_euclid(360.0)))
        }
        None => heading(text),
    }
}
