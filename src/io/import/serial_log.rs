//! Serial logs with a time stamp on each line.

use std::path::Path;

use super::ImportError;
use super::stamp::timed;
use windhover_base::time::MonoTime;

/// The lines of the log with their times. Lines without a time are reported by number and left out; a log in which no
/// line has one is an error.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct SerialLog {
    /// Time of the line and its bytes, with its line end; in order of time.
    pub lines: Vec<(MonoTime, Vec<u8>)>,
    /// Numbers of lines without a time, from 1.
    pub untimed: Vec<usize>,
}

/// Reads a log of which each line starts with a time and a blank.
pub fn read_serial_log(path: &Path) -> Result<SerialLog, ImportError> {
    let bytes = std::fs::read(path).map_err(|e| ImportError::io(path, e))?;
    let mut log = SerialLog::default();
    for (index, line) in bytes.split(|b| *b == b'\n').enumerate() {
        let line = line.strip_suffix(b"\r").unwrap_or(line);
        if line.is_empty() {
            continue;
        }
        match timed(line) {
            Some((t, rest)) => {
                let mut sent = rest.to_vec();
                sent.extend_from_slice(b"\r\n");
                log.lines.push((t, sent));
            }
            None => log.untimed.push(index + 1),
        }
    }
    if log.lines.is_empty() {
        let line = log.untimed.first().copied().unwrap_or(1);
        let reason = "no line starts with a time (seconds, or a date and time) and a blank";
        return Err(ImportError::line(path, line, reason));
    }
    log.lines.sort_by_key(|(t, _)| *t);
    Ok(log)
}
