//! VectorNav's ASCII messages: yaw, pitch, roll (`$VNYPR`, `$VNYMR`, `$VNYBA`, `$VNYIA`), a quaternion (`$VNQTN`,
//! `$VNQMR`; with `$VNYMR` rates and forces), or an inertial solution (`$VNINS`, whose yaw is true). Angles are 3-2-1 from the tangent plane to
//! the device, yaw from −180 to 180 degrees. Source: VectorNav's manuals.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::fields::{optional, tilt};
use super::nmea;
use super::reading::CompassReading;
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::Sentence;
use windhover_base::msg::InertialSample;

/// Largest force, m/s², and rate, rad/s, that any of their sensors measures.
const FORCE_MAX: f64 = 1_000.0;
const RATE_MAX: f64 = 100.0;
/// Largest difference of a quaternion's length from one.
const UNIT_OFF: f64 = 0.01;
/// Modes of the inertial solution (bits 0 and 1 of its status) in which it is aligning or tracking.
const INS_MODES: std::ops::RangeInclusive<u16> = 1..=2;

/// The reading of a sentence; `None` where it has no attitude.
pub(super) fn read(
    sentence: &Sentence<'_>,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    match sentence.address() {
        "VNYPR" | "VNYBA" | "VNYIA" => angles(sentence, 1, counts).map(Some),
        "VNYMR" => Ok(Some(CompassReading {
            inertial: inertial_at(sentence, 7, counts),
            ..angles(sentence, 1, counts)?
        })),
        "VNQTN" => quaternion(sentence).map(Some),
        "VNQMR" => {
            Ok(Some(CompassReading { inertial: inertial_at(sentence, 8, counts), ..quaternion(sentence)? }))
        }
        "VNINS" => inertial(sentence, counts).map(Some),
        address if address.starts_with("VN") => Ok(None),
        _ => nmea::read(sentence, counts),
    }
}

/// Specific force, m/s², and rates, rad/s, in the device's axes forward, right, down. `None` where they are absent.
fn inertial_at(sentence: &Sentence<'_>, first: usize, counts: &mut DecodeCounts) -> Option<InertialSample> {
    let three = |at: usize, most: f64| {
        let axis = |index| sentence.number(at + index, -most, most);
        Ok::<_, Refusal>(match (axis(0)?, axis(1)?, axis(2)?) {
            (Some(x), Some(y), Some(z)) => Some(Vector3::new(x, y, z)),
            _ => None,
        })
    };
    let force_mps2 = optional(counts, "forces", three(first, FORCE_MAX));
    let rate_rps = optional(counts, "rates", three(first + 3, RATE_MAX));
    (force_mps2.is_some() || rate_rps.is_some()).then_some(InertialSample { rate_rps, force_mps2 })
}

fn angles(
    sentence: &Sentence<'_>,
    first: usize,
    counts: &mut DecodeCounts,
) -> Result<CompassReading, Refusal> {
    if sentence.fields() < first + 2 {
        return Err(Refusal::Malformed);
    }
    let yaw = sentence.number(first, -360.0, 360.0);
    let (pitch, roll) = (tilt(sentence.field(first + 1)), tilt(sentence.field(first + 2)));
    if let (Err(why), Err(_), Err(_)) = (yaw, pitch, roll) {
        return Err(why);
    }
    let heading_deg = optional(counts, "VN yaw", yaw).map(|yaw| yaw.rem_euclid(360.0));
    Ok(CompassReading {
        heading_deg,
        pitch_deg: optional(counts, "VN pitch", pitch),
        roll_deg: optional(counts, "VN roll", roll),
        flagged: heading_deg.is_none(),
        ..CompassReading::default()
    })
}

/// Vector part, then scalar.
fn quaternion(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    let part = |index| sentence.number(index, -1.1, 1.1)?.ok_or(Refusal::Malformed);
    let quaternion = Quaternion::new(part(4)?, part(1)?, part(2)?, part(3)?);
    if (quaternion.norm() - 1.0).abs() > UNIT_OFF {
        return Err(Refusal::OutOfRange);
    }
    let (roll, pitch, yaw) = UnitQuaternion::new_normalize(quaternion).euler_angles();
    Ok(CompassReading {
        heading_deg: Some(yaw.to_degrees().rem_euclid(360.0)),
        pitch_deg: Some(pitch.to_degrees()),
        roll_deg: Some(roll.to_degrees()),
        ..CompassReading::default()
    })
}

/// Time, week, status (hexadecimal), yaw, pitch, roll, position, velocity, uncertainties.
fn inertial(sentence: &Sentence<'_>, counts: &mut DecodeCounts) -> Result<CompassReading, Refusal> {
    let status = u16::from_str_radix(sentence.field(3), 16).map_err(|_| Refusal::Malformed)?;
    let mut reading = angles(sentence, 4, counts)?;
    reading.heading_is_true = true;
    if !INS_MODES.contains(&(status & 3)) {
        reading.heading_deg = None;
        reading.flagged = true;
    }
    Ok(reading)
}
