//! What the pipeline says: estimates, what became of measurements, notices, health.

use std::collections::BTreeMap;

use windhover_base::geo::Geodetic;
use windhover_base::msg::{
    AttitudeSample, Disposition, FeatureTrack, FixKind, FusionResult, GnssEpoch, MarkerDetection, Ownship,
    Source, Stamped, TargetEstimate,
};
use windhover_base::time::{MonoTime, Span};

/// One thing the pipeline says.
#[derive(Clone, Debug)]
pub enum Output {
    /// The origin of the NED frame was settled, at this host time.
    Datum(MonoTime, Geodetic),
    /// A GPS epoch, mapped to host time.
    Fix(Stamped<GnssEpoch>),
    /// A compass sample, mapped to host time.
    Attitude(Stamped<AttitudeSample>),
    /// What was seen in a frame.
    Detections {
        /// Number of the frame.
        frame: u32,
        /// Exposure of the frame.
        t_valid: MonoTime,
        /// Markers.
        markers: Vec<MarkerDetection>,
        /// Ground features.
        features: Vec<FeatureTrack>,
    },
    /// The helicopter's own state at a frame.
    Ownship(Ownship),
    /// A target's estimate at a frame, as known in real time.
    Estimate(TargetEstimate),
    /// A target's estimate at an earlier frame, from the fixed-lag smoother.
    Smoothed(TargetEstimate),
    /// A target's estimate by the paper's method.
    Paper(TargetEstimate),
    /// What became of a measurement.
    Fusion(FusionResult),
    /// Something an operator should know.
    Notice(Notice),
    /// How everything does, once a second.
    Health(Box<Health>),
}

/// What a notice is about. Names are fixed: people search logs for them.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum NoticeKind {
    /// The receiver has a position.
    FixAcquired,
    /// The receiver lost its position.
    FixLost,
    /// Nothing was heard from a source for longer than its time-out.
    SourceSilent,
    /// A silent source speaks again.
    SourceBack,
    /// Bytes of a source were refused (checksum, range, grammar).
    BytesRefused,
    /// A frame could not be read, or has the wrong size.
    FrameUnusable,
    /// Frames or bytes were lost before they could be recorded.
    Dropped,
    /// The origin of the NED frame was settled.
    DatumSet,
    /// Declination was taken from the World Magnetic Model, or could not be.
    Declination,
    /// A target was found and settled.
    TargetTracking,
    /// A target has not been seen for a moment.
    TargetCoasting,
    /// A target is lost.
    TargetLost,
    /// The filter started again.
    FilterReset,
    /// A stamp went back or leapt ahead.
    ClockJump,
}

impl NoticeKind {
    /// Its fixed name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::FixAcquired => "fix_acquired",
            Self::FixLost => "fix_lost",
            Self::SourceSilent => "source_silent",
            Self::SourceBack => "source_back",
            Self::BytesRefused => "bytes_refused",
            Self::FrameUnusable => "frame_unusable",
            Self::Dropped => "dropped",
            Self::DatumSet => "datum_set",
            Self::Declination => "declination",
            Self::TargetTracking => "target_tracking",
            Self::TargetCoasting => "target_coasting",
            Self::TargetLost => "target_lost",
            Self::FilterReset => "filter_reset",
            Self::ClockJump => "clock_jump",
        }
    }
}

/// Something an operator should know.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Notice {
    /// When, host time.
    pub t: MonoTime,
    /// What it is about.
    pub kind: NoticeKind,
    /// Which source, where it is about one.
    pub source: Option<Source>,
    /// In words: what, where, how many.
    pub detail: String,
}

/// How one source does.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct SourceHealth {
    /// Epochs, samples or frames in the last second.
    pub rate_hz: f64,
    /// Age of the last; `None` before the first.
    pub age: Option<Span>,
    /// Since the start.
    pub total: u64,
    /// Refused since the start.
    pub refused: u64,
    /// Lost before they could be recorded, since the start.
    pub dropped: u64,
}

/// How one target does.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TargetHealth {
    /// Frames in the last second in which a marker of it was seen.
    pub frames_seen: u32,
    /// Its last estimate.
    pub last: TargetEstimate,
}

/// How everything does, once a second of host time.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Health {
    /// When.
    pub t: MonoTime,
    /// GPS.
    pub gps: SourceHealth,
    /// Compass.
    pub compass: SourceHealth,
    /// Camera.
    pub camera: SourceHealth,
    /// Kind of the last fix.
    pub fix: FixKind,
    /// Satellites of the last fix.
    pub sats: Option<u32>,
    /// One-sigma of the fit from UTC to host time.
    pub clock_sigma: Option<Span>,
    /// Targets, in the order of the configuration.
    pub targets: Vec<TargetHealth>,
    /// Measurements by what became of them, since the start.
    pub dispositions: BTreeMap<Disposition, u64>,
}
