//! Health: state of sources, fix, targets and measurements, once a second.

use std::collections::BTreeMap;

use super::{Disposition, FixKind, MisfitWords, Source, TargetEstimate};
use crate::time::{MonoTime, Span};

/// State of one source.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SourceHealth {
    /// The source.
    pub source: Source,
    /// Epochs, samples or frames in the last second.
    pub rate_hz: f64,
    /// Age of the last; `None` before the first.
    pub age: Option<Span>,
    /// Number since the start.
    pub total: u64,
    /// Number refused since the start.
    pub refused: u64,
    /// Number lost before recording, since the start.
    pub dropped: u64,
}

impl SourceHealth {
    /// A source without any message.
    pub const fn nothing_from(source: Source) -> Self {
        Self { source, rate_hz: 0.0, age: None, total: 0, refused: 0, dropped: 0 }
    }
}

/// State of one target.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TargetHealth {
    /// Frames in the last second in which a marker of it was seen.
    pub frames_seen: u32,
    /// Its last estimate.
    pub last: TargetEstimate,
}

/// State of all parts, once a second of host time.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Health {
    /// Its time.
    pub t: MonoTime,
    /// The configured sources, in the order of [`Source::ALL`].
    pub sources: Vec<SourceHealth>,
    /// Kind of the last fix.
    pub fix: FixKind,
    /// Satellites of the last fix.
    pub sats: Option<u32>,
    /// Horizontal dilution of precision of the last fix.
    pub hdop: Option<f64>,
    /// Geoid over ellipsoid at the last fix, metres, as the receiver reports it.
    pub geoid_m: Option<f64>,
    /// One-sigma of the fit from UTC to host time.
    pub clock_sigma: Option<Span>,
    /// UTC minus host time, by the receiver; `None` until it has reported a date with a fix.
    pub utc_minus_host: Option<Span>,
    /// Targets, in the order of the configuration.
    pub targets: Vec<TargetHealth>,
    /// Measurements by disposition, since the start.
    pub dispositions: BTreeMap<Disposition, u64>,
    /// Present misfits of the configuration or the filter's model.
    pub misfits: Vec<MisfitWords>,
}

impl Health {
    /// State of a source.
    pub fn source(&self, source: Source) -> SourceHealth {
        let listed = self.sources.iter().find(|health| health.source == source);
        listed.copied().unwrap_or(SourceHealth::nothing_from(source))
    }
}
