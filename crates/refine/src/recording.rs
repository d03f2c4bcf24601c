//! The measurements of a recorded flight, as values.

use windhover_base::geo::Geodetic;
use windhover_base::msg::{AttitudeSample, FrameObservations, GnssEpoch, MarkerId, Stamped};
use windhover_base::time::MonoTime;

/// The measurements of one flight, each list in order of reception. Times of validity are corrected by the configured
/// latencies, as for the filter.
#[derive(Clone, Debug, Default)]
pub struct Recording {
    /// GPS epochs.
    pub epochs: Vec<Stamped<GnssEpoch>>,
    /// Compass readings.
    pub readings: Vec<Stamped<AttitudeSample>>,
    /// The detections of the frames.
    pub frames: Vec<Stamped<FrameObservations>>,
    /// Positions of the antenna from a better source than the receiver on board.
    pub positions: Vec<OutsidePosition>,
    /// Markers at rest whose positions are known.
    pub surveyed: Vec<SurveyedMarker>,
}

/// A marker of a target that does not move, at a known position.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SurveyedMarker {
    /// The marker.
    pub marker: MarkerId,
    /// Its centre; its height is not used.
    pub at: Geodetic,
    /// One sigma north and east, m.
    pub sigma_m: f64,
}

/// An external position of the antenna: from a base station's solution, or a better receiver.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct OutsidePosition {
    /// Its time, host time.
    pub t: MonoTime,
    /// Its position, height above the ellipsoid.
    pub at: Geodetic,
    /// One sigma north, east, down, m.
    pub sigma_m: [f64; 3],
}

/// One measurement.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Measured<'a> {
    Epoch(&'a Stamped<GnssEpoch>),
    Reading(&'a Stamped<AttitudeSample>),
    Frame(&'a Stamped<FrameObservations>),
}

impl Measured<'_> {
    pub(crate) fn t_recv(&self) -> MonoTime {
        match self {
            Self::Epoch(m) => m.t_recv,
            Self::Reading(m) => m.t_recv,
            Self::Frame(m) => m.t_recv,
        }
    }
}

impl Recording {
    /// All measurements, in order of reception.
    pub(crate) fn in_order(&self) -> Vec<Measured<'_>> {
        let epochs = self.epochs.iter().map(Measured::Epoch);
        let readings = self.readings.iter().map(Measured::Reading);
        let mut all: Vec<Measured<'_>> =
            epochs.chain(readings).chain(self.frames.iter().map(Measured::Frame)).collect();
        all.sort_by_key(Measured::t_recv);
        all
    }
}
