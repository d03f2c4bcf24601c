//! Reports of the store: state of the card for the health line, and notices for the operator.

use std::collections::VecDeque;
use std::fmt;

use serde::Serialize;

/// State of the recorder.
#[derive(Clone, PartialEq, Eq, Debug, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Recording {
    /// Not started yet.
    #[default]
    Starting,
    /// Everything is recorded.
    On,
    /// Nothing is recorded, for this reason; tried again every few seconds.
    Stopped(String),
    /// Configured off, or ended.
    Off,
}

/// State of the store.
#[derive(Clone, PartialEq, Debug, Default, Serialize)]
pub struct StoreStatus {
    /// State of the recorder.
    pub recording: Recording,
    /// Name of the flight's directory.
    pub flight: String,
    /// Megabytes free on the card; `None` where not known.
    pub free_mb: Option<u64>,
    /// 99th percentile of the last 600 commits (chunk and fdatasync), ms.
    pub fsync_p99_ms: f64,
    /// Longest commit since the start, ms.
    pub fsync_max_ms: f64,
    /// Number of dropouts.
    pub dropouts: u64,
    /// Messages dropped.
    pub dropped_messages: u64,
    /// Bytes in the flight's segments.
    pub bytes_written: u64,
    /// Bytes waiting for the card.
    pub waiting_bytes: u64,
    /// Host time of the last commit, ns; 0 before the first.
    pub last_commit_ns: i64,
    /// Whether the index is open.
    pub index_ready: bool,
    /// After the end: why the last part of the flight is not on the card; `None` where it is.
    pub unwritten: Option<String>,
}

impl StoreStatus {
    /// After the end: the result as text, and whether the end of the flight is on the card.
    pub fn outcome(&self) -> Result<String, String> {
        match (&self.unwritten, self.dropped_messages) {
            (Some(reason), _) => Err(reason.clone()),
            (None, 0) => Ok("everything is written".into()),
            (None, lost) => Ok(format!("written, except for {lost} messages that were lost before")),
        }
    }
}

/// A notice for the operator.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum StoreNotice {
    /// A flight began.
    Started {
        /// Its name.
        flight: String,
    },
    /// Recording has stopped.
    Stopped {
        /// Why, and what to do.
        reason: String,
    },
    /// Recording continues.
    Resumed {
        /// The flight.
        flight: String,
    },
    /// The flight was named by its date.
    Named {
        /// Old name.
        from: String,
        /// New name.
        to: String,
    },
    /// Data was dropped because the card did not keep up.
    Dropout {
        /// Messages.
        messages: u64,
        /// Bytes.
        bytes: u64,
    },
    /// Less space is free than required, and nothing may be deleted.
    AlmostFull {
        /// Megabytes free.
        free_mb: u64,
    },
    /// A segment that was cut or had a gap was sealed.
    Sealed {
        /// Flight and segment.
        segment: String,
        /// What was done.
        what: String,
    },
    /// A flight was deleted for space or for its age.
    Deleted {
        /// Its name.
        flight: String,
        /// The reason.
        reason: String,
    },
    /// The index was unusable and is being rebuilt.
    IndexRebuilding {
        /// The reason.
        reason: String,
    },
    /// The index is complete.
    IndexReady {
        /// Flights in it.
        flights: usize,
    },
    /// A part other than recording failed.
    Failed {
        /// The failure.
        reason: String,
    },
}

impl StoreNotice {
    /// Its fixed name, by which logs are searched.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Started { .. } => "recording_started",
            Self::Stopped { .. } => "recording_stopped",
            Self::Resumed { .. } => "recording_resumed",
            Self::Named { .. } => "flight_named",
            Self::Dropout { .. } => "recording_dropout",
            Self::AlmostFull { .. } => "card_almost_full",
            Self::Sealed { .. } => "segment_sealed",
            Self::Deleted { .. } => "flight_deleted",
            Self::IndexRebuilding { .. } => "index_rebuilding",
            Self::IndexReady { .. } => "index_ready",
            Self::Failed { .. } => "store_failed",
        }
    }

    /// Whether the operator should act.
    pub const fn is_warning(&self) -> bool {
        matches!(
            self,
            Self::Stopped { .. }
                | Self::Dropout { .. }
                | Self::AlmostFull { .. }
                | Self::IndexRebuilding { .. }
                | Self::Failed { .. }
        )
    }
}

impl fmt::Display for StoreNotice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Started { flight } => write!(f, "recording to {flight}"),
            Self::Stopped { reason } => write!(f, "NOT RECORDING: {reason}"),
            Self::Resumed { flight } => write!(f, "recording again, to {flight}"),
            Self::Named { from, to } => write!(f, "flight {from} is now {to}"),
            Self::Dropout { messages, bytes } => {
                write!(f, "the card does not keep up: {messages} messages ({} kB) dropped", bytes / 1000)
            }
            Self::AlmostFull { free_mb } => {
                write!(f, "{free_mb} MB free and no flight may be deleted; move flights off the card")
            }
            Self::Sealed { segment, what } => write!(f, "{segment}: {what}"),
            Self::Deleted { flight, reason } => write!(f, "flight {flight} deleted: {reason}"),
            Self::IndexRebuilding { reason } => write!(f, "{reason}; rebuilding it from the segments"),
            Self::IndexReady { flights } => write!(f, "index complete: {flights} flights"),
            Self::Failed { reason } => write!(f, "{reason}"),
        }
    }
}

/// The last durations of something, ms.
#[derive(Clone, Debug, Default)]
pub struct Durations {
    last: VecDeque<f64>,
    max: f64,
}

impl Durations {
    const KEPT: usize = 600;

    /// Adds one.
    pub fn add(&mut self, ms: f64) {
        if self.last.len() == Self::KEPT {
            self.last.pop_front();
        }
        self.last.push_back(ms);
        self.max = self.max.max(ms);
    }

    /// 99th percentile of those kept; 0 without any.
    pub fn p99(&self) -> f64 {
        let mut sorted: Vec<f64> = self.last.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let at = (sorted.len() * 99).div_ceil(100).saturating_sub(1);
        sorted.get(at).copied().unwrap_or(0.0)
    }

    /// The longest of all.
    pub fn max(&self) -> f64 {
        self.max
    }
}
