//! What the filter holds of a track, with hysteresis.

use crate::msg::TrackStatus;
use crate::time::MonoTime;

use super::state::{State, Target, at};

/// Frames a new track must be seen in before it is believed.
const FRAMES_TO_TRACK: u32 = 3;
/// Heading sigma below which a track settles, and above which it is in doubt again, rad.
const SETTLED_HEADING: (f64, f64) = (0.25, 0.8);
/// Speed sigma likewise, m/s.
const SETTLED_SPEED: (f64, f64) = (1.0, 2.5);
/// Not seen for no longer than this is still tracking: one frame missed is no event, s.
pub(super) const BLINK_S: f64 = 0.15;
/// A track not yet believed that is not seen for so long was none, s.
pub(super) const DOUBTFUL_S: f64 = 1.0;

/// A track just started.
pub(super) fn started(mean: [f64; at::TARGET], t: MonoTime) -> Target {
    Target { held: true, mean, status: TrackStatus::Acquiring, last_seen: t, seen: 1, rejected: 0 }
}

impl State {
    /// Status of target `i` in a frame that shows it.
    pub(super) fn settle(&mut self, i: usize) {
        let s = self.target_at(i);
        let heading = self.cov.at(s + 2, s + 2).max(0.0).sqrt();
        let speed = self.cov.at(s + 3, s + 3).max(0.0).sqrt();
        let target = &mut self.targets[i];
        let settled = heading < SETTLED_HEADING.0 && speed < SETTLED_SPEED.0;
        let doubtful = heading > SETTLED_HEADING.1 || speed > SETTLED_SPEED.1;
        let lasting = target.status == TrackStatus::Tracking || target.status == TrackStatus::Coasting;
        target.status = if target.seen >= FRAMES_TO_TRACK && (settled || (lasting && !doubtful)) {
            TrackStatus::Tracking
        } else {
            TrackStatus::Acquiring
        };
    }
}
