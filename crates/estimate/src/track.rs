//! What the filter holds of a track, with hysteresis.

use windhover_base::msg::TrackStatus;
use windhover_base::time::MonoTime;

use super::learn::MOVING;
use super::state::{State, Target, at};

/// Frames a new track must be seen in before it is believed.
const FRAMES_TO_TRACK: u32 = FRAMES_TO_START + 2;
/// Heading sigma below which a track settles, and above which it is in doubt again, rad.
const SETTLED_HEADING: (f64, f64) = (0.25, 0.8);
/// Speed sigma likewise, m/s.
const SETTLED_SPEED: (f64, f64) = (1.0, 2.5);
/// Not seen for no longer than this is still tracking: one frame missed is no event, s.
pub(super) const BLINK_S: f64 = 0.15;
/// A track not yet believed that is not seen for so long was none, s.
pub(super) const DOUBTFUL_S: f64 = 1.0;

/// Frames at first, each of which starts the track afresh: only then is its speed known well enough
/// to linearise about. A speed taken as zero would forbid the sideways motion that a heading not yet
/// known gives to a moving vehicle, and pass that off as knowledge of heading.
pub(super) const FRAMES_TO_START: u32 = 6;

/// A track just started.
pub(super) fn started(mean: [f64; at::TARGET], t: MonoTime) -> Target {
    let first_seen = (t, [mean[0], mean[1]]);
    Target {
        held: true,
        mean,
        status: TrackStatus::Acquiring,
        last_seen: t,
        seen: 1,
        rejected: 0,
        motion: MOVING,
        placed_anew: false,
        memory_s: [0.0; 2],
        fitted_memory_s: [0.0; 2],
        started: t,
        first_seen,
    }
}

/// The same track started afresh with its speed along the heading since it was first seen.
pub(super) fn started_again(mut mean: [f64; at::TARGET], t: MonoTime, before: &Target) -> Target {
    let (first, place) = before.first_seen;
    let elapsed_s = (t - first).s();
    if elapsed_s > 0.01 {
        let (s, c) = mean[2].sin_cos();
        mean[3] = ((mean[0] - place[0]) * c + (mean[1] - place[1]) * s) / elapsed_s;
    }
    Target { mean, seen: before.seen + 1, first_seen: before.first_seen, ..started(mean, t) }
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
