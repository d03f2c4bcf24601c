//! Bags of ROS 1 and ROS 2: images as frames; fixes, inertial samples and magnetic fields as messages of an autopilot.

mod compass;
mod fields;
mod ros1;
mod sqlite;

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::measured::{Fix, ImportedLog, Measured, MeasuredLog};
use super::{Frames, ImportError};
use crate::io::mcap_read::McapReader;
use crate::io::regular;
use crate::text::counted;
use fields::{Fields, Wire};
use ros1::Ros1Reader;
use sqlite::SqliteReader;
use windhover_base::msg::FramePayload;
use windhover_base::time::{MonoTime, UtcTime};

/// A message of a bag.
struct BagMessage {
    topic: Arc<str>,
    kind: Arc<str>,
    wire: Wire,
    /// Its arrival.
    t: MonoTime,
    data: Vec<u8>,
}

/// The supported kinds of messages.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
enum Kind {
    Image,
    Fix,
    Imu,
    MagneticField,
}

impl Kind {
    /// The kind by its type name in either ROS.
    fn of(name: &str) -> Option<Self> {
        Some(match name.replace("/msg/", "/").as_str() {
            "sensor_msgs/Image" | "sensor_msgs/CompressedImage" => Self::Image,
            "sensor_msgs/NavSatFix" => Self::Fix,
            "sensor_msgs/Imu" => Self::Imu,
            "sensor_msgs/MagneticField" => Self::MagneticField,
            _ => return None,
        })
    }

    const fn words(self) -> &'static str {
        match self {
            Self::Image => "images",
            Self::Fix => "fixes",
            Self::Imu => "inertial samples",
            Self::MagneticField => "magnetic fields",
        }
    }
}

/// Messages of a bag, whatever its storage.
enum BagReader {
    Mcap(Box<McapReader>),
    Ros1(Box<Ros1Reader>),
    Sqlite { reader: Box<SqliteReader>, rest: VecDeque<PathBuf>, warnings: Vec<String> },
}

impl BagReader {
    fn open(path: &Path) -> Result<Self, ImportError> {
        let refuse = |reason: &str| ImportError::Bag { path: path.to_owned(), reason: reason.into() };
        if path.is_dir() {
            let parts = |extension: &str| files_of(path, extension).map_err(|e| ImportError::io(path, e));
            if !parts("mcap")?.is_empty() {
                return Self::mcap(path);
            }
            let mut files: VecDeque<PathBuf> = parts("db3")?.into();
            let first = files.pop_front().ok_or_else(|| {
                refuse("has no .mcap and no .db3; unpack a compressed bag with `ros2 bag convert` or zstd")
            })?;
            return Self::sqlite(&first, files);
        }
        let mut file = regular::open(path).map_err(|e| ImportError::io(path, e))?;
        let mut head = Vec::new();
        let read = (&mut file).take(16).read_to_end(&mut head);
        read.map_err(|e| ImportError::io(path, e))?;
        match head.as_slice() {
            head if head.starts_with(mcap::MAGIC) => Self::mcap(path),
            head if head.starts_with(sqlite::MAGIC) => Self::sqlite(path, VecDeque::new()),
            head if head.starts_with(ros1::MAGIC) => {
                let file = regular::open(path).map_err(|e| ImportError::io(path, e))?;
                Ok(Self::Ros1(Box::new(Ros1Reader::new(file).map_err(|e| ImportError::io(path, e))?)))
            }
            head if head.starts_with(b"#ROSBAG") => {
                Err(refuse("is a bag older than version 2.0: convert it with `rosbag fix`"))
            }
            _ => Err(refuse("is not a bag: neither ROS 1's (#ROSBAG V2.0), nor MCAP, nor SQLite")),
        }
    }

    fn mcap(path: &Path) -> Result<Self, ImportError> {
        let failed = |error: crate::io::mcap_read::ReadError| ImportError::Bag {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        Ok(Self::Mcap(Box::new(McapReader::open(path).map_err(failed)?)))
    }

    fn sqlite(path: &Path, rest: VecDeque<PathBuf>) -> Result<Self, ImportError> {
        let file: File = regular::open(path).map_err(|e| ImportError::io(path, e))?;
        let reader = SqliteReader::open(file).ok_or_else(|| ImportError::Bag {
            path: path.to_owned(),
            reason: "has no tables `topics` and `messages`: it is not a bag, or it is damaged".into(),
        })?;
        let mut log = path.as_os_str().to_owned();
        log.push("-wal");
        let mut warnings = Vec::new();
        if Path::new(&log).metadata().is_ok_and(|log| log.len() > 0) {
            warnings
                .push(format!("{} was not closed: the content of its -wal file is left out", path.display()));
        }
        Ok(Self::Sqlite { reader: Box::new(reader), rest, warnings })
    }

    fn warnings(self) -> Vec<String> {
        match self {
            Self::Mcap(mut reader) => reader.take_warnings(),
            Self::Ros1(reader) => reader.warnings,
            Self::Sqlite { reader, mut warnings, .. } => {
                warnings.extend(reader.warnings);
                warnings
            }
        }
    }
}

impl Iterator for BagReader {
    type Item = BagMessage;

    fn next(&mut self) -> Option<BagMessage> {
        match self {
            Self::Ros1(reader) => reader.next(),
            Self::Mcap(reader) => reader.find_map(|raw| {
                let wire = match raw.channel.message_encoding.as_str() {
                    "cdr" => Wire::Cdr,
                    "ros1" => Wire::Ros1,
                    _ => return None,
                };
                let (topic, kind) =
                    (raw.channel.topic.as_str().into(), raw.channel.schema.name.as_str().into());
                Some(BagMessage { topic, kind, wire, t: raw.log_time, data: raw.data })
            }),
            Self::Sqlite { reader, rest, warnings } => loop {
                if let Some(message) = reader.next() {
                    return Some(message);
                }
                let opened = Self::sqlite(&rest.pop_front()?, std::mem::take(rest));
                match opened {
                    Ok(Self::Sqlite { reader: next, rest: others, warnings: more }) => {
                        warnings.append(&mut reader.warnings);
                        warnings.extend(more);
                        (*reader, *rest) = (next, others);
                    }
                    Ok(_) => return None,
                    Err(error) => {
                        warnings.push(format!("{error}; the rest of the bag is left out"));
                        return None;
                    }
                }
            },
        }
    }
}

fn files_of(folder: &Path, extension: &str) -> std::io::Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder)?.collect::<Result<Vec<_>, _>>()?;
    let mut files: Vec<PathBuf> = entries.into_iter().map(|entry| entry.path()).collect();
    files.retain(|file| file.extension().is_some_and(|e| e == extension));
    files.sort();
    Ok(files)
}

/// The content of a bag: measurements, and the topic of its images if it has any.
pub struct ImportedBag {
    /// Measurements.
    pub log: ImportedLog,
    images: Option<Arc<str>>,
    path: PathBuf,
}

/// One topic's messages, before it is known whether they are used.
#[derive(Default)]
struct TopicMessages {
    messages: usize,
    measured: Vec<(MonoTime, Measured)>,
    fields: Vec<(MonoTime, Vector3<f64>)>,
}

/// Reads everything but the images of a bag: a file, or the directory of one. Of each kind the named topics are used; where
/// none of a kind is named, the one with the shortest name.
///
/// # Errors
/// It is not a bag, or cannot be read.
pub fn read_bag(path: &Path, topics: &[String]) -> Result<ImportedBag, ImportError> {
    let mut bag = BagReader::open(path)?;
    let mut by_topic: BTreeMap<(Kind, Arc<str>), TopicMessages> = BTreeMap::new();
    let mut unread = 0;
    for message in bag.by_ref() {
        let Some(kind) = Kind::of(&message.kind).filter(|_| TIMES.contains(&message.t)) else { continue };
        let topic_messages = by_topic.entry((kind, Arc::clone(&message.topic))).or_default();
        topic_messages.messages += 1;
        if kind != Kind::Image && take(kind, &message, topic_messages).is_none() {
            unread += 1;
        }
    }
    let mut log = MeasuredLog { warnings: bag.warnings(), ..MeasuredLog::default() };
    if unread > 0 {
        log.warnings.push(format!("{} do not agree with their type: left out", counted(unread, "message")));
    }
    let chosen = choose(&by_topic, topics, &mut log.warnings);
    for name in topics.iter().filter(|name| !by_topic.keys().any(|(_, topic)| **topic == ***name)) {
        log.warnings.push(format!("the bag has no topic {name} of a supported kind"));
    }
    let mut fields = Vec::new();
    for ((_, topic), topic_messages) in by_topic.iter_mut().filter(|(key, _)| chosen.contains(key)) {
        topic_messages.measured.drain(..).for_each(|(t, what)| log.push(t, what, topic));
        if !topic_messages.fields.is_empty() {
            fields.push((topic.as_ref(), std::mem::take(&mut topic_messages.fields)));
        }
    }
    let images = chosen.iter().find(|(kind, _)| *kind == Kind::Image).map(|(_, topic)| Arc::clone(topic));
    if images.is_none() && log.measured.is_empty() {
        let why = log.warnings.first().map_or("it has no images, fixes or inertial samples", String::as_str);
        let reason = format!("has nothing usable: {why}");
        return Err(ImportError::Bag { path: path.to_owned(), reason });
    }
    log.measured.sort_by_key(|(t, _)| *t);
    fields.into_iter().for_each(|(topic, fields)| compass::headings(&mut log, topic, &fields));
    log.is_utc =
        log.measured.first().is_some_and(|(t, _)| UtcTime::from_unix_ns(t.ns()).unix_ns() > YEAR_2000_NS);
    Ok(ImportedBag { log: log.into_packets("ROS bag"), images, path: path.to_owned() })
}

/// Valid times: from zero to the end of the century.
const TIMES: std::ops::Range<MonoTime> = MonoTime::from_ns(0)..MonoTime::from_ns(4_100_000_000_000_000_000);

/// Times before this are not dates.
const YEAR_2000_NS: i64 = 946_684_800_000_000_000;

fn choose(
    by_topic: &BTreeMap<(Kind, Arc<str>), TopicMessages>,
    topics: &[String],
    warnings: &mut Vec<String>,
) -> Vec<(Kind, Arc<str>)> {
    let mut chosen = Vec::new();
    for kind in [Kind::Image, Kind::Fix, Kind::Imu, Kind::MagneticField] {
        let of_kind: Vec<_> = by_topic.iter().filter(|((k, _), _)| *k == kind).collect();
        let named: Vec<_> =
            of_kind.iter().filter(|((_, t), _)| topics.iter().any(|name| **name == **t)).collect();
        let shortest = of_kind.iter().min_by_key(|((_, topic), _)| (topic.len(), Arc::clone(topic)));
        let used: Vec<_> = if named.is_empty() { shortest.into_iter().collect() } else { named };
        // A capture has one camera.
        let most = if kind == Kind::Image { 1 } else { used.len() };
        chosen.extend(used.into_iter().take(most).map(|(key, _)| (*key).clone()));
        for ((_, topic), topic_messages) in of_kind.iter().filter(|(key, _)| !chosen.contains(key)) {
            let count = topic_messages.messages;
            warnings.push(format!(
                "{count} {} on {topic} left out: name it with --topic to use it",
                kind.words()
            ));
        }
    }
    chosen
}

/// Half a turn about the axis between north and east: north-east-down from east-north-up.
fn ned_from_enu() -> UnitQuaternion<f64> {
    let half = std::f64::consts::FRAC_1_SQRT_2;
    UnitQuaternion::from_quaternion(Quaternion::new(0.0, half, half, 0.0))
}

/// Forward-right-down of forward-left-up, and back.
fn frd(flu: Vector3<f64>) -> Vector3<f64> {
    Vector3::new(flu.x, -flu.y, -flu.z)
}

fn frd_from_flu() -> UnitQuaternion<f64> {
    UnitQuaternion::from_quaternion(Quaternion::new(0.0, 1.0, 0.0, 0.0))
}

fn take(kind: Kind, message: &BagMessage, topic_messages: &mut TopicMessages) -> Option<()> {
    let mut fields = Fields::new(message.wire, &message.data)?;
    match kind {
        Kind::Image => {}
        Kind::Fix => {
            let fix = fields::nav_sat_fix(&mut fields, message.t)?;
            // A fix without finite values is not used.
            if fix.lat_deg.is_finite() && fix.lon_deg.is_finite() {
                topic_messages.measured.push((fix.t, Measured::Fix(of_ros(&fix))));
            }
        }
        Kind::Imu => {
            let imu = fields::imu(&mut fields, message.t)?;
            if let Some(q) = imu.orientation {
                let q = ned_from_enu() * UnitQuaternion::from_quaternion(q) * frd_from_flu();
                topic_messages.measured.push((imu.t, Measured::Attitude(q)));
            }
            if let Some((rate, force)) = imu.rate_rps.zip(imu.force_mps2) {
                topic_messages.measured.push((imu.t, Measured::Inertial(frd(rate), frd(force))));
            }
        }
        Kind::MagneticField => {
            let (t, field) = fields::magnetic_field(&mut fields, message.t)?;
            topic_messages.fields.push((t, frd(field)));
        }
    }
    Some(())
}

/// `NavSatFix` has only the height above the ellipsoid: it is used for both heights, as with a geoid of zero.
fn of_ros(fix: &fields::NavSatFix) -> Fix {
    let height = Some(fix.altitude_m).filter(|height| height.is_finite());
    let kind = match (fix.status, height) {
        (i8::MIN..=-1, _) => 1,
        (_, None) => 2,
        (2, _) => 5,
        (1, _) => 4,
        _ => 3,
    };
    Fix {
        ellipsoid_m: height,
        hpe_m: fix.sigmas_m.map(|(horizontal, _)| horizontal),
        vpe_m: fix.sigmas_m.map(|(_, vertical)| vertical),
        ..Fix::at(kind, fix.lat_deg, fix.lon_deg, height.unwrap_or(0.0))
    }
}

impl ImportedBag {
    /// Its images in the order of the file; `None` where it has none.
    ///
    /// # Errors
    /// The bag cannot be opened a second time.
    pub fn frames(&self) -> Result<Option<Frames>, ImportError> {
        let Some(wanted) = self.images.clone() else { return Ok(None) };
        let bag = BagReader::open(&self.path)?;
        let mut index = 0;
        let frames = bag
            .filter(move |message| message.topic == wanted && TIMES.contains(&message.t))
            .filter_map(move |message| {
                let frame = frame(&message, index)?;
                index += 1;
                Some(Ok(frame))
            });
        Ok(Some(Box::new(frames)))
    }
}

fn frame(message: &BagMessage, index: u32) -> Option<FramePayload> {
    let mut fields = Fields::new(message.wire, &message.data)?;
    match message.kind.ends_with("CompressedImage") {
        true => fields::compressed(&mut fields, message.t, index),
        false => fields::image(&mut fields, message.t, index),
    }
}
