//! The settings that the pipeline uses.

use crate::config::Config;
use windhover_base::settings::{Datum, DetectorConfig, EstimatorConfig, GroundConfig, Rig};

/// The settings that the pipeline uses: instruments and targets, where the flight is, detector, filter.
#[derive(Clone, PartialEq, Debug)]
pub struct PipelineSettings {
    /// Instruments and targets.
    pub rig: Rig,
    /// The ground that the vehicle drives on.
    pub ground: GroundConfig,
    /// Origin of the NED frame, if it is configured.
    pub datum: Option<Datum>,
    /// Marker detection.
    pub detector: DetectorConfig,
    /// The joint filter.
    pub filter: EstimatorConfig,
}

impl From<&Config> for PipelineSettings {
    fn from(config: &Config) -> Self {
        Self {
            rig: config.rig(),
            ground: config.ground.clone(),
            datum: config.datum,
            detector: config.detector.clone(),
            filter: config.filter(),
        }
    }
}
