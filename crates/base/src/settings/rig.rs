//! What the helicopter carries and what it watches.

use serde::{Deserialize, Serialize};

use super::{AttitudeConfig, CameraConfig, CompassConfig, GpsConfig, ImuConfig, TargetConfig};

/// The instruments of a helicopter and the targets that they see.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// The GPS receiver.
    pub gps: GpsConfig,
    /// The digital compass.
    pub compass: CompassConfig,
    /// Gyros and accelerometers, where there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imu: Option<ImuConfig>,
    /// A second source of attitude, where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attitude: Option<AttitudeConfig>,
    /// The camera, its lens and its mount.
    pub camera: CameraConfig,
    /// The vehicles to watch.
    pub target: Vec<TargetConfig>,
}
