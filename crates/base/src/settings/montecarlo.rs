//! `[montecarlo]`: the paper's error analysis.

use serde::{Deserialize, Serialize};

/// Shape of every error source.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Distribution {
    /// Gaussian.
    #[default]
    Normal,
    /// Uniform of the same sigma.
    Uniform,
}

impl Distribution {
    /// Its name in configuration and output.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::Uniform => "uniform",
        }
    }
}

/// `[montecarlo]`: pose of the camera, the pixel, and one sigma for each error source.
///
/// The default is the paper's condition (35): the camera 10 m above level ground, level, with the pixel of the point
/// under it (u = v = 0), a GPS of 3 m (95 % of horizontal errors) and 0.2° of tilt.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MonteCarloConfig {
    /// Shape of every error source.
    pub distribution: Distribution,
    /// Camera position, north-east-down, metres; the ground is at down = 0.
    pub position_ned_m: [f64; 3],
    /// Heading of the aircraft, degrees.
    pub heading_deg: f64,
    /// Its pitch, degrees, nose up positive.
    pub pitch_deg: f64,
    /// Its roll, degrees, right side down positive.
    pub roll_deg: f64,
    /// The pixel; where absent the one on the optical axis (u = v = 0).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pixel: Option<[f64; 2]>,
    /// Height of the point over the ground, metres.
    pub above_ground_m: f64,
    /// One-sigma of GPS position, north and east each, metres.
    pub gps_horizontal_sigma_m: f64,
    /// One-sigma of GPS height, metres.
    pub gps_vertical_sigma_m: f64,
    /// One-sigma of heading, degrees.
    pub heading_sigma_deg: f64,
    /// One-sigma of pitch, degrees.
    pub pitch_sigma_deg: f64,
    /// One-sigma of roll, degrees.
    pub roll_sigma_deg: f64,
    /// One-sigma of the marker in the image, each axis, pixels.
    pub pixel_sigma_px: f64,
    /// One-sigma of ground elevation, metres.
    pub ground_sigma_m: f64,
    /// One-sigma of each mounting angle of the camera, degrees.
    pub mount_sigma_deg: f64,
    /// One-sigma of the focal lengths, pixels.
    pub focal_sigma_px: f64,
    /// One-sigma of the principal point, each axis, pixels.
    pub principal_sigma_px: f64,
}

impl Default for MonteCarloConfig {
    fn default() -> Self {
        Self {
            distribution: Distribution::Normal,
            position_ned_m: [0.0, 0.0, -10.0],
            heading_deg: 0.0,
            pitch_deg: 0.0,
            roll_deg: 0.0,
            pixel: None,
            above_ground_m: 0.0,
            // 3 m is the radius that contains 95 % of the errors: 2.4477 sigma of each axis.
            gps_horizontal_sigma_m: 1.2256,
            gps_vertical_sigma_m: 2.0,
            heading_sigma_deg: 0.5,
            pitch_sigma_deg: 0.2,
            roll_sigma_deg: 0.2,
            pixel_sigma_px: 0.5,
            ground_sigma_m: 0.0,
            mount_sigma_deg: 0.0,
            focal_sigma_px: 0.0,
            principal_sigma_px: 0.0,
        }
    }
}
