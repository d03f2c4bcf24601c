//! What the store tells: state of the card for the health line, and notices for the operator.

use std::collections::VecDeque;
use std::fmt;

use serde::Serialize;

/// What the recorder does.
#[derive(Clone, PartialEq, Eq, Debug, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Recording {
    /// Not yet.
    #[default]
    Starting,
    /// Everything goes to the card.
    On,
    /// Nothing goes to the card, because of this; tried again every few seconds.
    Stopped(String),
    /// Configured off, or ended.
    Off,
}

/// How the store does.
#[derive(Clone, PartialEq, Debug, Default, Serialize)]
pub struct StoreStatus {
    /// What the recorder does.
    pub recording: Recording,
    /// Name of the flight's directory.
    pub flight: String,
    /// Megabytes free on the card; `None` where it cannot be asked.
    pub free_mb: Option<u64>,
    /// 99th percentile of the last 600 commits (chunk to the card and fdatasync), ms.
    pub fsync_p99_ms: f64,
    /// Longest commit since the start, ms.
    pub fsync_max_ms: f64,
    /// Times that something was dropped.
    pub dropouts: u64,
    /// Messages dropped.
    pub dropped_messages: u64,
    /// Bytes in the flight's segments.
    pub bytes_written: u64,
    /// Bytes waiting for the card.
    pub waiting_bytes: u64,
    /// Host time of the last commit, ns; 0 before the first.
    pub last_commit_ns: i64,
    /// Whether the index answers.
    pub index_ready: bool,
    /// After the end: why the last of the flight is not on the card; `None` where it is.
    pub unwritten: Option<String>,
}

impl StoreStatus {
    /// After the end: what was done, in words, and whether the end of the flight is on the card.
    pub fn outcome(&self) -> Result<String, String> {
        match (&self.unwritten, self.dropped_messages) {
            (Some(reason), _) => Err(reason.clone()),
            (None, 0) => Ok("everything is written".into()),
            (None, lost) => Ok(format!("written, but for {lost} messages that were lost on the way")),
        }
    }
}

/// Something an operator should know.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum StoreNotice {
    /// A flight began.
    Started {
        /// Its name.
        flight: String,
    },
    /// Nothing goes to the card any more.
    Stopped {
        /// Why, and what to do.
        reason: String,
    },
    /// Recording goes on.
    Resumed {
        /// In which flight.
        flight: String,
    },
    /// The flight has its date.
    Named {
        /// Old name.
        from: String,
        /// New name.
        to: String,
    },
    /// Something was dropped because the card did not keep up.
    Dropout {
        /// Messages.
        messages: u64,
        /// Bytes.
        bytes: u64,
    },
    /// Less is free than wanted, and nothing may be deleted.
    AlmostFull {
        /// Megabytes free.
        free_mb: u64,
    },
    /// A segment that was cut or holed was sealed.
    Sealed {
        /// Flight and segment.
        segment: String,
        /// What was done.
        what: String,
    },
    /// A flight was deleted to make room or for its age.
    Deleted {
        /// Its name.
        flight: String,
        /// Why.
        reason: String,
    },
    /// The index was unusable and is being made again.
    IndexRebuilding {
        /// Why.
        reason: String,
    },
    /// The index is complete.
    IndexReady {
        /// Flights in it.
        flights: usize,
    },
    /// Something beside recording failed.
    Failed {
        /// What.
        reason: String,
    },
}

impl StoreNotice {
    /// Its fixed name, which people search logs for.
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

    /// Whether the operator should do something.
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
                write!(f, "{free_mb} MB free and no flight may be deleted; take flights off the card")
            }
            Self::Sealed { segment, what } => write!(f, "{segment}: {what}"),
            Self::Deleted { flight, reason } => write!(f, "flight {flight} deleted: {reason}"),
            Self::IndexRebuilding { reason } => write!(f, "{reason}; making it again from the segments"),
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

    /// Notes one.
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
