//! What the pipeline says: estimates, what became of measurements, notices, health.

use super::{EstimatorOutput, FeatureTrack, Health, MarkerDetection, Notice, SensorReading, TargetEstimate};
use crate::geo::Geodetic;
use crate::time::MonoTime;

/// One thing the pipeline says.
#[expect(clippy::large_enum_variant, reason = "a box would be an allocation for each estimate")]
#[derive(Clone, Debug)]
pub enum Output {
    /// The origin of the NED frame was settled, at this host time.
    Datum(MonoTime, Geodetic),
    /// A sensor's reading, mapped to host time.
    Reading(SensorReading),
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
    /// The joint filter says something.
    Estimator(EstimatorOutput),
    /// A target's estimate by the paper's method.
    Paper(TargetEstimate),
    /// Something an operator should know.
    Notice(Notice),
    /// How everything does, once a second.
    Health(Box<Health>),
}

/// An output, and when what caused it happened.
#[derive(Clone, Debug)]
pub struct TimedOutput {
    /// Host time of the event, or of the tick before it, from which the output followed.
    pub t_cause: MonoTime,
    /// The output.
    pub output: Output,
}
