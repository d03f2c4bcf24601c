//! Import: recordings people already have, merged into one capture in order of time.

use std::iter::Peekable;
use std::path::{Path, PathBuf};

use crate::io::capture::CaptureWriter;
use crate::io::import::{
    Frames, ImportError, Samples, VideoSource, open_video, read_attitude, read_inertial, read_serial_log,
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
    /// Video file, or folder of images.
    pub video: Option<PathBuf>,
    /// When the video's first frame was taken; with the first line of the logs where absent.
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
    /// Nothing was asked for.
    #[error("nothing to import: give at least one of --gps, --compass, --imu, --attitude, --video")]
    Nothing,
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
    /// Frames.
    pub frames: u32,
    /// How the video was read.
    pub video: Option<VideoSource>,
    /// From first to last event.
    pub length: Span,
    /// What was left out, in words.
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
    serial.sort_by_key(|(t, _)| *t);
    let start = sources.video_start.or_else(|| serial.first().map(|(t, _)| *t)).unwrap_or_default();
    let frames: Frames = match &sources.video {
        Some(path) => {
            let (how, frames) = open_video(path, start)?;
            imported.video = Some(how);
            frames
        }
        None if serial.is_empty() => return Err(ImportFailure::Nothing),
        None => Box::new(std::iter::empty()),
    };
    write(serial, frames.peekable(), config_toml, out, &mut imported)?;
    Ok(imported)
}

fn serial_lines(path: &Path, warnings: &mut Vec<String>) -> Result<Vec<(MonoTime, Vec<u8>)>, ImportError> {
    let log = read_serial_log(path)?;
    if let Some(first) = log.untimed.first() {
        let count = log.untimed.len();
        warnings.push(format!(
            "{}: {} without a time left out, line {first} first",
            path.display(),
            counted(count, "line")
        ));
    }
    Ok(log.lines)
}

/// The samples of a table; rows left out are warned of.
fn rows<T>(path: &Path, table: Samples<T>, warnings: &mut Vec<String>) -> Vec<(MonoTime, T)> {
    if let Some(first) = table.unread.first() {
        let count = table.unread.len();
        warnings.push(format!(
            "{}: {} that cannot be read left out, line {first} first",
            path.display(),
            counted(count, "row")
        ));
    }
    table.samples
}

fn write(
    serial: Vec<(MonoTime, EventBody)>,
    mut frames: Peekable<Frames>,
    config_toml: &str,
    out: &Path,
    imported: &mut Imported,
) -> Result<(), ImportFailure> {
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
            empty => empty.insert(CaptureWriter::create(out, config_toml, began)?),
        };
        writer.write(&Event { t_recv, seq, body })?;
        seq += 1;
    }
    writer.map_or(Err(ImportFailure::Nothing), |w| Ok(w.finish()?))
}
