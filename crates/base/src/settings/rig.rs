//! The helicopter's instruments and its targets.

use serde::{Deserialize, Serialize};

use super::{
    AttitudeConfig, AutopilotConfig, CameraConfig, CompassConfig, GpsConfig, ImuConfig, TargetConfig,
};

/// The instruments of a helicopter and the targets that they see.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// The GPS receiver.
    #[serde(default, skip_serializing_if = "GpsConfig::is_absent")]
    pub gps: GpsConfig,
    /// The digital compass.
    #[serde(default, skip_serializing_if = "CompassConfig::is_absent")]
    pub compass: CompassConfig,
    /// The helicopter's autopilot, where one is connected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub autopilot: Option<AutopilotConfig>,
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

impl Rig {
    /// Whether the receiver's line also carries the heading. A server behind TCP sends the same data to every client.
    pub fn compass_is_receivers(&self) -> bool {
        shares_line(&self.gps, &self.compass)
    }
}

/// Whether receiver and compass share one line.
///
/// ```
/// use windhover_base::settings::{CompassConfig, GpsConfig, shares_line};
///
/// let (gps, mut compass) = (GpsConfig { device: "/dev/ttyS0".into(), ..GpsConfig::default() }, CompassConfig::default());
/// compass.device = "/dev/ttyS1".into();
/// assert!(!shares_line(&gps, &compass));
/// compass.device = "/dev/ttyS0".into();
/// assert!(shares_line(&gps, &compass));
/// ```
pub fn shares_line(gps: &GpsConfig, compass: &CompassConfig) -> bool {
    gps.is_there() && gps.device == compass.device && !gps.device.starts_with("tcp://")
}
