//! Existing recordings, converted to the events of a capture.

mod avi;
mod bag;
mod dataflash;
mod folder;
mod log;
mod measured;
mod samples;
mod serial_log;
mod srt;
mod stamp;
mod tlog;
mod ulog;
mod video;
mod y4m;

pub use bag::{ImportedBag, read_bag};
pub use log::read_log;
pub use measured::ImportedLog;
pub use samples::{Samples, read_attitude, read_inertial};
pub use serial_log::read_serial_log;
pub use stamp::parse_time;
pub use video::{VideoSource, open_video};

use std::path::{Path, PathBuf};

use windhover_base::msg::FramePayload;

/// Why a recording could not be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The system's refusal.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A malformed line or header.
    #[error("{}:{line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// A bag that cannot be read here.
    #[error("{}: {reason}", path.display())]
    Bag {
        /// The bag.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
    /// A log that cannot be read here.
    #[error("{} {reason}", path.display())]
    Log {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A video that cannot be read here.
    #[error("{}: {reason}", path.display())]
    Video {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
}

impl ImportError {
    fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }

    fn line(path: &Path, line: usize, reason: impl Into<String>) -> Self {
        Self::Line { path: path.to_owned(), line, reason: reason.into() }
    }

    fn video(path: &Path, reason: impl Into<String>) -> Self {
        Self::Video { path: path.to_owned(), reason: reason.into() }
    }
}

/// Frames with their times, in order.
pub type Frames = Box<dyn Iterator<Item = Result<FramePayload, ImportError>>>;
