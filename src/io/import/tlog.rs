//! A ground station's telemetry log, `.tlog`: before each MAVLink frame its time of reception, microseconds since 1970
//! as eight bytes, big-endian. The frames are kept unchanged.

use super::measured::ImportedLog;
use windhover_base::time::MonoTime;

const STAMP: usize = 8;
/// Valid times: 2000-01-01 to 2100-01-01, microseconds since 1970.
const TIMES_USEC: std::ops::Range<u64> = 946_684_800_000_000..4_102_444_800_000_000;

/// Length of the frame at the start of these bytes; `None` where there is none.
fn frame_length(bytes: &[u8]) -> Option<usize> {
    let payload = usize::from(*bytes.get(1)?);
    Some(match bytes[0] {
        0xfe => payload + 8,
        0xfd => payload + 12 + if bytes.get(2)? & 1 == 1 { 13 } else { 0 },
        _ => return None,
    })
}

/// The time and the frame at the start of these bytes.
fn record(bytes: &[u8]) -> Option<(MonoTime, &[u8])> {
    let usec = u64::from_be_bytes(bytes.get(..STAMP)?.try_into().ok()?);
    if !TIMES_USEC.contains(&usec) {
        return None;
    }
    let rest = &bytes[STAMP..];
    let t = MonoTime::from_ns(i64::try_from(usec.checked_mul(1_000)?).ok()?);
    Some((t, rest.get(..frame_length(rest)?)?))
}

/// Whether a file begins like such a log.
pub(super) fn is_one(bytes: &[u8]) -> bool {
    record(bytes).is_some()
}

/// Reads a log; bytes that are not a record are skipped.
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
        log.warnings.push(format!("{name}: {skipped} bytes are not records and are left out"));
    }
    log.packets.sort_by_key(|(t, _)| *t);
    log
}
