//! The one table of operator events: fixed names, severities, throttles. Each row is a `tracing` callsite.
//!
//! Operators search logs and write alarms for these names: a name never changes its meaning and is never reused.

use std::fmt::Display;
use std::path::Path;

use tracing::field::Empty;
use tracing::{Level, Metadata, Span};

use crate::io::device::{Fault, NoteKind};
use crate::io::store::StoreNotice;
use windhover_base::msg::{MisfitWords, Notice, NoticeKind, Source};
use windhover_base::time::{self, MonoTime, NS_PER_S, UtcTime};

use super::latencies::OfFlight;

/// The target of every operator event, used by nothing else.
pub const TARGET: &str = "windhover";

/// Makes the enum, its rows, and a callsite for each row: `tracing` needs name, severity and field names as constants.
macro_rules! table {
    ($( $(#[$doc:meta])* $variant:ident: $name:literal, $level:ident, every $every_s:literal s; )*) => {
        /// An event for the operator.
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
        pub enum OperatorEvent { $( $(#[$doc])* $variant, )* }

        impl OperatorEvent {
            /// Every row.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];

            const fn row(self) -> Row {
                match self {
                    $(Self::$variant => {
                        Row { name: $name, level: Level::$level, every: time::Span::from_ns($every_s * NS_PER_S) }
                    })*
                }
            }

            fn send(self, t: Option<MonoTime>, about: &str, words: &dyn Display) {
                let t_ns = t.map(MonoTime::ns);
                let about = (!about.is_empty()).then_some(about);
                match self {
                    $(Self::$variant => {
                        tracing::event!(name: $name, target: TARGET, Level::$level, { about, t_ns }, "{words}");
                    })*
                }
            }
        }
    };
}

table! {
    /// The daemon has started.
    Started: "started", INFO, every 0 s;
    /// Every required part is up.
    Ready: "ready", INFO, every 0 s;
    /// A required part is not up yet.
    NotReady: "not_ready", WARN, every 30 s;
    /// A stop was requested.
    Stopping: "stopping", INFO, every 0 s;
    /// The daemon has stopped.
    Stopped: "stopped", INFO, every 0 s;
    /// Latency from exposure to estimate over the whole flight; sent at its end.
    Latencies: "latencies", INFO, every 0 s;
    /// State of all parts; once a second.
    Health: "health", INFO, every 0 s;
    /// A device is open.
    DeviceUp: "device_up", INFO, every 0 s;
    /// A device does not deliver; it is opened again.
    DeviceDown: "device_down", WARN, every 30 s;
    /// The bytes that arrive do not fit the line's speed and format.
    DeviceGarbled: "device_garbled", WARN, every 10 s;
    /// The driver's stamps cannot be used; arrival times replace them.
    CameraStampsUnusable: "camera_stamps_unusable", WARN, every 10 s;
    /// The driver flagged a frame as damaged.
    CameraFrameDamaged: "camera_frame_damaged", WARN, every 5 s;
    /// The camera delivers another format than requested.
    CameraFormatDiffers: "camera_format_differs", WARN, every 0 s;
    /// The driver, or the line that triggers the camera, counted frames that did not come.
    CameraFramesMissed: "camera_frames_missed", WARN, every 5 s;
    /// Exposure and gain of the camera were set; the message has them.
    CameraExposureSet: "camera_exposure_set", INFO, every 0 s;
    /// The camera cannot have the exposure or gain that is configured.
    CameraExposureNotSet: "camera_exposure_not_set", WARN, every 0 s;
    /// Frames arrive, and no pulses on the line that triggers the camera.
    CameraTriggerSilent: "camera_trigger_silent", WARN, every 30 s;
    /// A receiver accepted its configuration.
    ReceiverConfigured: "receiver_configured", INFO, every 0 s;
    /// A receiver refused or ignored its configuration.
    ReceiverNotConfigured: "receiver_not_configured", WARN, every 0 s;
    /// A recorded source has played to its end.
    RecordingPlayedOut: "recording_played_out", INFO, every 0 s;
    /// The receiver has a position.
    FixAcquired: "fix_acquired", INFO, every 0 s;
    /// The receiver lost its position.
    FixLost: "fix_lost", WARN, every 0 s;
    /// A source delivered nothing for longer than its time-out.
    SourceSilent: "source_silent", WARN, every 0 s;
    /// A silent source delivers again.
    SourceBack: "source_back", INFO, every 0 s;
    /// Bytes of a source were refused (checksum, range, grammar).
    BytesRefused: "bytes_refused", WARN, every 5 s;
    /// A frame could not be decoded, or has the wrong size.
    FrameUnusable: "frame_unusable", WARN, every 5 s;
    /// Parts of a frame are lost; the others are used.
    FrameDamaged: "frame_damaged", WARN, every 5 s;
    /// Frames or bytes were lost before they could be recorded.
    Dropped: "dropped", WARN, every 5 s;
    /// The origin of the NED frame is settled.
    DatumSet: "datum_set", INFO, every 0 s;
    /// Positions of the receiver cannot be used; the message gives the reason.
    PositionsUnused: "positions_unused", WARN, every 0 s;
    /// The receiver's pulses arrive and are not used; the message gives the reason.
    PulseUnused: "pulse_unused", WARN, every 60 s;
    /// The terrain tile of the configuration cannot be used here: level ground is assumed instead.
    TerrainMissing: "terrain_missing", WARN, every 0 s;
    /// Declination was taken from the World Magnetic Model, or could not be.
    Declination: "declination", INFO, every 0 s;
    /// A target was found and its estimate has settled.
    TargetTracking: "target_tracking", INFO, every 0 s;
    /// A target is out of sight; its state is predicted.
    TargetCoasting: "target_coasting", INFO, every 5 s;
    /// A target is lost.
    TargetLost: "target_lost", WARN, every 0 s;
    /// The filter was reset.
    FilterReset: "filter_reset", WARN, every 0 s;
    /// A stamp went back or jumped ahead.
    ClockJump: "clock_jump", WARN, every 5 s;
    /// A measurement does not fit the configuration or the filter's model. The pipeline limits the rate of this event.
    ModelMisfit: "model_misfit", WARN, every 0 s;
    /// The same marker was seen at two places of a frame. The pipeline limits the rate of this event.
    MarkerSeenTwice: "marker_seen_twice", WARN, every 0 s;
    /// It was found out what the compass's tilt sensor measures.
    TiltFelt: "tilt_felt", INFO, every 0 s;
    /// A flight was closed because power is failing.
    FlightClosed: "flight_closed", WARN, every 0 s;
    /// A flight began on the card.
    RecordingStarted: "recording_started", INFO, every 0 s;
    /// Recording to the card has stopped.
    RecordingStopped: "recording_stopped", WARN, every 5 s;
    /// Recording continues.
    RecordingResumed: "recording_resumed", INFO, every 0 s;
    /// The flight's directory was named by its date.
    FlightNamed: "flight_named", INFO, every 0 s;
    /// Data was dropped because the card did not keep up.
    RecordingDropout: "recording_dropout", WARN, every 5 s;
    /// Less space is free than required, and nothing may be deleted.
    CardAlmostFull: "card_almost_full", WARN, every 5 s;
    /// A segment that was cut or had a gap was sealed.
    SegmentSealed: "segment_sealed", INFO, every 0 s;
    /// A flight was deleted for space or for its age.
    FlightDeleted: "flight_deleted", INFO, every 0 s;
    /// The index was unusable and is being rebuilt.
    IndexRebuilding: "index_rebuilding", WARN, every 5 s;
    /// The index is complete.
    IndexReady: "index_ready", INFO, every 0 s;
    /// A part of the store other than recording failed.
    StoreFailed: "store_failed", WARN, every 5 s;
    /// A ground station is connected.
    LinkUp: "link_up", INFO, every 0 s;
    /// A ground station is disconnected.
    LinkDown: "link_down", WARN, every 0 s;
    /// The link does not work.
    LinkFault: "link_fault", WARN, every 30 s;
    /// MAVLink does not reach a station: its name does not resolve, or the system refuses its datagrams.
    MavlinkFault: "mavlink_fault", WARN, every 30 s;
    /// MAVLink is sent to that station again.
    MavlinkUp: "mavlink_up", INFO, every 0 s;
    /// An autopilot was found, was restarted, or is not the only one.
    AutopilotNote: "autopilot_note", WARN, every 5 s;
    /// The supply voltage is failing.
    PowerGoing: "power_going", ERROR, every 0 s;
    /// The supply voltage is back.
    PowerBack: "power_back", INFO, every 0 s;
    /// The computer is hot.
    Hot: "hot", WARN, every 60 s;
    /// A state of an earlier run exists; the message states whether it is used.
    WarmStart: "warm_start", INFO, every 0 s;
    /// The configuration was read again.
    Reloaded: "reloaded", INFO, every 0 s;
    /// A changed value of the configuration needs a restart.
    NeedsRestart: "needs_restart", WARN, every 0 s;
    /// The configuration could not be read again; the previous one stays in use.
    ReloadRefused: "reload_refused", ERROR, every 0 s;
    /// A task does not answer; the watchdog is not notified.
    TaskSilent: "task_silent", ERROR, every 5 s;
    /// A task answers again.
    TaskBack: "task_back", INFO, every 0 s;
    /// A task panicked.
    TaskFailed: "task_failed", ERROR, every 0 s;
    /// The log's file cannot be written.
    LogFile: "log_file", WARN, every 30 s;
    /// A sink of the log is too slow: lines are missing there.
    LogLinesLost: "log_lines_lost", WARN, every 30 s;
}

/// One row of the table.
struct Row {
    name: &'static str,
    level: Level,
    /// Shortest time between two lines about the same subject; those between are counted.
    every: time::Span,
}

/// Emits a row with additional fields.
macro_rules! emit {
    ($variant:ident, { $($fields:tt)* }, $($words:tt)+) => {
        tracing::event!(
            name: OperatorEvent::$variant.name(),
            target: TARGET,
            OperatorEvent::$variant.level(),
            { $($fields)* },
            $($words)+
        )
    };
}

impl OperatorEvent {
    /// Its fixed name.
    pub const fn name(self) -> &'static str {
        self.row().name
    }

    /// Its severity.
    pub const fn level(self) -> Level {
        self.row().level
    }

    /// Shortest time between two lines about the same subject.
    pub const fn throttle(self) -> time::Span {
        self.row().every
    }

    /// The event that this one ends, so that its next occurrence for the same subject is shown at once.
    pub const fn ends(self) -> Option<Self> {
        match self {
            Self::DeviceUp => Some(Self::DeviceDown),
            _ => None,
        }
    }

    /// The row that a `tracing` event comes from; `None` where a library emitted it.
    pub fn of(metadata: &Metadata<'_>) -> Option<Self> {
        let row = |name| Self::ALL.iter().copied().find(|event| event.name() == name);
        (metadata.target() == TARGET).then(|| row(metadata.name()))?
    }

    /// Emits the event now; `about` names its subject (a source, a task, a peer), and is empty where that is the
    /// daemon. The same event about the same subject is throttled.
    pub fn emit(self, about: &str, words: impl Display) {
        self.send(None, about, &words);
    }
}

impl From<NoteKind> for OperatorEvent {
    fn from(note: NoteKind) -> Self {
        match note {
            NoteKind::Garbled => Self::DeviceGarbled,
            NoteKind::StampsUnusable => Self::CameraStampsUnusable,
            NoteKind::FrameDamaged => Self::CameraFrameDamaged,
            NoteKind::FormatDiffers => Self::CameraFormatDiffers,
            NoteKind::FramesMissed => Self::CameraFramesMissed,
            NoteKind::ExposureSet => Self::CameraExposureSet,
            NoteKind::ExposureNotSet => Self::CameraExposureNotSet,
            NoteKind::TriggerSilent => Self::CameraTriggerSilent,
            NoteKind::Configured => Self::ReceiverConfigured,
            NoteKind::NotConfigured => Self::ReceiverNotConfigured,
            NoteKind::Autopilot => Self::AutopilotNote,
            NoteKind::PlayedOut => Self::RecordingPlayedOut,
        }
    }
}

impl From<NoticeKind> for OperatorEvent {
    fn from(notice: NoticeKind) -> Self {
        match notice {
            NoticeKind::FixAcquired => Self::FixAcquired,
            NoticeKind::FixLost => Self::FixLost,
            NoticeKind::SourceSilent => Self::SourceSilent,
            NoticeKind::SourceBack => Self::SourceBack,
            NoticeKind::BytesRefused => Self::BytesRefused,
            NoticeKind::FrameUnusable => Self::FrameUnusable,
            NoticeKind::FrameDamaged => Self::FrameDamaged,
            NoticeKind::Dropped => Self::Dropped,
            NoticeKind::DatumSet => Self::DatumSet,
            NoticeKind::PositionsUnused => Self::PositionsUnused,
            NoticeKind::PulseUnused => Self::PulseUnused,
            NoticeKind::TerrainMissing => Self::TerrainMissing,
            NoticeKind::Declination => Self::Declination,
            NoticeKind::TargetTracking => Self::TargetTracking,
            NoticeKind::TargetCoasting => Self::TargetCoasting,
            NoticeKind::TargetLost => Self::TargetLost,
            NoticeKind::FilterReset => Self::FilterReset,
            NoticeKind::ClockJump => Self::ClockJump,
            NoticeKind::ModelMisfit => Self::ModelMisfit,
            NoticeKind::MarkerSeenTwice => Self::MarkerSeenTwice,
            NoticeKind::TiltFelt => Self::TiltFelt,
        }
    }
}

impl From<&StoreNotice> for OperatorEvent {
    fn from(notice: &StoreNotice) -> Self {
        match notice {
            StoreNotice::Started { .. } => Self::RecordingStarted,
            StoreNotice::Stopped { .. } => Self::RecordingStopped,
            StoreNotice::Resumed { .. } => Self::RecordingResumed,
            StoreNotice::Named { .. } => Self::FlightNamed,
            StoreNotice::Dropout { .. } => Self::RecordingDropout,
            StoreNotice::AlmostFull { .. } => Self::CardAlmostFull,
            StoreNotice::Sealed { .. } => Self::SegmentSealed,
            StoreNotice::Deleted { .. } => Self::FlightDeleted,
            StoreNotice::IndexRebuilding { .. } => Self::IndexRebuilding,
            StoreNotice::IndexReady { .. } => Self::IndexReady,
            StoreNotice::Failed { .. } => Self::StoreFailed,
        }
    }
}

/// Emits the pipeline's notice, at its own time; replay and daemon show it in the same way.
pub fn notice(notice: &Notice) {
    if let Some(misfit) = &notice.misfit {
        return model_misfit(notice.t, misfit);
    }
    let about = notice.source.map(Source::name).or(notice.target.as_deref()).unwrap_or("");
    OperatorEvent::from(notice.kind).send(Some(notice.t), about, &notice.detail);
}

fn model_misfit(t: MonoTime, misfit: &MisfitWords) {
    let MisfitWords { source, figure, cause, advice, .. } = misfit;
    emit!(ModelMisfit, { t_ns = t.ns(), source, figure, cause }, "{advice}");
}

/// Emits that the daemon has started.
pub fn started(config: &Path) {
    let version = env!("CARGO_PKG_VERSION");
    emit!(Started, { version, config = config.display().to_string() }, "");
}

/// Emits that a device does not deliver. The same fault of a device is throttled; another fault shows at once.
pub fn device_down(about: &str, fault: &Fault) {
    emit!(DeviceDown, { about, fault = fault.kind.name() }, "{fault}");
}

/// Emits the latencies of the whole flight.
pub fn latencies(of: &OfFlight) {
    emit!(
        Latencies,
        { frames = of.frames, p50_ms = of.p50.ms(), p99_ms = of.p99.ms(), max_ms = of.longest.ms() },
        ""
    );
}

/// Emits how many lines a sink of the log has lost.
pub fn log_lines_lost(sink: &str, lines: u64) {
    emit!(LogLinesLost, { about = sink, lines }, "the sink does not keep up");
}

/// The span of a daemon's run; its flight becomes known later.
pub fn run_span(began: MonoTime) -> Span {
    let run = UtcTime::from_unix_ns(began.ns()).compact();
    // At the highest severity, so that it exists whatever level is shown.
    tracing::error_span!(target: TARGET, "run", run, flight = Empty)
}

/// Sets the flight that the card records from now on, in the caller's span.
pub fn flight(name: &str) {
    Span::current().record("flight", name);
}

/// Decimals of a field's value; a sigma has those of its value.
pub fn decimals(field: &str) -> Option<usize> {
    Some(match field.strip_suffix("_sigma").unwrap_or(field) {
        "card_free_mb" | "cpu_pct" | "mem_mb" | "recording_s" | "card_left_s" => 0,
        "latency_p50_ms" | "latency_p99_ms" | "card_sync_p99_ms" | "temp_c" => 1,
        "heading_deg" | "yaw_rate_dps" => 1,
        "supply_v" | "north_m" | "east_m" | "speed_mps" | "p50_ms" | "p99_ms" | "max_ms" => 2,
        rate if rate.ends_with("_hz") => 1,
        age if age.ends_with("_age_s") => 2,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::log::tests::lines_of;

    #[test]
    fn a_misfit_has_its_parts_as_fields() {
        let misfit = MisfitWords {
            source: "ugv tag 1".into(),
            kind: "marker_size",
            figure: "-5.0 %".into(),
            cause: "tag 1 is 5.0 % smaller than configured".into(),
            advice: "measure it".into(),
        };
        let (t, kind, detail) = (MonoTime::from_ns(NS_PER_S), NoticeKind::ModelMisfit, misfit.to_string());
        let reported = Notice { t, kind, source: None, target: None, detail, misfit: Some(misfit) };
        let text = lines_of(|| notice(&reported));
        let fields = "level=warn event=model_misfit msg=\"measure it\" source=\"ugv tag 1\" figure=\"-5.0 %\" \
                      cause=\"tag 1 is 5.0 % smaller than configured\"";
        assert!(text.contains(fields) && text.starts_with("time=1970-01-01T00:00:01"), "{text}");
    }

    #[test]
    fn names_are_unique_and_searchable() {
        let mut names: Vec<&str> = OperatorEvent::ALL.iter().map(|event| event.name()).collect();
        assert!(names.iter().all(|name| name.chars().all(|c| c.is_ascii_lowercase() || c == '_')));
        names.sort_unstable();
        let count = names.len();
        names.dedup();
        assert_eq!(names.len(), count);
    }
}
