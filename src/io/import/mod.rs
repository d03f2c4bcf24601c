//! Recordings people already have, made into the events of a capture.

mod avi;
mod folder;
mod serial_log;
mod video;
mod y4m;

pub use serial_log::read_serial_log;
pub use video::{VideoSource, open_video};

use std::path::{Path, PathBuf};

use windhover_base::msg::FramePayload;
use windhover_base::time::{MonoTime, UtcTime};

/// Why a recording could not be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The system refused.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line or header that is not what it should be.
    #[error("{}:{line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// A video that cannot be read here.
    #[error("{}: {reason}", path.display())]
    Video {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
}

impl ImportError {
    fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }

    fn line(path: &Path, line: usize, reason: impl Into<String>) -> Self {
        Self::Line { path: path.to_owned(), line, reason: reason.into() }
    }

    fn video(path: &Path, reason: impl Into<String>) -> Self {
        Self::Video { path: path.to_owned(), reason: reason.into() }
    }
}

/// Frames with their times, in order.
pub type Frames = Box<dyn Iterator<Item = Result<FramePayload, ImportError>>>;

/// A time as people write it: seconds since any epoch, or ISO 8601 (UTC, or with an offset).
pub fn parse_time(text: &str) -> Option<MonoTime> {
    if let Some(ns) = seconds_to_ns(text) {
        return Some(MonoTime::from_ns(ns));
    }
    let parsed = chrono::DateTime::parse_from_rfc3339(text)
        .map(|t| t.timestamp_nanos_opt())
        .or_else(|_| {
            let text = text.trim_end_matches('Z').replace(' ', "T");
            chrono::NaiveDateTime::parse_from_str(&text, "%Y-%m-%dT%H:%M:%S%.f")
                .map(|t| t.and_utc().timestamp_nanos_opt())
        })
        .ok()??;
    Some(MonoTime::from_ns(UtcTime::from_unix_ns(parsed).unix_ns()))
}

/// Decimal seconds to nanoseconds without passing through a float, which would lose a fraction of a
/// microsecond on today's epoch.
fn seconds_to_ns(text: &str) -> Option<i64> {
    let (negative, digits) = text.strip_prefix('-').map_or((false, text), |rest| (true, rest));
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let all_digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || !all_digits(whole) || !all_digits(fraction) {
        return None;
    }
    let nanos: String = fraction.chars().chain("000000000".chars()).take(9).collect();
    let ns = whole.parse::<i64>().ok()?.checked_mul(1_000_000_000)?.checked_add(nanos.parse().ok()?)?;
    Some(if negative { -ns } else { ns })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_in_every_form() {
        let want = MonoTime::from_ns(1_795_014_245_501_037_600);
        assert_eq!(parse_time("1795014245.5010376"), Some(want));
        assert_eq!(parse_time("2026-11-18T15:04:05.501037600Z"), Some(want));
        assert_eq!(parse_time("2026-11-18T16:04:05.5010376+01:00"), Some(want));
        assert_eq!(parse_time("2026-11-18T15:04:05.5010376"), Some(want));
        assert_eq!(parse_time("12"), Some(MonoTime::from_ns(12_000_000_000)));
        for wrong in ["", "-", "1.2.3", "$GPRMC", "yesterday", "1e9", "99999999999999999999"] {
            assert_eq!(parse_time(wrong), None, "{wrong}");
        }
    }
}
