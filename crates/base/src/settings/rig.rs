//! What the helicopter carries and what it watches.

use serde::{Deserialize, Serialize};

use super::{CameraConfig, CompassConfig, GpsConfig, TargetConfig};

/// The instruments of a helicopter and the targets that they see.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// The GPS receiver.
    pub gps: GpsConfig,
    /// The digital compass.
    pub compass: CompassConfig,
    /// The camera, its lens and its mount.
    pub camera: CameraConfig,
    /// The vehicles to watch.
    pub target: Vec<TargetConfig>,
}
