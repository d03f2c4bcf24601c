//! The one table of operator events: fixed names, severities, throttles.
//!
//! People search logs and write alarms for these names: a name never changes its meaning and is
//! never used again.

use crate::config::LogLevel;
use crate::io::device::NoteKind;
use windhover_base::msg::{Notice, NoticeKind};
use windhover_base::time::{MonoTime, Span};

use super::log::Line;

/// What an operator is told of.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Event {
    /// The daemon has begun.
    Started,
    /// Everything asked for is up.
    Ready,
    /// Something asked for is not up yet.
    NotReady,
    /// The end was asked for.
    Stopping,
    /// The end.
    Stopped,
    /// From exposure to estimate, over the whole flight; at its end.
    Latencies,
    /// A device is open.
    DeviceUp,
    /// A device does not deliver; it is tried again.
    DeviceDown,
    /// A device delivers, with something to know about it.
    Device(NoteKind),
    /// The pipeline says something.
    Pipeline(NoticeKind),
    /// A flight was closed because power is going.
    FlightClosed,
    /// The store says something about the data card; names are the store's own.
    Card {
        /// Its fixed name.
        name: &'static str,
        /// Whether the operator should do something.
        warning: bool,
    },
    /// A ground station is connected.
    LinkUp,
    /// A ground station went away.
    LinkDown,
    /// The link does not work.
    LinkFault,
    /// The supply voltage is going.
    PowerGoing,
    /// The supply voltage is back.
    PowerBack,
    /// The computer is hot.
    Hot,
    /// There is a state of an earlier run; whether it is continued from.
    WarmStart,
    /// The configuration was read again.
    Reloaded,
    /// A changed value of the configuration takes a restart.
    NeedsRestart,
    /// The configuration could not be read again; the old one stays.
    ReloadRefused,
    /// A task does not answer; the watchdog is not stroked.
    TaskSilent,
    /// A task answers again.
    TaskBack,
    /// A task panicked.
    TaskFailed,
}

/// One row of the table.
struct Row {
    name: &'static str,
    level: LogLevel,
    /// At most one line this often about the same thing; what came between is counted.
    every: Span,
}

const fn row(name: &'static str, level: LogLevel, every_s: i64) -> Row {
    Row { name, level, every: Span::from_ns(every_s * windhover_base::time::NS_PER_S) }
}

use LogLevel::{Error, Info, Warn};

impl Event {
    const fn row(self) -> Row {
        match self {
            Self::Started => row("started", Info, 0),
            Self::Ready => row("ready", Info, 0),
            Self::NotReady => row("not_ready", Warn, 30),
            Self::Stopping => row("stopping", Info, 0),
            Self::Stopped => row("stopped", Info, 0),
            Self::Latencies => row("latencies", Info, 0),
            Self::DeviceUp => row("device_up", Info, 0),
            Self::DeviceDown => row("device_down", Warn, 30),
            Self::Device(note) => device_row(note),
            Self::Pipeline(notice) => pipeline_row(notice),
            Self::FlightClosed => row("flight_closed", Warn, 0),
            Self::Card { name, warning: true } => row(name, Warn, 5),
            Self::Card { name, warning: false } => row(name, Info, 0),
            Self::LinkUp => row("link_up", Info, 0),
            Self::LinkDown => row("link_down", Warn, 0),
            Self::LinkFault => row("link_fault", Warn, 30),
            Self::PowerGoing => row("power_going", Error, 0),
            Self::PowerBack => row("power_back", Info, 0),
            Self::Hot => row("hot", Warn, 60),
            Self::WarmStart => row("warm_start", Info, 0),
            Self::Reloaded => row("reloaded", Info, 0),
            Self::NeedsRestart => row("needs_restart", Warn, 0),
            Self::ReloadRefused => row("reload_refused", Error, 0),
            Self::TaskSilent => row("task_silent", Error, 5),
            Self::TaskBack => row("task_back", Info, 0),
            Self::TaskFailed => row("task_failed", Error, 0),
        }
    }

    /// Its fixed name.
    pub const fn name(self) -> &'static str {
        self.row().name
    }

    /// How grave it is.
    pub const fn level(self) -> LogLevel {
        self.row().level
    }

    /// At most one line this often about the same thing.
    pub const fn throttle(self) -> Span {
        self.row().every
    }

    /// What is over with it, so that it is news when it happens to the same thing again.
    pub const fn ends(self) -> Option<Self> {
        match self {
            Self::DeviceUp => Some(Self::DeviceDown),
            _ => None,
        }
    }
}

const fn device_row(note: NoteKind) -> Row {
    match note {
        NoteKind::Garbled => row("device_garbled", Warn, 10),
        NoteKind::StampsUnusable => row("camera_stamps_unusable", Warn, 10),
        NoteKind::FrameDamaged => row("camera_frame_damaged", Warn, 5),
        NoteKind::FormatDiffers => row("camera_format_differs", Warn, 0),
        NoteKind::FramesMissed => row("camera_frames_missed", Warn, 5),
        NoteKind::Configured => row("receiver_configured", Info, 0),
        NoteKind::NotConfigured => row("receiver_not_configured", Warn, 0),
        NoteKind::PlayedOut => row("recording_played_out", Info, 0),
    }
}

const fn pipeline_row(notice: NoticeKind) -> Row {
    let (level, every_s) = match notice {
        NoticeKind::FixAcquired
        | NoticeKind::SourceBack
        | NoticeKind::DatumSet
        | NoticeKind::Declination
        | NoticeKind::TargetTracking => (Info, 0),
        NoticeKind::TargetCoasting => (Info, 5),
        NoticeKind::FixLost
        | NoticeKind::SourceSilent
        | NoticeKind::TerrainMissing
        | NoticeKind::FilterReset
        | NoticeKind::TargetLost => (Warn, 0),
        NoticeKind::BytesRefused
        | NoticeKind::FrameUnusable
        | NoticeKind::Dropped
        | NoticeKind::ClockJump => (Warn, 5),
    };
    row(notice.name(), level, every_s)
}

/// The pipeline's notice as a line; replay and daemon show it alike.
pub fn line_of_notice(notice: &Notice) -> Line {
    let event = Event::Pipeline(notice.kind);
    let line = Line::new(notice.t, event.level(), event.name()).says(notice.detail.clone());
    match notice.source {
        Some(source) => line.with("about", source.name()),
        None => line,
    }
}

/// Holds back lines that come too often about the same thing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Throttle {
    last: Option<MonoTime>,
    held: u64,
}

impl Throttle {
    /// Whether a line may pass at `t`: how many were held back since the last that did; `None` where
    /// this one is held back too.
    pub fn pass(&mut self, t: MonoTime, every: Span) -> Option<u64> {
        if every > Span::ZERO && self.last.is_some_and(|last| t - last < every) {
            self.held += 1;
            return None;
        }
        self.last = Some(t);
        Some(std::mem::take(&mut self.held))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_searchable() {
        let notes = [
            NoteKind::Garbled,
            NoteKind::StampsUnusable,
            NoteKind::FrameDamaged,
            NoteKind::FormatDiffers,
            NoteKind::FramesMissed,
            NoteKind::Configured,
            NoteKind::NotConfigured,
            NoteKind::PlayedOut,
        ];
        let plain = [
            Event::Started,
            Event::Ready,
            Event::NotReady,
            Event::Stopping,
            Event::Stopped,
            Event::Latencies,
            Event::DeviceUp,
            Event::DeviceDown,
            Event::FlightClosed,
            Event::LinkUp,
            Event::LinkDown,
            Event::LinkFault,
            Event::PowerGoing,
            Event::PowerBack,
            Event::Hot,
            Event::Reloaded,
            Event::NeedsRestart,
            Event::ReloadRefused,
            Event::TaskSilent,
            Event::TaskBack,
            Event::TaskFailed,
            Event::Pipeline(NoticeKind::Dropped),
            Event::Pipeline(NoticeKind::FixLost),
        ];
        let events: Vec<Event> = plain.into_iter().chain(notes.into_iter().map(Event::Device)).collect();
        let mut names: Vec<&str> = events.iter().map(|event| event.name()).collect();
        assert!(names.iter().all(|name| name.chars().all(|c| c.is_ascii_lowercase() || c == '_')));
        names.sort_unstable();
        let count = names.len();
        names.dedup();
        assert_eq!(names.len(), count);
    }

    #[test]
    fn what_is_held_back_is_counted() {
        let at = |ms: f64| MonoTime::from_ns(0) + Span::from_ms(ms);
        let mut throttle = Throttle::default();
        let every = Span::from_s(5.0);
        assert_eq!(throttle.pass(at(0.0), every), Some(0));
        assert_eq!(throttle.pass(at(100.0), every), None);
        assert_eq!(throttle.pass(at(4_900.0), every), None);
        assert_eq!(throttle.pass(at(5_000.0), every), Some(2));
        assert_eq!(throttle.pass(at(5_000.0), Span::ZERO), Some(0));
    }
}
