//! Field types of several formats: ranges of angles, status letters.

use super::reading::CompassReading;
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::number;

/// A heading, degrees.
pub(super) fn heading(text: &str) -> Result<Option<f64>, Refusal> {
    number(text, 0.0, 360.0)
}

/// Pitch or roll, degrees: which of them has the full range depends on the device's convention.
pub(super) fn tilt(text: &str) -> Result<Option<f64>, Refusal> {
    number(text, -180.0, 180.0)
}

/// A field that does not decide about its sentence: where it is impossible, it is left out and counted by its name.
pub(super) fn optional<T>(
    counts: &mut DecodeCounts,
    name: &'static str,
    read: Result<Option<T>, Refusal>,
) -> Option<T> {
    read.unwrap_or_else(|_| {
        counts.leave_out(name);
        None
    })
}

/// Status letters of Honeywell and True North: N normal, M and O warnings; L, P and all others (C calibration, V
/// voltage) are alarms, with which the value must not be used.
fn alarms(letter: &str) -> bool {
    !matches!(letter, "N" | "M" | "O" | "")
}

/// Removes the values that alarms mark as invalid: each angle its own, and any of them the heading, which is computed
/// with both angles.
pub(super) fn honour_alarms(reading: &mut CompassReading, heading: &str, pitch: &str, roll: &str) {
    if alarms(pitch) {
        reading.pitch_deg = None;
    }
    if alarms(roll) {
        reading.roll_deg = None;
    }
    if [heading, pitch, roll].into_iter().any(alarms) {
        reading.heading_deg = None;
        reading.flagged = true;
    }
}
