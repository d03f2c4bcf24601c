//! ArduPilot's DataFlash log, `.bin` (<https://ardupilot.org/copter/docs/logmessages.html>): attitude, IMU, fixes.

use std::collections::HashMap;

use nalgebra::{UnitQuaternion, Vector3};

use super::measured::{Fix, ImportedLog, Measured, MeasuredLog};
use windhover_base::geo::ned_from_body_321;
use windhover_base::time::{MonoTime, Span};

pub(super) const MAGIC: [u8; 2] = [0xa3, 0x95];
/// The message that defines others: its length with the head, and the places of its fields after the head.
const FMT: u8 = 128;
const FMT_LENGTH: usize = 89;
const HEAD: usize = 3;
/// GPS time minus UTC since 2017.
const LEAP_S: i64 = 18;
/// 1980-01-06, seconds since 1970.
const GPS_EPOCH_S: i64 = 315_964_800;

/// A kind of message.
struct Format {
    length: usize,
    name: String,
    /// Place, type letter, by name.
    fields: HashMap<String, (usize, u8)>,
}

/// Bytes of a field by its letter.
const fn size_of(letter: u8) -> Option<usize> {
    Some(match letter {
        b'b' | b'B' | b'M' => 1,
        b'h' | b'H' | b'c' | b'C' | b'g' => 2,
        b'i' | b'I' | b'f' | b'e' | b'E' | b'L' | b'n' => 4,
        b'd' | b'q' | b'Q' => 8,
        b'N' => 16,
        b'a' | b'Z' => 64,
        _ => return None,
    })
}

impl Format {
    /// Type and length, a name of 4 bytes, letters (16), labels (64).
    fn parse(body: &[u8]) -> Option<(u8, Self)> {
        let text = |from: usize, to: usize| {
            let bytes = body.get(from..to)?;
            Some(String::from_utf8_lossy(bytes.split(|byte| *byte == 0).next()?).into_owned())
        };
        let (kind, length) = (*body.first()?, usize::from(*body.get(1)?));
        let (name, letters, labels) = (text(2, 6)?, text(6, 22)?, text(22, 86)?);
        let mut fields = HashMap::new();
        let mut at = HEAD;
        for (letter, label) in letters.bytes().zip(labels.split(',')) {
            fields.insert(label.to_owned(), (at, letter));
            at += size_of(letter)?;
        }
        (length >= HEAD && at <= length).then_some((kind, Self { length, name, fields }))
    }
}

/// A message, including its head.
struct Row<'a> {
    format: &'a Format,
    data: &'a [u8],
}

impl Row<'_> {
    fn get(&self, name: &str) -> Option<f64> {
        let (at, letter) = *self.format.fields.get(name)?;
        let bytes = self.data.get(at..at + size_of(letter)?)?;
        let mut wide = [0; 8];
        wide.get_mut(..bytes.len())?.copy_from_slice(bytes);
        let raw = u64::from_le_bytes(wide);
        Some(match letter {
            b'b' => f64::from(raw as i8),
            b'h' => f64::from(raw as i16),
            b'c' => f64::from(raw as i16) * 1e-2,
            b'H' | b'B' | b'M' | b'I' | b'Q' => raw as f64,
            b'C' | b'E' => raw as f64 * 1e-2,
            b'i' => f64::from(raw as i32),
            b'e' => f64::from(raw as i32) * 1e-2,
            b'L' => f64::from(raw as i32) * 1e-7,
            b'q' => raw as i64 as f64,
            b'f' => f64::from(f32::from_bits(raw as u32)),
            b'd' => f64::from_bits(raw),
            _ => return None,
        })
    }

    fn first_of_its_kind(&self) -> bool {
        self.get("I").is_none_or(|instance| instance == 0.0)
    }

    /// Microseconds since the start.
    fn usec(&self) -> Option<i64> {
        let usec = self.get("TimeUS").or_else(|| Some(self.get("TimeMS")? * 1e3))?;
        (0.0..1e15).contains(&usec).then_some(usec as i64)
    }
}

/// Reads a log. Times are UTC where a fix has the date, else time since the start.
pub(super) fn read(bytes: &[u8], name: &str) -> ImportedLog {
    let mut log = MeasuredLog::default();
    let mut formats: HashMap<u8, Format> = HashMap::new();
    let mut receiver = Receiver::default();
    let (mut at, mut skipped) = (0, 0);
    while let Some(head) = bytes.get(at..at + HEAD) {
        let length = match head[2] {
            FMT => Some(FMT_LENGTH),
            kind => formats.get(&kind).map(|format| format.length),
        };
        let whole = length.filter(|_| head[..2] == MAGIC).and_then(|length| bytes.get(at..at + length));
        let Some(data) = whole else {
            at += 1;
            skipped += 1;
            continue;
        };
        at += data.len();
        if head[2] == FMT {
            formats.extend(Format::parse(&data[HEAD..]));
        } else if let Some(format) = formats.get(&head[2]) {
            take(&Row { format, data }, &mut receiver, &mut log);
        }
    }
    // A log ends wherever power failed.
    if skipped > 0 {
        log.warnings
            .push(format!("{name}: {skipped} bytes are not messages, or of undefined kinds: left out"));
    }
    log.is_utc = receiver.utc_less_boot.is_some();
    let ahead = Span::from_ns(receiver.utc_less_boot.unwrap_or(0).saturating_mul(1_000));
    log.measured.iter_mut().for_each(|(t, _)| *t += ahead);
    log.into_packets("ArduPilot DataFlash")
}

/// Data of fixes that are in separate messages.
#[derive(Default)]
struct Receiver {
    hpe_m: Option<f64>,
    vpe_m: Option<f64>,
    /// Microseconds, by the first fix with a date.
    utc_less_boot: Option<i64>,
}

fn take(row: &Row<'_>, receiver: &mut Receiver, log: &mut MeasuredLog) {
    let Some(usec) = row.usec().filter(|_| row.first_of_its_kind()) else { return };
    let t = MonoTime::from_ns(usec * 1_000);
    let vector = |names: [&str; 3]| {
        let [x, y, z] = names.map(|name| row.get(name));
        Some(Vector3::new(x?, y?, z?))
    };
    match row.format.name.as_str() {
        "ATT" => {
            let Some(angles) = vector(["Roll", "Pitch", "Yaw"]) else { return };
            let [roll, pitch, yaw] = [angles.x, angles.y, angles.z].map(f64::to_radians);
            if yaw.is_finite() && pitch.is_finite() && roll.is_finite() {
                let attitude = UnitQuaternion::from_rotation_matrix(&ned_from_body_321(yaw, pitch, roll));
                log.push(t, Measured::Attitude(attitude), "ATT");
            }
        }
        "IMU" => {
            let sensed = vector(["GyrX", "GyrY", "GyrZ"]).zip(vector(["AccX", "AccY", "AccZ"]));
            if let Some((rate, force)) = sensed {
                log.push(t, Measured::Inertial(rate, force), "IMU");
            }
        }
        "GPA" => (receiver.hpe_m, receiver.vpe_m) = (row.get("HAcc"), row.get("VAcc")),
        "GPS" => {
            let Some(fix) = fix(row, receiver) else { return };
            let (week, ms) = (row.get("GWk").unwrap_or(0.0), row.get("GMS").unwrap_or(0.0));
            // 2020 began in week 2086: earlier weeks are invalid.
            if fix.kind >= 2 && (2086.0..5_000.0).contains(&week) {
                let utc_s = GPS_EPOCH_S + week as i64 * 604_800 - LEAP_S;
                receiver.utc_less_boot.get_or_insert(utc_s * 1_000_000 + ms as i64 * 1_000 - usec);
            }
            log.push(t, Measured::Fix(fix), "GPS");
        }
        _ => {}
    }
}

fn fix(row: &Row<'_>, receiver: &Receiver) -> Option<Fix> {
    let kind = row.get("Status")? as u8;
    let fix = Fix::at(kind, row.get("Lat")?, row.get("Lng")?, row.get("Alt")?);
    Some(Fix {
        speed_mps: row.get("Spd"),
        course_deg: row.get("GCrs"),
        hpe_m: receiver.hpe_m,
        vpe_m: receiver.vpe_m,
        hdop: row.get("HDop"),
        sats: row.get("NSats").map(|sats| sats as u8),
        ..fix
    })
}
