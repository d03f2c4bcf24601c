//! What the pipeline says: estimates, what became of measurements, notices, health.

use super::{
    AttitudeSample, FeatureTrack, FusionResult, GnssEpoch, Health, MarkerDetection, Notice, Ownship, Stamped,
    TargetEstimate,
};
use crate::geo::Geodetic;
use crate::time::MonoTime;

/// One thing the pipeline says.
#[derive(Clone, Debug)]
pub enum Output {
    /// The origin of the NED frame was settled, at this host time.
    Datum(MonoTime, Geodetic),
    /// A GPS epoch, mapped to host time.
    Fix(Stamped<GnssEpoch>),
    /// A compass sample, mapped to host time.
    Attitude(Stamped<AttitudeSample>),
    /// What was seen in a frame.
    Detections {
        /// Number of the frame.
        frame: u32,
        /// Exposure of the frame.
        t_valid: MonoTime,
        /// Markers.
        markers: Vec<MarkerDetection>,
        /// Ground features.
        features: Vec<FeatureTrack>,
    },
    /// The helicopter's own state at a frame.
    Ownship(Ownship),
    /// A target's estimate at a frame, as known in real time.
    Estimate(TargetEstimate),
    /// A target's estimate at an earlier frame, from the fixed-lag smoother.
    Smoothed(TargetEstimate),
    /// A target's estimate by the paper's method.
    Paper(TargetEstimate),
    /// What became of a measurement.
    Fusion(FusionResult),
    /// Something an operator should know.
    Notice(Notice),
    /// How everything does, once a second.
    Health(Box<Health>),
}
