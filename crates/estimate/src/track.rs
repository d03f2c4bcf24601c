//! A track's life: from a target never seen to one that is tracked, out of sight, and lost.
//!
//! | from | what happens | to |
//! |---|---|---|
//! | any | the filter starts ([`State::clear`](super::state::State::clear)) | unknown |
//! | unknown, lost | its markers are seen | started (1 frame) |
//! | started | seen again: started afresh, speed from where it was first seen | started (one more), acquiring from the sixth |
//! | acquiring | accepted, in the eighth frame or later, and settled | tracking |
//! | started, acquiring (never tracked) | not seen for a second | the same, missing: reported as lost |
//! | started, acquiring, missing | seen | the same, not missing |
//! | tracking, coasting | fused, and in doubt ([`Certainty::Doubtful`]) | acquiring |
//! | tracking | not seen for longer than a blink | coasting |
//! | coasting | accepted, not in doubt | tracking |
//! | coasting | seen, all markers outside the gate | placed anew at once |
//! | any held | not seen for `lost_after_s` (never of a target that cannot move) | lost |
//! | acquiring, tracking, coasting | refused: all markers outside the gate | the same, counted |
//! | acquiring | refused twice in a row | started anew (1 frame) |
//! | tracking, coasting | refused too often in a row ([`Life::verdict`]) | placed anew: coasting, unconfirmed |
//! | placed anew | refused twice in a row | started anew (1 frame) |
//! | placed anew | accepted | confirmed |
//!
//! A track whose heading has become doubtful out of sight is placed anew at once when it is seen
//! ([`Life::on_sight`]). Whether a vehicle stands is another matter: `standstill.rs`.

use windhover_base::msg::TrackStatus;
use windhover_base::time::{MonoTime, Span};

/// Frames at first, each of which starts the track afresh: only then is its speed known well enough
/// to linearise about. A speed taken as zero would forbid the sideways motion that a heading not yet
/// known gives to a moving vehicle, and pass that off as knowledge of heading.
const FRAMES_TO_START: u32 = 6;
/// Number of frames in which a new track must be seen before it is confirmed.
const FRAMES_TO_TRACK: u32 = FRAMES_TO_START + 2;
/// Frame count of a confirmed track that is in doubt: out of sight it is not dropped like one that was never confirmed.
const BELIEVED_BEFORE: u32 = FRAMES_TO_TRACK + 1;
/// Frames in a row outside the gate after which a track that is not confirmed is given up.
const DOUBTED_REFUSALS: u32 = 2;
/// Heading sigma below which a track settles, and above which it is in doubt again, rad.
const SETTLED_HEADING: (f64, f64) = (0.25, 0.8);
/// Speed sigma likewise, m/s.
const SETTLED_SPEED: (f64, f64) = (1.0, 2.5);
/// Not seen for no longer than this is still tracking: one frame missed is no event, s.
pub(crate) const BLINK_S: f64 = 0.15;
/// A track that is not confirmed and not seen for this long is dropped, s.
const MISSING_S: f64 = 1.0;

/// When and where (north, east) a track was first seen.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Sighting {
    pub(crate) t: MonoTime,
    pub(crate) place: [f64; 2],
}

/// Results of the latest frames for a track that is fused.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(crate) struct Evidence {
    /// Frames in a row in which its markers lay outside the gate.
    refused: u32,
    /// Whether its place was read off its markers anew, and nothing has confirmed it since.
    unconfirmed: bool,
}

/// Where a track is in its life.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) enum Life {
    /// Not seen since the filter started.
    #[default]
    Unknown,
    /// Started afresh by each frame that shows it.
    Started { frames: u32, first: Sighting, missing: bool },
    /// Fused, not yet (or no longer) confirmed.
    Acquiring { frames: u32, evidence: Evidence, missing: bool },
    /// Believed, and seen but a moment ago.
    Tracking(Evidence),
    /// Believed, and predicted out of sight.
    Coasting(Evidence),
    /// Out of sight for too long: its prediction is no longer an estimate.
    Lost,
}

/// What a frame that shows a track does with it.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) enum OnSight {
    /// Starts it, as one never seen.
    Start,
    /// Starts it afresh, as the track first seen then and there.
    StartAgain(Sighting),
    /// Reads its place off its markers, or fuses them where they show no heading.
    PlaceAnew,
    /// It comes back: the same where all of its markers lie outside the gate, before any of them is fused.
    Return,
    /// Fuses its markers.
    Fuse,
}

/// What becomes of a track whose markers were all refused.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Verdict {
    /// It goes on.
    Keep,
    /// It is elsewhere: its place is read off its markers, or it is started where they show no heading.
    PlaceAnew,
    /// It is started as one never seen.
    Start,
}

/// How well heading and speed of a track are known.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Certainty {
    Settled,
    Between,
    Doubtful,
}

impl Certainty {
    /// By the sigmas of heading (rad) and speed (m/s).
    pub(crate) fn of(heading: f64, speed: f64) -> Self {
        if heading < SETTLED_HEADING.0 && speed < SETTLED_SPEED.0 {
            Self::Settled
        } else if heading > SETTLED_HEADING.1 || speed > SETTLED_SPEED.1 {
            Self::Doubtful
        } else {
            Self::Between
        }
    }
}

/// What a frame knows of a track in addition to its state.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Circumstances {
    /// How long ago it was last seen.
    pub(crate) away: Span,
    /// For how long it may be out of sight; `None` of a target that cannot move.
    pub(crate) lost_after: Option<Span>,
    /// Whether its heading is too uncertain to linearise an update about.
    pub(crate) heading_doubtful: bool,
}

impl Circumstances {
    fn is_gone(&self) -> bool {
        self.lost_after.is_some_and(|limit| self.away > limit)
    }

    fn moves(&self) -> bool {
        self.lost_after.is_some()
    }
}

impl Life {
    /// A track just started by a frame.
    pub(crate) fn started(first: Sighting) -> Self {
        Self::Started { frames: 1, first, missing: false }
    }

    /// What is reported of it.
    pub(crate) fn status(self) -> TrackStatus {
        match self {
            Self::Started { missing: false, .. } | Self::Acquiring { missing: false, .. } => {
                TrackStatus::Acquiring
            }
            Self::Tracking(_) => TrackStatus::Tracking,
            Self::Coasting(_) => TrackStatus::Coasting,
            Self::Unknown | Self::Started { .. } | Self::Acquiring { .. } | Self::Lost => TrackStatus::Lost,
        }
    }

    /// Whether the filter's state has a place for it, reported or not.
    pub(crate) fn is_held(self) -> bool {
        self != Self::Unknown
    }

    /// When it was first seen, where that still counts.
    pub(crate) fn first_mut(&mut self) -> Option<&mut Sighting> {
        match self {
            Self::Started { first, .. } => Some(first),
            _ => None,
        }
    }

    /// A frame does not show it.
    pub(crate) fn unseen(self, now: &Circumstances) -> Self {
        match self {
            Self::Unknown => self,
            _ if now.is_gone() => Self::Lost,
            Self::Started { frames, first, missing } => {
                Self::Started { frames, first, missing: missing || now.away.s() > MISSING_S }
            }
            Self::Acquiring { frames: BELIEVED_BEFORE, .. } => self,
            Self::Acquiring { frames, evidence, missing } => {
                Self::Acquiring { frames, evidence, missing: missing || now.away.s() > MISSING_S }
            }
            Self::Tracking(evidence) if now.away.s() > BLINK_S => Self::Coasting(evidence),
            Self::Tracking(_) | Self::Coasting(_) | Self::Lost => self,
        }
    }

    /// A frame shows it: what is to be done.
    pub(crate) fn on_sight(self, now: &Circumstances) -> OnSight {
        let back_in_doubt = now.moves() && now.heading_doubtful && now.away.s() > BLINK_S;
        match self {
            Self::Unknown | Self::Lost => OnSight::Start,
            _ if now.is_gone() => OnSight::Start,
            Self::Started { first, .. } => OnSight::StartAgain(first),
            Self::Acquiring { frames, missing: false, .. } if frames < BELIEVED_BEFORE => OnSight::Fuse,
            Self::Acquiring { .. } | Self::Tracking(_) | Self::Coasting(_) if back_in_doubt => {
                OnSight::PlaceAnew
            }
            Self::Coasting(_) if now.moves() => OnSight::Return,
            Self::Acquiring { .. } | Self::Tracking(_) | Self::Coasting(_) => OnSight::Fuse,
        }
    }

    /// It was started afresh, as the track first seen then and there.
    pub(crate) fn started_again(self, first: Sighting) -> Self {
        let frames = match self {
            Self::Started { frames, .. } => frames + 1,
            _ => 1,
        };
        if frames < FRAMES_TO_START {
            Self::Started { frames, first, missing: false }
        } else {
            Self::Acquiring { frames, evidence: Evidence::default(), missing: false }
        }
    }

    /// One of its markers was inside the gate.
    pub(crate) fn accepted(self) -> Self {
        match self {
            Self::Acquiring { frames, missing, .. } => Self::Acquiring {
                frames: frames.max((frames + 1).min(FRAMES_TO_TRACK)),
                evidence: Evidence::default(),
                missing,
            },
            _ => self.with_evidence(|_| Evidence::default()),
        }
    }

    /// All of its markers were outside the gate.
    pub(crate) fn refused(self) -> Self {
        self.with_evidence(|evidence| Evidence { refused: evidence.refused + 1, ..evidence })
    }

    /// Its place was read off its markers anew. Until one of them is accepted it is not tracked.
    pub(crate) fn placed_anew(self) -> Self {
        let placed = self.with_evidence(|_| Evidence { refused: 0, unconfirmed: true });
        match placed {
            Self::Tracking(evidence) => Self::Coasting(evidence),
            _ => placed,
        }
    }

    /// Frames in a row in which all of its markers were outside the gate.
    pub(crate) fn refusals(self) -> u32 {
        self.evidence().refused
    }

    /// After a refusal: a confirmed track is moved after `restart_after` frames in a row, any other given up sooner.
    pub(crate) fn verdict(self, restart_after: u32, moves: bool) -> Verdict {
        let Evidence { refused, unconfirmed } = self.evidence();
        let believed = matches!(self, Self::Tracking(_));
        if refused < if believed { restart_after } else { DOUBTED_REFUSALS } {
            return Verdict::Keep;
        }
        match self {
            Self::Acquiring { missing: false, .. } => Verdict::Start,
            _ if unconfirmed || !moves => Verdict::Start,
            _ => Verdict::PlaceAnew,
        }
    }

    /// It was fused, or started, in a frame that shows it.
    pub(crate) fn settled(self, certainty: Certainty) -> Self {
        match (self, certainty) {
            (Self::Started { frames, first, .. }, _) => Self::Started { frames, first, missing: false },
            (Self::Acquiring { frames, evidence, .. }, Certainty::Settled) if frames >= FRAMES_TO_TRACK => {
                Self::Tracking(evidence)
            }
            (Self::Acquiring { frames, evidence, .. }, _) => {
                Self::Acquiring { frames, evidence, missing: false }
            }
            (Self::Tracking(evidence) | Self::Coasting(evidence), Certainty::Doubtful) => {
                Self::Acquiring { frames: BELIEVED_BEFORE, evidence, missing: false }
            }
            (Self::Coasting(evidence), _) if evidence.unconfirmed || evidence.refused > 0 => self,
            (Self::Tracking(evidence) | Self::Coasting(evidence), _) => Self::Tracking(evidence),
            (Self::Unknown | Self::Lost, _) => self,
        }
    }

    fn evidence(self) -> Evidence {
        match self {
            Self::Acquiring { evidence, .. } | Self::Tracking(evidence) | Self::Coasting(evidence) => {
                evidence
            }
            Self::Unknown | Self::Started { .. } | Self::Lost => Evidence::default(),
        }
    }

    fn with_evidence(mut self, change: impl Fn(Evidence) -> Evidence) -> Self {
        if let Self::Acquiring { evidence, .. } | Self::Tracking(evidence) | Self::Coasting(evidence) =
            &mut self
        {
            *evidence = change(*evidence);
        }
        self
    }
}

#[cfg(test)]
mod tests;
