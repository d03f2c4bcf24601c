//! Counts of a decoder's bytes by result.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

/// Why a sentence or packet was refused.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Refusal {
    /// Longer than any sentence of the format.
    TooLong,
    /// Cut short by the start of another.
    CutShort,
    /// Bytes that are not printable ASCII.
    NotAscii,
    /// No `*HH` where the format has one.
    NoChecksum,
    /// Checksum or CRC does not match.
    BadChecksum,
    /// Fields missing or of the wrong type.
    Malformed,
    /// An impossible value: latitude beyond the poles, hour 25, not a number.
    OutOfRange,
    /// Arrived after its epoch was output.
    AfterItsEpoch,
    /// Belongs to a burst whose sentences with a time were lost.
    NoTime,
}

impl Refusal {
    /// As text.
    pub const fn words(self) -> &'static str {
        match self {
            Self::TooLong => "too long",
            Self::CutShort => "cut short",
            Self::NotAscii => "not ASCII",
            Self::NoChecksum => "no checksum",
            Self::BadChecksum => "bad checksum",
            Self::Malformed => "malformed",
            Self::OutOfRange => "value out of range",
            Self::AfterItsEpoch => "after its epoch was complete",
            Self::NoTime => "burst without a time",
        }
    }
}

/// Counts of a decoder.
///
/// ```
/// use windhover_base::time::MonoTime;
/// use windhover_decode::{GnssDecoder, Refusal, framed};
///
/// let (mut decoder, mut epochs) = (GnssDecoder::new(), Vec::new());
/// // A wrong checksum; an impossible speed, which is left out alone.
/// let speed = framed("GPRMC,101112,A,3030.0,N,08530.0,W,-1.0,90.0,010226,,,A") + "\r\n";
/// decoder.push(b"$GPRMC,101111,A*00\r\n", MonoTime::default(), &mut epochs);
/// decoder.push(speed.as_bytes(), MonoTime::default(), &mut epochs);
/// let counts = decoder.counts();
/// assert_eq!((counts.used, counts.refused(Refusal::BadChecksum)), (1, 1));
/// assert_eq!(counts.left_out().collect::<Vec<_>>(), [("RMC speed", 1)]);
/// ```
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct DecodeCounts {
    /// Sentences or packets that were used.
    pub used: u64,
    /// Valid sentences or packets that have no wanted values.
    pub ignored: u64,
    /// Bytes outside any sentence or packet.
    pub noise_bytes: u64,
    /// Valid readings of which the device itself marked a part as invalid.
    pub flagged: u64,
    refused: BTreeMap<Refusal, u64>,
    left_out: BTreeMap<Cow<'static, str>, u64>,
}

impl DecodeCounts {
    pub(super) fn refuse(&mut self, why: Refusal) {
        *self.refused.entry(why).or_insert(0) += 1;
    }

    pub(super) fn leave_out(&mut self, field: impl Into<Cow<'static, str>>) {
        *self.left_out.entry(field.into()).or_insert(0) += 1;
    }

    /// Fields left out of sentences that were used otherwise, by name, with their counts.
    pub fn left_out(&self) -> impl Iterator<Item = (&str, u64)> + '_ {
        self.left_out.iter().map(|(field, count)| (field.as_ref(), *count))
    }

    /// Whether there was no valid sentence or packet at all: the bytes are of another device, speed or format.
    pub const fn understood_nothing(&self) -> bool {
        self.used == 0 && self.ignored == 0
    }

    /// How often this was the reason for a refusal.
    pub fn refused(&self, why: Refusal) -> u64 {
        self.refused.get(&why).copied().unwrap_or(0)
    }

    /// All refusals.
    pub fn refused_total(&self) -> u64 {
        self.refused.values().sum()
    }

    /// Every reason that occurred, with its count.
    pub fn refusals(&self) -> impl Iterator<Item = (Refusal, u64)> + '_ {
        self.refused.iter().map(|(why, count)| (*why, *count))
    }
}

impl fmt::Display for DecodeCounts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} used, {} not needed, {} refused", self.used, self.ignored, self.refused_total())?;
        for (index, (why, count)) in self.refusals().enumerate() {
            write!(f, "{}{count} {}", if index == 0 { " (" } else { ", " }, why.words())?;
        }
        if self.refused_total() > 0 {
            write!(f, ")")?;
        }
        for (field, count) in self.left_out() {
            write!(f, ", {count} without {field}")?;
        }
        write!(f, ", {} flagged by the device, {} bytes outside sentences", self.flagged, self.noise_bytes)
    }
}
