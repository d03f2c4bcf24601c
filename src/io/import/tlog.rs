//! A ground station's telemetry log, `.tlog`: before each MAVLink frame the time it was heard, microseconds since 1970 in
//! eight bytes, the first one first. The frames are kept as they are.

use super::measured::ImportedLog;
use windhover_base::time::MonoTime;

const STAMP: usize = 8;
/// 2000-01-01 and 2100-01-01, microseconds since 1970: other times are none.
const TIMES_USEC: std::ops::Range<u64> = 946_684_800_000_000..4_102_444_800_000_000;

/// Length of the frame that these bytes begin with; `None` where none does.
fn frame_length(bytes: &[u8]) -> Option<usize> {
    let payload = usize::from(*bytes.get(1)?);
    Some(match bytes[0] {
        0xfe => payload + 8,
        0xfd => payload + 12 + if bytes.get(2)? & 1 == 1 { 13 } else { 0 },
        _ => return None,
    })
}

/// The time and the frame at the begin of these bytes.
fn record(bytes: &[u8]) -> Option<(MonoTime, &[u8])> {
    let usec = u64::from_be_bytes(bytes.get(..STAMP)?.try_into().ok()?);
    if !TIMES_USEC.contains(&usec) {
        return None;
    }
    let rest = &bytes[STAMP..];
    let t = MonoTime::from_ns(i64::try_from(usec.checked_mul(1_000)?).ok()?);
    Some((t, rest.get(..frame_length(rest)?)?))
}

/// Whether a file begins as such a log does.
pub(super) fn is_one(bytes: &[u8]) -> bool {
    record(bytes).is_some()
}

/// Reads a log; what is no record is skipped.
pub(super) fn read(bytes: &[u8], name: &str) -> ImportedLog {
    let mut log = ImportedLog::default();
    let (mut at, mut skipped) = (0, 0);
    while at < bytes.len() {
        match record(&bytes[at..]) {
            Some((t, frame)) => {
                log.packets.push((t, frame.to_vec()));
                at += STAMP + frame.len();
            }
            None => {
                at += 1;
                skipped += 1;
            }
        }
    }
    if skipped > 0 {
        log.warnings.push(format!("{name}: {skipped} bytes are no records and left out"));
    }
    log.packets.sort_by_key(|(t, _)| *t);
    log
}
