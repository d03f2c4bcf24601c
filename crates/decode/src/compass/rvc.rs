//! BNO08x in its UART-RVC mode: 100 readings a second without any command to the device.
//!
//! A record is AA AA, an index, yaw, pitch and roll (hundredths of a degree), three specific forces, three reserved
//! bytes, and the sum of all after the marks. Yaw is relative to the direction in which the device was switched on: it
//! is reported, but not used as a heading. Source: data sheet of the BNO08X.

use super::reading::CompassReading;
use super::records::{Gathered, RecordForm, figure};
use crate::counts::Refusal;

/// Its records.
pub(super) const FORM: RecordForm = RecordForm { mark: &[0xAA, 0xAA], length: 19, summed_from: 2, read };

fn read(record: &[u8], _: &mut Gathered) -> Result<Option<CompassReading>, Refusal> {
    let angle = |at: usize| figure(record, at) * 0.01;
    let (yaw, pitch, roll) = (angle(3), angle(5), angle(7));
    if [yaw, pitch, roll].iter().any(|deg| deg.abs() > 180.0) {
        return Err(Refusal::OutOfRange);
    }
    Ok(Some(CompassReading {
        heading_deg: Some(yaw.rem_euclid(360.0)),
        heading_is_free: true,
        pitch_deg: Some(pitch),
        roll_deg: Some(roll),
        ..CompassReading::default()
    }))
}
