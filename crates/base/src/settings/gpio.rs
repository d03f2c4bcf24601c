//! A GPIO line, as configuration names it.

use serde::{Deserialize, Serialize};

/// A GPIO line.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GpioLine {
    /// Its chip, for example `/dev/gpiochip0`.
    pub chip: String,
    /// Its number on the chip, as `gpioinfo` shows it.
    pub line: u32,
    /// Whether a low level is the active one.
    #[serde(default)]
    pub active_low: bool,
}

impl std::fmt::Display for GpioLine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} line {}", self.chip, self.line)
    }
}
