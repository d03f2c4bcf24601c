//! What was recorded of a flight, as values.

use windhover_base::geo::Geodetic;
use windhover_base::msg::{AttitudeSample, FrameObservations, GnssEpoch, Stamped};
use windhover_base::time::MonoTime;

/// The measurements of one flight, each list in order of when it was heard. Times of validity have the configured latencies
/// taken off, as the filter takes them.
#[derive(Clone, Debug, Default)]
pub struct Recording {
    /// GPS epochs.
    pub epochs: Vec<Stamped<GnssEpoch>>,
    /// Compass readings.
    pub readings: Vec<Stamped<AttitudeSample>>,
    /// What the frames showed.
    pub frames: Vec<Stamped<FrameObservations>>,
    /// Where the antenna was, by something better than the receiver on board.
    pub positions: Vec<OutsidePosition>,
}

/// A position of the antenna from outside: of a base station's solution, or a better receiver.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct OutsidePosition {
    /// When, host time.
    pub t: MonoTime,
    /// Where, height above the ellipsoid.
    pub at: Geodetic,
    /// One sigma north, east, down, m.
    pub sigma_m: [f64; 3],
}

/// One of them.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Heard<'a> {
    Epoch(&'a Stamped<GnssEpoch>),
    Reading(&'a Stamped<AttitudeSample>),
    Frame(&'a Stamped<FrameObservations>),
}

impl Heard<'_> {
    pub(crate) fn t_recv(&self) -> MonoTime {
        match self {
            Self::Epoch(m) => m.t_recv,
            Self::Reading(m) => m.t_recv,
            Self::Frame(m) => m.t_recv,
        }
    }
}

impl Recording {
    /// Everything, in order of when it was heard.
    pub(crate) fn in_order(&self) -> Vec<Heard<'_>> {
        let epochs = self.epochs.iter().map(Heard::Epoch);
        let readings = self.readings.iter().map(Heard::Reading);
        let mut all: Vec<Heard<'_>> =
            epochs.chain(readings).chain(self.frames.iter().map(Heard::Frame)).collect();
        all.sort_by_key(Heard::t_recv);
        all
    }
}
