//! PNI TCM2, TCM2.5 and TCM2.6 word format. Source: PNI's manual.

use super::nmea;
use super::reading::CompassReading;
use super::tagged::{is_tagged, tagged};
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::Sentence;

/// The reading of a sentence; `None` where it has no attitude.
pub(super) fn read(
    sentence: &Sentence<'_>,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    if is_tagged(sentence.address()) { tagged(sentence.body, counts) } else { nmea::read(sentence, counts) }
}
