//! Detector and estimator sections.

use serde::{Deserialize, Serialize};

/// `[detector]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DetectorConfig {
    /// Smallest edge of a tag's black square looked for over the whole frame, pixels.
    pub min_px: f64,
    /// Most wrong bits accepted in a tag's code.
    pub max_hamming: u8,
    /// Ground features tracked from frame to frame; 0 for none.
    pub ground_features: usize,
}

impl Default for DetectorConfig {
    fn default() -> Self {
        Self { min_px: 16.0, max_hamming: 2, ground_features: 8 }
    }
}

/// `[estimator]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EstimatorConfig {
    /// How far back late measurements are still fused in their place, ms.
    pub history_ms: f64,
    /// Lag of the smoothed output, ms.
    pub smoother_lag_ms: f64,
}

impl Default for EstimatorConfig {
    fn default() -> Self {
        Self { history_ms: 1000.0, smoother_lag_ms: 500.0 }
    }
}
