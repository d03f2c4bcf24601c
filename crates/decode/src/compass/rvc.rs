//! BNO08x in its UART-RVC mode: 100 readings a second without any command to the device.
//!
//! A record is AA AA, an index, yaw, pitch and roll (hundredths of a degree), three specific forces, three reserved
//! bytes, and the sum of all after the marks. Yaw is relative to the direction in which the device was switched on: it
//! is reported, but not used as a heading. Source: data sheet of the BNO08X.

use super::reading::CompassReading;
use super::records::{Gathered, RecordForm, figure};
use crate::counts::{DecodeCounts, Refusal};

/// Its records.
pub(super) const FORM: RecordForm = RecordForm { mark: &[0xAA, 0xAA], length: 19, summed_from: 2, read };

fn read(
    record: &[u8],
    _: &mut Gathered,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    let angle = |at: usize| Some(figure(record, at) * 0.01).filter(|deg| deg.abs() <= 180.0);
    let (yaw, pitch, roll) = (angle(3), angle(5), angle(7));
    let angles = [("RVC yaw", yaw), ("RVC pitch", pitch), ("RVC roll", roll)];
    if angles.iter().all(|(_, angle)| angle.is_none()) {
        return Err(Refusal::OutOfRange);
    }
    angles.iter().filter(|(_, angle)| angle.is_none()).for_each(|(name, _)| counts.leave_out(*name));
    Ok(Some(CompassReading {
        heading_deg: yaw.map(|yaw| yaw.rem_euclid(360.0)),
        heading_is_free: true,
        pitch_deg: pitch,
        roll_deg: roll,
        ..CompassReading::default()
    }))
}
