//! True North Revolution `$PTNTHTM`. Source: True North's manual.

use super::fields::honour_alarms;
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
        "PTNTHTM" => revolution(sentence).map(Some),
        // The XDR has raw counts, and otherwise only values of PTNTHM's sentence.
        address if address.ends_with("XDR") => Ok(None),
        _ => nmea::read(sentence, counts),
    }
}

/// True North `PTNTHTM,heading,S,pitch,S,roll,S,dip,field`; angles are counts of a 65536th turn.
fn revolution(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    if sentence.fields() < 6 {
        return Err(Refusal::Malformed);
    }
    let counts = |index, low, high| -> Result<Option<f64>, Refusal> {
        Ok(sentence.number(index, low, high)?.map(|counts| counts * 360.0 / 65_536.0))
    };
    let mut reading = CompassReading {
        heading_deg: counts(1, 0.0, 65_536.0)?,
        pitch_deg: counts(3, -32_768.0, 32_768.0)?,
        roll_deg: counts(5, -32_768.0, 32_768.0)?,
        ..CompassReading::default()
    };
    honour_alarms(&mut reading, sentence.field(2), sentence.field(4), sentence.field(6));
    Ok(reading)
}
