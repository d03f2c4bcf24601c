//! Health: how sources, fix, targets and measurements do, once a second.

use std::collections::BTreeMap;

use super::{Disposition, FixKind, MisfitWords, Source, TargetEstimate};
use crate::time::{MonoTime, Span};

/// How one source does.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SourceHealth {
    /// Which.
    pub source: Source,
    /// Epochs, samples or frames in the last second.
    pub rate_hz: f64,
    /// Age of the last; `None` before the first.
    pub age: Option<Span>,
    /// Since the start.
    pub total: u64,
    /// Refused since the start.
    pub refused: u64,
    /// Lost before they could be recorded, since the start.
    pub dropped: u64,
}

impl SourceHealth {
    /// A source from which nothing came.
    pub const fn nothing_from(source: Source) -> Self {
        Self { source, rate_hz: 0.0, age: None, total: 0, refused: 0, dropped: 0 }
    }
}

/// How one target does.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TargetHealth {
    /// Frames in the last second in which a marker of it was seen.
    pub frames_seen: u32,
    /// Its last estimate.
    pub last: TargetEstimate,
}

/// How everything does, once a second of host time.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Health {
    /// When.
    pub t: MonoTime,
    /// The sources there are, in the order of [`Source::ALL`].
    pub sources: Vec<SourceHealth>,
    /// Kind of the last fix.
    pub fix: FixKind,
    /// Satellites of the last fix.
    pub sats: Option<u32>,
    /// Horizontal dilution of precision of the last fix.
    pub hdop: Option<f64>,
    /// Geoid over ellipsoid at the last fix, metres, as the receiver puts it.
    pub geoid_m: Option<f64>,
    /// One-sigma of the fit from UTC to host time.
    pub clock_sigma: Option<Span>,
    /// UTC less host time, by the receiver; `None` until it told both with a fix.
    pub utc_minus_host: Option<Span>,
    /// Targets, in the order of the configuration.
    pub targets: Vec<TargetHealth>,
    /// Measurements by what became of them, since the start.
    pub dispositions: BTreeMap<Disposition, u64>,
    /// What does not fit the configuration, or the filter's model, now.
    pub misfits: Vec<MisfitWords>,
}

impl Health {
    /// How a source does.
    pub fn source(&self, source: Source) -> SourceHealth {
        let listed = self.sources.iter().find(|health| health.source == source);
        listed.copied().unwrap_or(SourceHealth::nothing_from(source))
    }
}
