//! The same marker in two places of one frame: another vehicle carries a copy of a target's tag.
//!
//! The one nearest to where the target should be is the target's. The other's place is remembered, so that a frame that
//! shows only the copy does not draw the track over to it.

use nalgebra::Vector2;

use windhover_base::msg::MarkerDetection;
use windhover_base::time::{MonoTime, Span};

use super::aid::pixel::{target_point, view};
use super::begin::{ground_point, guess};
use super::blocks::TARGET;
use super::core::Core;
use super::track::Life;

/// For how long a copy that is no longer seen is reckoned with.
const REMEMBERED: Span = Span::from_ns(10_000_000_000);
/// Nearer than this to where it should be a marker is the target's, m.
const NEAR_M: f64 = 1.5;

/// Where a copy of one of a target's markers was last seen.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Twin {
    t: MonoTime,
    /// North, east, m.
    pub(crate) place: [f64; 2],
}

impl Core {
    /// The markers of a frame that are of a target, each once, into a recycled list.
    pub(crate) fn choose_markers(&mut self, markers: &[MarkerDetection], chosen: &mut Vec<MarkerDetection>) {
        chosen.clear();
        for (k, seen) in markers.iter().enumerate() {
            let Some((target, marker)) = self.models.find(seen.marker) else { continue };
            if markers[..k].iter().any(|before| before.marker == seen.marker) {
                continue;
            }
            let alike = || markers.iter().filter(|other| other.marker == seen.marker);
            if alike().count() == 1 {
                if !self.is_the_copy(target, marker, seen) {
                    chosen.push(*seen);
                }
                continue;
            }
            let expected = self.expected_px(target, marker, markers);
            let off = |d: &&MarkerDetection| expected.map_or(0.0, |px| (d.center_px - px).norm());
            let Some(nearest) = alike().min_by(|a, b| off(a).total_cmp(&off(b))) else { continue };
            chosen.push(*nearest);
            let other = alike().find(|other| other.center_px != nearest.center_px);
            if let Some(place) = other.and_then(|other| self.ground_place(target, marker, other)) {
                self.state.targets[target].twin = Some(Twin { t: self.state.t, place });
            }
        }
    }

    /// Whether a marker seen once lies where its copy was rather than where the target should be.
    fn is_the_copy(&mut self, target: usize, marker: usize, seen: &MarkerDetection) -> bool {
        let track = self.state.targets[target];
        let Some(twin) = track.twin.filter(|twin| self.state.t - twin.t <= REMEMBERED) else { return false };
        if matches!(track.life, Life::Unknown | Life::Lost) {
            return false;
        }
        let Some(place) = self.ground_place(target, marker, seen) else { return false };
        let point = &self.models.targets[target].markers[marker].center;
        let (due, _) = target_point(&track.mean, &self.models, point);
        let off = |from: [f64; 2]| (place[0] - from[0]).hypot(place[1] - from[1]);
        let (own_m, twin_m) = (off([due.x, due.y]), off(twin.place));
        let copy = own_m > NEAR_M && twin_m < own_m;
        if copy {
            self.state.targets[target].twin = Some(Twin { t: self.state.t, place });
        }
        copy
    }

    /// Where a marker should be seen: by its track, or by the first marker in the frame that shows the target's heading.
    fn expected_px(&self, target: usize, marker: usize, markers: &[MarkerDetection]) -> Option<Vector2<f64>> {
        let track = &self.state.targets[target];
        let mean: [f64; TARGET] = if matches!(track.life, Life::Unknown | Life::Lost) {
            let of_target =
                |d: &&MarkerDetection| self.models.find(d.marker).is_some_and(|(t, _)| t == target);
            let first = markers.iter().find(|d| of_target(d) && d.corners_px.is_some())?;
            guess(&self.state.own, &self.models, target, std::slice::from_ref(first))?.0
        } else {
            track.mean
        };
        let (world, _) =
            target_point(&mean, &self.models, &self.models.targets[target].markers[marker].center);
        view(&self.state.own, &self.models, &world).map(|seen| seen.px)
    }

    fn ground_place(&self, target: usize, marker: usize, seen: &MarkerDetection) -> Option<[f64; 2]> {
        let above_m = -self.models.targets[target].markers[marker].center.z;
        ground_point(&self.state.own, &self.models, seen.center_px, above_m).map(|place| [place.x, place.y])
    }
}
