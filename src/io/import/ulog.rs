//! PX4's ULog (<https://docs.px4.io/main/en/dev_log/ulog_file_format.html>): attitude, sensors, fixes.
//!
//! The file contains the formats of its messages; a field is found by its name, in any order and among any others.

use std::collections::HashMap;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::measured::{Fix, ImportedLog, Measured, MeasuredLog};
use windhover_base::time::{MonoTime, Span};

pub(super) const MAGIC: [u8; 7] = [b'U', b'L', b'o', b'g', 0x01, 0x12, 0x35];
/// Magic, version, time of the start.
const HEADER: usize = 16;
/// Deepest nesting of formats.
const DEPTH: usize = 6;
/// 2100-01-01, microseconds since 1970: later times are invalid.
const LATEST_USEC: f64 = 4.1e15;
/// Most accepted formats and subscriptions.
const MOST: usize = 4096;

/// A field of a message: its place and type.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Field {
    offset: usize,
    kind: Scalar,
}

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Scalar {
    Unsigned(usize),
    Signed(usize),
    Float,
    Double,
}

impl Scalar {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "uint8_t" | "bool" | "char" => Self::Unsigned(1),
            "uint16_t" => Self::Unsigned(2),
            "uint32_t" => Self::Unsigned(4),
            "uint64_t" => Self::Unsigned(8),
            "int8_t" => Self::Signed(1),
            "int16_t" => Self::Signed(2),
            "int32_t" => Self::Signed(4),
            "int64_t" => Self::Signed(8),
            "float" => Self::Float,
            "double" => Self::Double,
            _ => return None,
        })
    }

    const fn size(self) -> usize {
        match self {
            Self::Unsigned(size) | Self::Signed(size) => size,
            Self::Float => 4,
            Self::Double => 8,
        }
    }
}

/// A topic as the file subscribes to it.
struct Topic {
    name: String,
    /// First of several of its kind.
    is_first: bool,
    fields: HashMap<String, Field>,
}

/// One message: its fields by name.
struct Row<'a> {
    fields: &'a HashMap<String, Field>,
    data: &'a [u8],
}

impl Row<'_> {
    fn get(&self, name: &str) -> Option<f64> {
        let Field { offset, kind } = *self.fields.get(name)?;
        let bytes = self.data.get(offset..offset.checked_add(kind.size())?)?;
        let mut wide = [0; 8];
        wide[..bytes.len()].copy_from_slice(bytes);
        let raw = u64::from_le_bytes(wide);
        Some(match kind {
            Scalar::Unsigned(_) => raw as f64,
            Scalar::Signed(size) => {
                let unused = 64 - 8 * size as u32;
                ((raw << unused) as i64 >> unused) as f64
            }
            Scalar::Float => f64::from(f32::from_bits(raw as u32)),
            Scalar::Double => f64::from_bits(raw),
        })
    }

    fn usec(&self, name: &str) -> Option<i64> {
        self.get(name).filter(|usec| (1.0..LATEST_USEC).contains(usec)).map(|usec| usec as i64)
    }

    fn array<const N: usize>(&self, name: &str) -> Option<[f64; N]> {
        let mut values = [0.0; N];
        for (k, value) in values.iter_mut().enumerate() {
            *value = self.get(&format!("{name}[{k}]"))?;
        }
        Some(values)
    }
}

/// Reads a log. Times are UTC where a receiver has it, else time since the start.
pub(super) fn read(bytes: &[u8], name: &str) -> ImportedLog {
    let mut log = Log::default();
    log.records(bytes, name);
    let mut measured = log.measured;
    let ahead_usec = log.utc_less_boot;
    measured.is_utc = ahead_usec.is_some();
    // Two topics have the receiver's fixes: the raw one is used where the selected one is absent.
    let fixes = if log.chosen.is_empty() { log.raw } else { log.chosen };
    let of = if fixes.is_empty() { "" } else { log.fixes_of };
    fixes.into_iter().for_each(|(t, fix)| measured.push(t, Measured::Fix(fix), of));
    let ahead = Span::from_ns(ahead_usec.unwrap_or(0).saturating_mul(1_000));
    measured.measured.iter_mut().for_each(|(t, _)| *t += ahead);
    measured.into_packets("PX4 ULog")
}

#[derive(Default)]
struct Log {
    formats: HashMap<String, Vec<(String, usize, String)>>,
    topics: HashMap<u16, Topic>,
    measured: MeasuredLog,
    chosen: Vec<(MonoTime, Fix)>,
    raw: Vec<(MonoTime, Fix)>,
    fixes_of: &'static str,
    /// UTC less time since start, microseconds, by the first fix with UTC.
    utc_less_boot: Option<i64>,
}

impl Log {
    fn records(&mut self, bytes: &[u8], name: &str) {
        let mut at = HEADER;
        let mut appended: Vec<usize> = Vec::new();
        while let Some(head) = bytes.get(at..at + 3) {
            let size = usize::from(u16::from_le_bytes([head[0], head[1]]));
            // Data appended after a crash begins at its own place; the record before it may be cut.
            if let Some(&next) = appended.first().filter(|next| at < **next && at + 3 + size > **next) {
                appended.remove(0);
                at = next;
                continue;
            }
            let Some(body) = bytes.get(at + 3..at + 3 + size) else { break };
            match head[2] {
                b'B' if at == HEADER && body.len() >= 40 && body[8] & 1 == 1 => {
                    appended = body[16..40]
                        .chunks_exact(8)
                        .filter_map(|offset| offset_of(offset, bytes.len()))
                        .collect();
                }
                b'F' => self.format(body),
                b'A' => self.subscribe(body),
                b'D' => self.data(body),
                _ => {}
            }
            at += 3 + size;
        }
        if at < bytes.len() {
            self.measured
                .warnings
                .push(format!("{name} is cut off at byte {at}: read to its last whole record"));
        }
    }

    /// `name:type field;type[N] field;…`
    fn format(&mut self, body: &[u8]) {
        let text = String::from_utf8_lossy(body);
        let Some((name, list)) = text.split_once(':').filter(|_| self.formats.len() < MOST) else { return };
        let field = |declared: &str| {
            let (kind, name) = declared.trim().split_once(' ')?;
            let (kind, count) = match kind.split_once('[') {
                Some((kind, count)) => (kind, count.strip_suffix(']')?.parse().ok()?),
                None => (kind, 0),
            };
            Some((kind.to_owned(), count, name.to_owned()))
        };
        self.formats.insert(name.to_owned(), list.split(';').filter_map(field).collect());
    }

    fn subscribe(&mut self, body: &[u8]) {
        let Some((&[multi, low, high], name)) = body.split_first_chunk::<3>() else { return };
        let name = String::from_utf8_lossy(name).into_owned();
        const WANTED: [&str; 4] =
            ["vehicle_attitude", "sensor_combined", "vehicle_gps_position", "sensor_gps"];
        if !WANTED.contains(&name.as_str()) || self.topics.len() >= MOST {
            return;
        }
        let mut fields = HashMap::new();
        if self.layout(&name, "", 0, &mut fields, DEPTH).is_some() {
            self.topics.insert(u16::from_le_bytes([low, high]), Topic { name, is_first: multi == 0, fields });
        }
    }

    /// Places of the fields of a format; returns where it ends. `None` for what is not defined, or longer than a
    /// message.
    fn layout(
        &self,
        format: &str,
        prefix: &str,
        begin: usize,
        fields: &mut HashMap<String, Field>,
        depth: usize,
    ) -> Option<usize> {
        let mut offset = begin;
        for (kind, count, name) in self.formats.get(format)? {
            let of_one = |k: usize| match count {
                0 => format!("{prefix}{name}"),
                _ => format!("{prefix}{name}[{k}]"),
            };
            for k in 0..(*count).max(1) {
                offset = match Scalar::named(kind) {
                    Some(scalar) => {
                        fields.insert(of_one(k), Field { offset, kind: scalar });
                        offset + scalar.size()
                    }
                    None => {
                        let depth = depth.checked_sub(1)?;
                        self.layout(kind, &format!("{}.", of_one(k)), offset, fields, depth)?
                    }
                };
                if offset > usize::from(u16::MAX) {
                    return None;
                }
            }
        }
        // A format without fields, many times in itself, would take time without any result.
        (offset > begin).then_some(offset)
    }

    fn data(&mut self, body: &[u8]) {
        let Some((id, data)) = body.split_first_chunk::<2>() else { return };
        let Some(topic) = self.topics.get(&u16::from_le_bytes(*id)).filter(|topic| topic.is_first) else {
            return;
        };
        let row = Row { fields: &topic.fields, data };
        let Some(logged) = row.usec("timestamp") else { return };
        let true_at = row.usec("timestamp_sample").unwrap_or(logged);
        let t = MonoTime::from_ns(true_at * 1_000);
        match topic.name.as_str() {
            "vehicle_attitude" => {
                let Some([w, x, y, z]) = row.array("q") else { return };
                if let Some(q) = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 0.5) {
                    self.measured.push(t, Measured::Attitude(q), "vehicle_attitude");
                }
            }
            "sensor_combined" => {
                let sensed = row.array("gyro_rad").zip(row.array("accelerometer_m_s2"));
                if let Some((rate, force)) = sensed {
                    let what = Measured::Inertial(Vector3::from(rate), Vector3::from(force));
                    self.measured.push(t, what, "sensor_combined");
                }
            }
            chosen_or_raw => {
                let is_chosen = chosen_or_raw == "vehicle_gps_position";
                let Some(fix) = fix(&row) else { return };
                if let Some(utc) = row.usec("time_utc_usec").filter(|_| fix.kind >= 2) {
                    self.utc_less_boot.get_or_insert(utc - logged);
                }
                if is_chosen || self.fixes_of.is_empty() {
                    self.fixes_of = if is_chosen { "vehicle_gps_position" } else { "sensor_gps" };
                }
                if is_chosen { self.chosen.push((t, fix)) } else { self.raw.push((t, fix)) }
            }
        }
    }
}

fn offset_of(bytes: &[u8], length: usize) -> Option<usize> {
    let offset = usize::try_from(u64::from_le_bytes(bytes.try_into().ok()?)).ok()?;
    (offset > HEADER && offset < length).then_some(offset)
}

/// A fix in the fields of both generations of PX4: degrees and metres from 1.14 on, 1e-7 degrees and millimetres in
/// older ones.
fn fix(row: &Row<'_>) -> Option<Fix> {
    let either = |new: &str, old: &str, scale: f64| row.get(new).or_else(|| Some(row.get(old)? * scale));
    let kind = row.get("fix_type")? as u8;
    let fix = Fix::at(
        kind,
        either("latitude_deg", "lat", 1e-7)?,
        either("longitude_deg", "lon", 1e-7)?,
        either("altitude_msl_m", "alt", 1e-3)?,
    );
    let sound = |name: &str| row.get(name).filter(|figure| figure.is_finite());
    let (north, east) = (sound("vel_n_m_s"), sound("vel_e_m_s"));
    let valid = row.get("vel_ned_valid").is_none_or(|valid| valid != 0.0);
    let velocity = north.zip(east).filter(|_| valid);
    Some(Fix {
        ellipsoid_m: either("altitude_ellipsoid_m", "alt_ellipsoid", 1e-3),
        speed_mps: velocity.map(|(n, e)| n.hypot(e)),
        course_deg: velocity.map(|(n, e)| e.atan2(n).to_degrees()),
        hpe_m: sound("eph"),
        vpe_m: sound("epv"),
        hdop: sound("hdop"),
        sats: row.get("satellites_used").map(|sats| sats as u8),
        ..fix
    })
}
