//! The outputs of a flight for other tools: CSV, GeoJSON, KML, bags of ROS 2, video with its metadata.

mod csv;
mod geojson;
mod kml;
mod klv_ts;
mod rosbag2;
mod tracks;

use std::path::{Path, PathBuf};

use crate::io::mcap_read::{McapReader, ReadError};
use crate::io::mcap_write::WriteError;
use crate::io::video::VideoError;

/// A format of `windhover export`.
#[derive(Clone, Copy, PartialEq, Eq, Debug, clap::ValueEnum)]
pub enum Format {
    /// Tables with a header row, one file a kind of output
    Csv,
    /// Tracks and positions for GIS
    Geojson,
    /// Moving tracks for Google Earth
    Kml,
    /// A bag for ROS 2 (MCAP): odometry, fixes, images, transforms, detections, diagnostics
    Rosbag2,
    /// Video (H.264 in an MPEG transport stream) with its metadata (KLV after MISB ST 0601 and 0903)
    KlvTs,
}

/// Why a flight could not be exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The flight could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A recording could not be written.
    #[error(transparent)]
    Record(#[from] WriteError),
    /// A file could not be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The video could not be encoded.
    #[error(transparent)]
    Video(#[from] VideoError),
    /// The recording holds no frames.
    #[error("{} has no frames that can be decoded: there is nothing to export", path.display())]
    NoFrames {
        /// The recording.
        path: PathBuf,
    },
    /// The recording holds no outputs.
    #[error("{} holds no estimates: it is a capture; make a flight of it with `windhover replay`", path.display())]
    NoOutputs {
        /// The recording.
        path: PathBuf,
    },
}

/// What an export wrote, and which parts of the flight were damaged.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Exported {
    /// Files written.
    pub files: Vec<PathBuf>,
    /// Damage found in the flight.
    pub warnings: Vec<String>,
}

impl Format {
    /// The files of a format, each with the text that identifies it near its start.
    pub const fn files(self) -> &'static [(&'static str, &'static str)] {
        match self {
            Self::Csv => &csv::TABLES,
            Self::Geojson => &[geojson::FILE],
            Self::Kml => &[kml::FILE],
            Self::Rosbag2 => &rosbag2::FILES,
            Self::KlvTs => &[klv_ts::FILE],
        }
    }
}

/// Writes a flight's outputs into the directory `out`.
pub fn export(flight: &Path, format: Format, out: &Path) -> Result<Exported, ExportError> {
    let reader = McapReader::open(flight)?;
    let is_new = !out.exists();
    std::fs::create_dir_all(out).map_err(|source| write_error(out, source))?;
    let exported = match format {
        Format::Csv => csv::export(flight, reader, out)?,
        Format::Geojson => geojson::export(reader, out)?,
        Format::Kml => kml::export(reader, out)?,
        Format::Rosbag2 => rosbag2::export(flight, out)?,
        Format::KlvTs => klv_ts::export(flight, reader, out)?,
    };
    if exported.files.is_empty() {
        if is_new {
            std::fs::remove_dir(out).map_err(|source| write_error(out, source))?;
        }
        return Err(ExportError::NoOutputs { path: flight.to_owned() });
    }
    Ok(exported)
}

fn write_error(path: &Path, source: std::io::Error) -> ExportError {
    ExportError::Write { path: path.to_owned(), source }
}
