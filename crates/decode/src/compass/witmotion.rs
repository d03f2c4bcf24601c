//! WitMotion's modules (WT901, HWT901B, JY901 and others) in their factory protocol.
//!
//! A record is 55, a type, eight bytes, and the sum of these ten. Types: 51 specific force (16 g over the range of a
//! signed number), 52 rates (2000 degrees a second), 53 angles about x, y, z (180 degrees), which complete the reading.
//! The device's axes are x right, y forward (the direction of the arrow y on the housing), z up; angles are
//! right-handed, so that the one about x is pitch, the one about y roll, and the heading is minus the one about z.
//! Source: WitMotion's protocol of the standard modules.

use nalgebra::{Rotation3, Vector3};

use super::reading::CompassReading;
use super::records::{Gathered, RecordForm, figure};
use crate::counts::{DecodeCounts, Refusal};
use windhover_base::msg::InertialSample;

/// Its records.
pub(super) const FORM: RecordForm = RecordForm { mark: &[0x55], length: 11, summed_from: 0, read };

const FORCE: u8 = 0x51;
const RATE: u8 = 0x52;
const ANGLES: u8 = 0x53;
/// Steps of a signed number in its range.
const STEPS: f64 = 32_768.0;
/// Ranges of force, m/s², rate, rad/s, and angle, rad.
const FORCE_RANGE: f64 = 16.0 * 9.806_65;
const RATE_RANGE: f64 = 2_000.0 * std::f64::consts::PI / 180.0;
const ANGLE_RANGE: f64 = std::f64::consts::PI;

fn read(
    record: &[u8],
    gathered: &mut Gathered,
    _: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    let figures = |range: f64| Vector3::new(2, 4, 6).map(|at| figure(record, at) * range / STEPS);
    match record.get(1) {
        Some(&FORCE) => gathered.force_mps2 = Some(in_body(&figures(FORCE_RANGE)).into()),
        Some(&RATE) => gathered.rate_rps = Some(in_body(&figures(RATE_RANGE)).into()),
        Some(&ANGLES) => {
            let mut reading = attitude(&figures(ANGLE_RANGE));
            let (rate, force) = (gathered.rate_rps.take(), gathered.force_mps2.take());
            reading.inertial = (rate.is_some() || force.is_some()).then(|| InertialSample {
                rate_rps: rate.map(Vector3::from),
                force_mps2: force.map(Vector3::from),
            });
            return Ok(Some(reading));
        }
        _ => {}
    }
    Ok(None)
}

/// Forward, right, down from right, forward, up.
fn in_body(device: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(device.y, device.x, -device.z)
}

/// Attitude from angles about x, then y, then z of axes that are east, north, up at zero.
fn attitude(angles: &Vector3<f64>) -> CompassReading {
    let up_from_device = Rotation3::from_euler_angles(angles.x, angles.y, angles.z);
    let (ahead, right) = (up_from_device * Vector3::y(), up_from_device * Vector3::x());
    let pitch = ahead.z.clamp(-1.0, 1.0).asin();
    let up = up_from_device * Vector3::z();
    CompassReading {
        heading_deg: Some(ahead.x.atan2(ahead.y).to_degrees().rem_euclid(360.0)),
        pitch_deg: Some(pitch.to_degrees()),
        roll_deg: Some((-right.z).atan2(up.z).to_degrees()),
        ..CompassReading::default()
    }
}
