//! Logs of autopilots and cameras, distinguished by their first bytes.

use std::io::Read as _;
use std::path::Path;

use super::measured::ImportedLog;
use super::{ImportError, dataflash, srt, tlog, ulog};
use crate::io::regular;
use windhover_base::time::MonoTime;

/// Longest log that is read: hours of the densest ones.
const MOST: u64 = 1 << 32;

/// Reads PX4's ULog, ArduPilot's DataFlash log, a telemetry log, or DJI's subtitles. `video_start` is the start of the
/// video, where given: times of subtitles count from there.
///
/// # Errors
/// The file cannot be read, or is none of these, or has nothing usable.
pub fn read_log(path: &Path, video_start: Option<MonoTime>) -> Result<ImportedLog, ImportError> {
    let refuse = |reason: String| ImportError::Log { path: path.to_owned(), reason };
    let file = regular::open(path).map_err(|e| ImportError::io(path, e))?;
    let mut bytes = Vec::new();
    file.take(MOST + 1).read_to_end(&mut bytes).map_err(|e| ImportError::io(path, e))?;
    if bytes.len() as u64 > MOST {
        return Err(refuse(format!("is longer than {} GiB", MOST >> 30)));
    }
    let name = path.display().to_string();
    let log = match &bytes {
        bytes if bytes.starts_with(&ulog::MAGIC) => ulog::read(bytes, &name),
        bytes if bytes.starts_with(&dataflash::MAGIC) => dataflash::read(bytes, &name),
        bytes if tlog::is_one(bytes) => tlog::read(bytes, &name),
        bytes => match std::str::from_utf8(bytes) {
            Ok(text) if srt::is_one(text) => srt::read(text, &name, video_start),
            _ => {
                let kinds = "PX4's ULog, ArduPilot's .bin, a .tlog, DJI's .SRT";
                return Err(refuse(format!("is none of the supported logs: {kinds}")));
            }
        },
    };
    if log.packets.is_empty() {
        let why = log
            .warnings
            .first()
            .cloned()
            .unwrap_or_else(|| "it has no fix, attitude or inertial sample".into());
        return Err(refuse(format!("has nothing usable: {why}")));
    }
    Ok(log)
}
