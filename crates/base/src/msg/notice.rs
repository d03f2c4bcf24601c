//! Notices: information about a flight for the operator.

use std::fmt;

use super::Source;
use crate::time::MonoTime;

/// The subject of a notice. Names are fixed: operators search logs for them.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum NoticeKind {
    /// The receiver has a position.
    FixAcquired,
    /// The receiver lost its position.
    FixLost,
    /// A source delivered nothing for longer than its time-out.
    SourceSilent,
    /// A silent source delivers again.
    SourceBack,
    /// Bytes of a source were refused (checksum, range, grammar).
    BytesRefused,
    /// A frame could not be decoded, or has the wrong size.
    FrameUnusable,
    /// Parts of a frame are lost; the others are used.
    FrameDamaged,
    /// Frames or bytes were lost before they could be recorded.
    Dropped,
    /// The origin of the NED frame is settled.
    DatumSet,
    /// Positions of the receiver cannot be used; the text gives the reason.
    PositionsUnused,
    /// The receiver's pulses arrive and are not used; the text gives the reason.
    PulseUnused,
    /// The terrain tile of the configuration cannot be used here: level ground is assumed instead.
    TerrainMissing,
    /// Declination was taken from the World Magnetic Model, or could not be.
    Declination,
    /// A target was found and its estimate has settled.
    TargetTracking,
    /// A target is out of sight; its state is predicted.
    TargetCoasting,
    /// A target is lost.
    TargetLost,
    /// The filter was reset.
    FilterReset,
    /// A stamp went back or jumped ahead.
    ClockJump,
    /// A measurement does not fit the configuration or the filter's model.
    ModelMisfit,
    /// The same marker was seen at two places of a frame.
    MarkerSeenTwice,
    /// It was found out what the compass's tilt sensor measures.
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

/// Information for the operator.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Notice {
    /// Its time, host time.
    pub t: MonoTime,
    /// Its kind.
    pub kind: NoticeKind,
    /// The source, where it concerns one.
    pub source: Option<Source>,
    /// Name of the target, where it concerns one.
    pub target: Option<String>,
    /// The text: what, where, how many.
    pub detail: String,
    /// The parts of a misfit.
    pub misfit: Option<MisfitWords>,
}

/// A misfit in the operator's terms.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct MisfitWords {
    /// The measurements, setting or marker that does not fit: `gps_velocity`, `compass.tilt`, `ugv tag 1`.
    pub source: String,
    /// A fixed name for the kind of misfit.
    pub kind: &'static str,
    /// The measured value with its unit.
    pub figure: String,
    /// The likely cause.
    pub cause: String,
    /// What the operator can do.
    pub advice: String,
}

impl fmt::Display for MisfitWords {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { source, figure, cause, advice, .. } = self;
        write!(f, "{source}: {cause} ({figure}); {advice}")
    }
}
