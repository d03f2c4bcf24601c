//! Outputs of the pipeline: estimates, dispositions, notices, health.

use super::{EstimatorOutput, FeatureTrack, Health, MarkerDetection, Notice, SensorReading, TargetEstimate};
use crate::geo::Geodetic;
use crate::time::MonoTime;

/// One output of the pipeline.
#[expect(clippy::large_enum_variant, reason = "a box would be an allocation for each estimate")]
#[derive(Clone, Debug)]
pub enum Output {
    /// The origin of the NED frame is settled, at this host time.
    Datum(MonoTime, Geodetic),
    /// A sensor's reading, mapped to host time.
    Reading(SensorReading),
    /// The detections of a frame.
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
    /// An output of the joint filter.
    Estimator(EstimatorOutput),
    /// A target's estimate by the paper's method.
    Paper(TargetEstimate),
    /// A notice for the operator.
    Notice(Notice),
    /// Health, once a second.
    Health(Box<Health>),
}

/// An output, and the time of its cause.
#[derive(Clone, Debug)]
pub struct TimedOutput {
    /// Host time of the event, or of the tick before it, that caused the output.
    pub t_cause: MonoTime,
    /// The output.
    pub output: Output,
}
