//! Pulses of a receiver, each paired with the epoch that it marks.

use std::collections::VecDeque;

use super::{MonoTime, NS_PER_S, Span};

/// Edges that are remembered.
const EDGES_MAX: usize = 64;
/// Edges of equal spacing before they count as pulses.
const EDGES_FIRST: usize = 4;
/// Tolerance of a spacing from a fraction of a second: crystals, interrupts, a missed pulse.
const SPACING_OFF_NS: i64 = 2_000_000;
/// A burst nearer than this to a pulse, before or after it, may belong to either of two pulses: no receiver starts to
/// send so soon, and arrivals are not known better.
const TOO_SOON: Span = Span::from_ns(15_000_000);
/// How long a pulse is valid.
const HOLDS: Span = Span::from_ns(5 * NS_PER_S);
/// Edges without an epoch after which this is reported.
const UNUSED_MIN: u32 = 10;

/// Why pulses are not used.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum PulseTrouble {
    /// They do not come at a fraction of a second.
    Uneven,
    /// By their arrivals, the bursts may belong to one pulse or the next.
    Ambiguous,
    /// No burst after them has a time that they can mark.
    NoBurst,
}

impl PulseTrouble {
    /// As text.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Uneven => {
                "the pulses are not used: they do not come once or several times a second at an even spacing"
            }
            Self::Ambiguous => {
                "the pulses are not used: the sentences arrive at a time at which they may belong to one pulse or the next: \
                 set gps.latency_ms to the receiver's"
            }
            Self::NoBurst => "the pulses are not used: no sentences with a matching time follow them",
        }
    }
}

/// Pairs edges with epochs: an epoch is valid at the pulse before its burst. The statistics of all arrivals (not a
/// single arrival) decide which pulse that is.
#[derive(Clone, Debug, Default)]
pub(super) struct Pulses {
    edges: VecDeque<MonoTime>,
    /// The valid edge, and its host time minus the time of day that it marks.
    paired: Option<(MonoTime, i64)>,
    unused: u32,
    trouble: Option<PulseTrouble>,
}

impl Pulses {
    /// Takes an edge.
    pub(super) fn edge(&mut self, edge: MonoTime) {
        if self.edges.back().is_some_and(|last| edge <= *last) {
            self.edges.clear();
        }
        if self.edges.len() == EDGES_MAX {
            self.edges.pop_front();
        }
        self.edges.push_back(edge);
        self.unused = self.unused.saturating_add(1);
        if self.spacing_ns().is_none() {
            self.trouble = Some(PulseTrouble::Uneven);
        } else if self.trouble == Some(PulseTrouble::Uneven) {
            self.trouble = None;
        }
    }

    /// An epoch of this time of day arrives, by the statistics of all arrivals, at `expected`; `latency` is configured.
    pub(super) fn epoch(&mut self, time_of_day_ns: i64, expected: MonoTime, latency: Span) {
        let Some(spacing_ns) = self.spacing_ns() else { return };
        if time_of_day_ns % spacing_ns != 0 {
            return;
        }
        let Some(&last) = self.edges.back() else { return };
        // Bursts come this long after one of the pulses; the configured latency decides which.
        let rest_ns = (expected - last).ns().rem_euclid(spacing_ns);
        let periods = ((latency.ns() - rest_ns + spacing_ns / 2).div_euclid(spacing_ns)).max(0);
        let after_ns = rest_ns + periods * spacing_ns;
        let off_ns = latency.ns() - after_ns;
        let next_is_as_near = off_ns > spacing_ns * 9 / 20 || (off_ns < -spacing_ns * 9 / 20 && periods > 0);
        if next_is_as_near || !(TOO_SOON.ns()..=spacing_ns - TOO_SOON.ns()).contains(&rest_ns) {
            self.trouble = Some(PulseTrouble::Ambiguous);
            return;
        }
        let marked = |edge: &&MonoTime| ((expected - **edge).ns() - after_ns).abs() <= SPACING_OFF_NS;
        let Some(&edge) = self.edges.iter().find(marked) else {
            self.trouble = self.trouble.or(Some(PulseTrouble::NoBurst));
            return;
        };
        self.paired = Some((edge, edge.ns().wrapping_sub(time_of_day_ns)));
        self.unused = 0;
        self.trouble = None;
    }

    /// Host time minus time of day, where a pulse is valid at `at`.
    pub(super) fn offset_ns(&self, at: MonoTime) -> Option<i64> {
        self.paired.filter(|(edge, _)| (at - *edge).abs() <= HOLDS).map(|(_, offset_ns)| offset_ns)
    }

    /// UTC has stepped by whole seconds relative to host time.
    pub(super) fn shift(&mut self, ns: i64) {
        if let Some((_, offset_ns)) = &mut self.paired {
            *offset_ns = offset_ns.wrapping_add(ns);
        }
    }

    /// The times that pulses marked are no longer known.
    pub(super) fn forget(&mut self) {
        self.paired = None;
    }

    /// Why many consecutive pulses could not be used.
    pub(super) fn trouble(&self) -> Option<PulseTrouble> {
        let many = self.unused >= UNUSED_MIN;
        many.then(|| self.trouble.unwrap_or(PulseTrouble::NoBurst))
    }

    /// The fraction of a second at which the last edges came.
    fn spacing_ns(&self) -> Option<i64> {
        let last = self.edges.len().checked_sub(EDGES_FIRST)?;
        let edges: Vec<MonoTime> = self.edges.range(last..).copied().collect();
        let shortest = edges.windows(2).map(|pair| (pair[1] - pair[0]).ns()).min()?;
        let parts = (NS_PER_S + shortest / 2) / shortest.max(1);
        if !(1..=20).contains(&parts) || NS_PER_S % parts != 0 {
            return None;
        }
        let spacing_ns = NS_PER_S / parts;
        // One pulse may be missing.
        let even =
            |gap: i64| (gap - (gap + spacing_ns / 2) / spacing_ns * spacing_ns).abs() <= SPACING_OFF_NS;
        edges.windows(2).all(|pair| even((pair[1] - pair[0]).ns())).then_some(spacing_ns)
    }
}
