//! Import: existing recordings, merged into one capture in order of time.

use std::iter::Peekable;
use std::path::{Path, PathBuf};

use crate::io::capture::CaptureWriter;
use crate::io::import::{
    Frames, ImportError, ImportedLog, Samples, VideoSource, open_video, read_attitude, read_bag,
    read_inertial, read_log, read_serial_log,
};
use crate::io::mcap_write::WriteError;
use crate::text::counted;
use windhover_base::msg::{Event, EventBody, FramePayload, Source};
use windhover_base::time::{MonoTime, Span};

/// What to import.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Sources {
    /// Log of the GPS line.
    pub gps: Option<PathBuf>,
    /// Log of the compass line.
    pub compass: Option<PathBuf>,
    /// Table of rates and forces.
    pub imu: Option<PathBuf>,
    /// Table of a second source of attitude.
    pub attitude: Option<PathBuf>,
    /// Log of an autopilot, or subtitles of a camera.
    pub log: Option<PathBuf>,
    /// Bag of ROS 1 or ROS 2.
    pub bag: Option<PathBuf>,
    /// Topics of the bag to use where there are several of a kind.
    pub topics: Vec<String>,
    /// Video file, or folder of images.
    pub video: Option<PathBuf>,
    /// When the video's first frame was taken; where absent, the time of the first line of the logs.
    pub video_start: Option<MonoTime>,
}

/// Why nothing was imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportFailure {
    /// A source could not be read.
    #[error(transparent)]
    Read(#[from] ImportError),
    /// The capture could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// No source was given.
    #[error(
        "nothing to import: give at least one of --gps, --compass, --imu, --attitude, --log, --bag, --video"
    )]
    Nothing,
    /// Two sources carry the same measurements.
    #[error(
        "--log and --bag both contain the helicopter's measurements: give one of them, or a bag of images alone"
    )]
    Twice,
}

/// What was imported.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Imported {
    /// Lines of the GPS log.
    pub gps_lines: usize,
    /// Lines of the compass log.
    pub compass_lines: usize,
    /// Samples of rates and forces.
    pub imu_samples: usize,
    /// Samples of the second source of attitude.
    pub attitude_samples: usize,
    /// Packets of the autopilot.
    pub packets: usize,
    /// Fixes, attitudes and inertial samples from which packets were made.
    pub measured: [usize; 3],
    /// Frames.
    pub frames: u32,
    /// How the video was read.
    pub video: Option<VideoSource>,
    /// Time from the first to the last event.
    pub length: Span,
    /// What was left out, as text.
    pub warnings: Vec<String>,
}

/// Merges the sources into a capture; `config_toml` is attached where it is not empty.
pub fn import(sources: &Sources, config_toml: &str, out: &Path) -> Result<Imported, ImportFailure> {
    let mut imported = Imported::default();
    let mut serial = Vec::new();
    if let Some(path) = &sources.gps {
        let lines = serial_lines(path, &mut imported.warnings)?;
        imported.gps_lines = lines.len();
        serial.extend(
            lines.into_iter().map(|(t, bytes)| (t, EventBody::Bytes { source: Source::Gps, data: bytes })),
        );
    }
    if let Some(path) = &sources.compass {
        let lines = serial_lines(path, &mut imported.warnings)?;
        imported.compass_lines = lines.len();
        serial.extend(
            lines
                .into_iter()
                .map(|(t, bytes)| (t, EventBody::Bytes { source: Source::Compass, data: bytes })),
        );
    }
    if let Some(path) = &sources.imu {
        let samples = rows(path, read_inertial(path)?, &mut imported.warnings);
        imported.imu_samples = samples.len();
        let event = |(t, sample)| (t, EventBody::Inertial { source: Source::Imu, sample });
        serial.extend(samples.into_iter().map(event));
    }
    if let Some(path) = &sources.attitude {
        let samples = rows(path, read_attitude(path)?, &mut imported.warnings);
        imported.attitude_samples = samples.len();
        let event = |(t, sample)| (t, EventBody::Attitude { source: Source::Attitude, sample });
        serial.extend(samples.into_iter().map(event));
    }
    let bag = sources.bag.as_deref().map(|path| read_bag(path, &sources.topics)).transpose()?;
    let log = sources.log.as_deref().map(|path| read_log(path, sources.video_start)).transpose()?;
    let mut start = sources.video_start;
    let mut made_of = String::new();
    let mut bag_frames = None;
    if let Some(log) = log {
        start = start.or(log.video_start);
        made_of = packets(log, &mut serial, &mut imported);
    }
    if let Some(bag) = bag {
        bag_frames = bag.frames()?;
        if imported.packets > 0 && !bag.log.packets.is_empty() {
            return Err(ImportFailure::Twice);
        }
        let of_bag = packets(bag.log, &mut serial, &mut imported);
        made_of = if made_of.is_empty() { of_bag } else { made_of };
    }
    serial.sort_by_key(|(t, _)| *t);
    let start = start.or_else(|| serial.first().map(|(t, _)| *t)).unwrap_or_default();
    let frames: Frames = match (&sources.video, bag_frames) {
        (Some(path), _) => {
            let (how, frames) = open_video(path, start)?;
            imported.video = Some(how);
            frames
        }
        (None, Some(frames)) => frames,
        (None, None) if serial.is_empty() => return Err(ImportFailure::Nothing),
        (None, None) => Box::new(std::iter::empty()),
    };
    let merged = Merged { serial, frames: frames.peekable(), made_of };
    write(merged, config_toml, out, &mut imported)?;
    Ok(imported)
}

/// Takes over a log's packets; returns their origin.
fn packets(log: ImportedLog, serial: &mut Vec<(MonoTime, EventBody)>, imported: &mut Imported) -> String {
    imported.packets += log.packets.len();
    imported.measured = std::array::from_fn(|k| imported.measured[k] + log.counts[k]);
    imported.warnings.extend(log.warnings);
    let event = |(t, data)| (t, EventBody::Bytes { source: Source::Autopilot, data });
    serial.extend(log.packets.into_iter().map(event));
    log.made_of
}

/// The content of a capture.
struct Merged {
    /// In order of time.
    serial: Vec<(MonoTime, EventBody)>,
    frames: Peekable<Frames>,
    /// The origin of the autopilot's packets; empty where they are its own.
    made_of: String,
}

fn serial_lines(path: &Path, warnings: &mut Vec<String>) -> Result<Vec<(MonoTime, Vec<u8>)>, ImportError> {
    let log = read_serial_log(path)?;
    if let Some(first) = log.untimed.first() {
        let count = log.untimed.len();
        warnings.push(format!(
            "{}: {} without a time left out, the first at line {first}",
            path.display(),
            counted(count, "line")
        ));
    }
    Ok(log.lines)
}

/// The samples of a table; a warning reports rows that were left out.
fn rows<T>(path: &Path, table: Samples<T>, warnings: &mut Vec<String>) -> Vec<(MonoTime, T)> {
    if let Some(first) = table.unread.first() {
        let count = table.unread.len();
        warnings.push(format!(
            "{}: {} that cannot be read left out, the first at line {first}",
            path.display(),
            counted(count, "row")
        ));
    }
    table.samples
}

fn write(
    merged: Merged,
    config_toml: &str,
    out: &Path,
    imported: &mut Imported,
) -> Result<(), ImportFailure> {
    let Merged { serial, mut frames, made_of } = merged;
    let mut serial = serial.into_iter().peekable();
    let mut writer: Option<CaptureWriter> = None;
    let (mut first, mut seq) = (None, 0);
    loop {
        let frame_is_next = match (serial.peek(), frames.peek()) {
            (None, None) => break,
            (Some(_), None) => false,
            (None, Some(_)) => true,
            (Some((t, _)), Some(frame)) => frame.as_ref().is_ok_and(|f: &FramePayload| f.t_exposure < *t),
        };
        let (t_recv, body) = if frame_is_next {
            match frames.next().transpose()? {
                Some(frame) => {
                    imported.frames += 1;
                    (frame.t_exposure, EventBody::Frame(frame))
                }
                None => continue,
            }
        } else {
            match serial.next() {
                Some(line) => line,
                None => continue,
            }
        };
        let began = *first.get_or_insert(t_recv);
        imported.length = t_recv - began;
        let writer = match &mut writer {
            Some(writer) => writer,
            empty => {
                let created = empty.insert(CaptureWriter::create(out, config_toml, began)?);
                if !made_of.is_empty() {
                    created.made_of(Source::Autopilot.topic(), &made_of);
                }
                created
            }
        };
        writer.write(&Event { t_recv, seq, body })?;
        seq += 1;
    }
    writer.map_or(Err(ImportFailure::Nothing), |w| Ok(w.finish()?))
}
