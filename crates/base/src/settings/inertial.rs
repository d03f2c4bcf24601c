//! Sections for sensors in addition to the compass: rates and forces, a second source of attitude.

use nalgebra::Rotation3;
use serde::{Deserialize, Serialize};

use super::TiltKind;
use crate::geo::TiltConvention;

/// `[imu]`: gyros and accelerometers.
#[derive(Clone, Copy, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImuConfig {
    /// From a sample's time of validity to its time in the recording, ms.
    pub latency_ms: f64,
    /// Mounting yaw, degrees: `body_from_imu = Rz(yaw) Ry(pitch) Rx(roll)`, body axes forward-right-down.
    pub yaw_deg: f64,
    /// Mounting pitch, degrees.
    pub pitch_deg: f64,
    /// Mounting roll, degrees; 180 for a sensor whose axes point forward, left and up.
    pub roll_deg: f64,
    /// One-sigma noise of a rate, averaged over a tenth of a second, degrees a second.
    pub rate_noise_dps: f64,
    /// One-sigma of a rate's constant error, degrees a second.
    pub rate_bias_dps: f64,
    /// One-sigma noise of a specific force, averaged over a tenth of a second, m/s²; mostly vibration.
    pub force_noise_mps2: f64,
    /// One-sigma of a specific force's constant error, m/s².
    pub force_bias_mps2: f64,
}

impl Default for ImuConfig {
    fn default() -> Self {
        Self {
            latency_ms: 0.0,
            yaw_deg: 0.0,
            pitch_deg: 0.0,
            roll_deg: 0.0,
            rate_noise_dps: 2.0,
            rate_bias_dps: 1.0,
            force_noise_mps2: 1.0,
            force_bias_mps2: 1.0,
        }
    }
}

impl ImuConfig {
    /// `body_from_imu` of the mounting angles.
    pub fn body_from_imu(&self) -> Rotation3<f64> {
        let radians = f64::to_radians;
        Rotation3::from_euler_angles(radians(self.roll_deg), radians(self.pitch_deg), radians(self.yaw_deg))
    }
}

/// `[attitude]`: a second source of attitude.
#[derive(Clone, Copy, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AttitudeConfig {
    /// From a sample's time of validity to its time in the recording, ms.
    pub latency_ms: f64,
    /// Its definition of pitch and roll.
    pub angles: TiltConvention,
    /// What its tilt sensor measures.
    pub tilt: TiltKind,
    /// One-sigma of the heading's constant error, degrees.
    pub heading_bias_sigma_deg: f64,
    /// One-sigma of the heading noise, degrees.
    pub heading_noise_deg: f64,
    /// One-sigma of the tilt noise of the sensor at rest, degrees.
    pub tilt_noise_deg: f64,
}

impl Default for AttitudeConfig {
    fn default() -> Self {
        Self {
            latency_ms: 0.0,
            angles: TiltConvention::default(),
            tilt: TiltKind::default(),
            heading_bias_sigma_deg: 1.5,
            heading_noise_deg: 0.5,
            tilt_noise_deg: 0.3,
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn a_sensor_with_axes_forward_left_up_is_rolled_over() {
        let imu = ImuConfig { roll_deg: 180.0, ..ImuConfig::default() };
        let at_rest = imu.body_from_imu() * Vector3::new(0.1, 0.2, 9.8);
        assert!((at_rest - Vector3::new(0.1, -0.2, -9.8)).norm() < 1e-9, "{at_rest}");
        let turned = ImuConfig { yaw_deg: 90.0, ..ImuConfig::default() }.body_from_imu() * Vector3::x();
        assert!((turned - Vector3::y()).norm() < 1e-9, "its x axis points right: {turned}");
    }
}
