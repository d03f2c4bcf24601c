//! Notices: what an operator should know of a flight.

use std::fmt;

use super::Source;
use crate::time::MonoTime;

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
    /// Parts of a frame are lost; the others are used.
    FrameDamaged,
    /// Frames or bytes were lost before they could be recorded.
    Dropped,
    /// The origin of the NED frame was settled.
    DatumSet,
    /// Positions of the receiver cannot be used, and why.
    PositionsUnused,
    /// The receiver's pulses come and are not used, and why.
    PulseUnused,
    /// The terrain tile of the configuration cannot be used here: the ground is level instead.
    TerrainMissing,
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
    /// Something measured does not fit the configuration, or the filter's model.
    ModelMisfit,
    /// The same marker was seen at two places of a frame.
    MarkerSeenTwice,
    /// What the compass's tilt sensor feels was found out.
    TiltFelt,
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
            Self::FrameDamaged => "frame_damaged",
            Self::Dropped => "dropped",
            Self::DatumSet => "datum_set",
            Self::PositionsUnused => "positions_unused",
            Self::PulseUnused => "pulse_unused",
            Self::TerrainMissing => "terrain_missing",
            Self::Declination => "declination",
            Self::TargetTracking => "target_tracking",
            Self::TargetCoasting => "target_coasting",
            Self::TargetLost => "target_lost",
            Self::FilterReset => "filter_reset",
            Self::ClockJump => "clock_jump",
            Self::ModelMisfit => "model_misfit",
            Self::MarkerSeenTwice => "marker_seen_twice",
            Self::TiltFelt => "tilt_felt",
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
    /// Name of the target, where it is about one.
    pub target: Option<String>,
    /// In words: what, where, how many.
    pub detail: String,
    /// Of a misfit: its parts.
    pub misfit: Option<MisfitWords>,
}

/// What does not fit, in the operator's words.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct MisfitWords {
    /// The measurements, setting or marker that does not fit: `gps_velocity`, `compass.tilt`, `ugv tag 1`.
    pub source: String,
    /// A fixed name for what does not fit.
    pub kind: &'static str,
    /// The figure that shows it, with its unit.
    pub figure: String,
    /// The likely cause.
    pub cause: String,
    /// What to do.
    pub advice: String,
}

impl fmt::Display for MisfitWords {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { source, figure, cause, advice, .. } = self;
        write!(f, "{source}: {cause} ({figure}); {advice}")
    }
}
