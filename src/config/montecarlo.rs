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

/// `[montecarlo]`
#[derive(Clone, PartialEq, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MonteCarloConfig {
    /// Shape of every error source.
    pub distribution: Distribution,
}
