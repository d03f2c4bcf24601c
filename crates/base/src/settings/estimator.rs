//! Detector and estimator sections.

use serde::{Deserialize, Serialize};

/// `[detector]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DetectorConfig {
    /// Smallest edge of a tag's black square that is detected over the whole frame, pixels.
    pub min_px: f64,
    /// Most wrong bits that are corrected in a tag's code.
    pub max_hamming: u8,
    /// Ground features tracked from frame to frame; 0 for none.
    pub ground_features: usize,
}

impl Default for DetectorConfig {
    fn default() -> Self {
        Self { min_px: 16.0, max_hamming: 2, ground_features: 8 }
    }
}

/// `[estimator]`: the joint filter. The intensities are initial values: with `learn` the filter fits them to the
/// flight.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EstimatorConfig {
    /// Rate at which the helicopter's own state is output in addition to the frames, times a second.
    pub ownship_hz: f64,
    /// Age up to which late measurements are inserted at their time, ms.
    pub history_ms: f64,
    /// Lag of the smoothed output, ms.
    pub smoother_lag_ms: f64,
    /// A target not seen for this long is lost, seconds.
    pub lost_after_s: f64,
    /// Whether intensities of motion and the noise of pixels, tilt and heading are fitted in flight.
    pub learn: bool,
    /// Time over which they are fitted, seconds.
    pub learn_s: f64,
    /// Probability that a good measurement passes the gate at full weight.
    pub gate_probability: f64,
    /// Consecutive measurements outside the gate after which a state is reset.
    pub rejections_to_restart: u32,
    /// Most ground features in use at once.
    pub features: usize,
    /// Factor on the detector's pixel sigma of ground features.
    pub feature_sigma_factor: f64,
    /// One-sigma added to every marker pixel for errors that the detector cannot know (lens, exposure time), px.
    pub marker_noise_px: f64,
    /// Random walk of the aircraft's roll and pitch rates, rad/s per √s.
    pub tilt_rate_walk: f64,
    /// Random walk of the aircraft's yaw rate, rad/s per √s.
    pub yaw_rate_walk: f64,
    /// One-sigma of the force of gusts, for each axis, divided by the mass, m/s².
    pub side_force_mps2: f64,
    /// One-sigma of the thrust in excess of the weight, divided by the mass, m/s².
    pub thrust_mps2: f64,
    /// Correlation time of the gusts, seconds.
    pub force_tau_s: f64,
    /// Random walk of the ground vehicle's speed, m/s per √s.
    pub target_speed_walk: f64,
    /// Random walk of the ground vehicle's yaw rate, rad/s per √s.
    pub target_yaw_rate_walk: f64,
    /// Random walk of the ground vehicle's position across its heading (side slip), m per √s.
    pub target_slip_walk: f64,
}

impl Default for EstimatorConfig {
    fn default() -> Self {
        Self {
            ownship_hz: 10.0,
            history_ms: 1000.0,
            smoother_lag_ms: 500.0,
            lost_after_s: 30.0,
            learn: true,
            learn_s: 1.5,
            gate_probability: 0.999,
            rejections_to_restart: 5,
            features: 8,
            feature_sigma_factor: 2.0,
            marker_noise_px: 0.1,
            tilt_rate_walk: 1.0,
            yaw_rate_walk: 0.3,
            side_force_mps2: 0.5,
            thrust_mps2: 1.0,
            force_tau_s: 3.0,
            target_speed_walk: 0.5,
            target_yaw_rate_walk: 0.25,
            target_slip_walk: 0.01,
        }
    }
}
