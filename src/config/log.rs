//! `[log]`: the operator's log.

use serde::{Deserialize, Serialize};

/// `[log]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogConfig {
    /// Lowest severity that is shown: error, warn, info, debug or trace. Reloaded on SIGHUP.
    pub level: LogLevel,
    /// Form of lines on standard error: `auto` uses the journal's own protocol where standard error is the journal, and
    /// text elsewhere.
    pub format: LogFormat,
    /// File to which the log is also written, for systems without a journal; none by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
    /// Size at which the file is rotated, megabytes.
    pub file_mb: f64,
    /// Rotated files that are kept.
    pub files_kept: u32,
}

impl Default for LogConfig {
    fn default() -> Self {
        Self { level: LogLevel::Info, format: LogFormat::Auto, file: None, file_mb: 10.0, files_kept: 4 }
    }
}

/// Severities, highest first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogLevel {
    /// Something does not work and needs a person.
    Error,
    /// Something does not work and is being handled.
    Warn,
    /// Events that an operator wants to see in normal flight.
    #[default]
    Info,
    /// Details for finding causes.
    Debug,
    /// Everything.
    Trace,
}

impl LogLevel {
    /// Its name in configuration and log.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Error => "error",
            Self::Warn => "warn",
            Self::Info => "info",
            Self::Debug => "debug",
            Self::Trace => "trace",
        }
    }
}

/// Form of lines on standard error.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// The journal's protocol where standard error is the journal, else text.
    #[default]
    Auto,
    /// logfmt: `key=value` words.
    Text,
    /// One JSON object on each line.
    Json,
    /// The journal's protocol.
    Journal,
}
