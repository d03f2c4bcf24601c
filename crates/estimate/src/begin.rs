//! Where a track begins, and where it goes on after it was out of sight: off its markers in one frame.

use nalgebra::{Vector2, Vector3};

use windhover_base::geo::{locate, wrap_angle};
use windhover_base::msg::{Disposition, FusionSource, MarkerDetection, TrackStatus};
use windhover_base::settings::TargetModel;

use super::core::Core;
use super::learn::MOVING;
use super::models::{Marker, Models};
use super::state::{GUESSED_VAR, Own, Target, at};
use super::track::{BLINK_S, started, started_again};

impl Core {
    /// Starts a target from the markers of one frame: where they lie on the ground, with a wide
    /// prior that the same pixels then narrow, so that everything common with the helicopter's own
    /// errors stands in the covariance.
    pub(super) fn start_target(&mut self, index: usize, markers: &[MarkerDetection], before: Option<Target>) {
        let Some((mean, heading_known)) = guess(&self.state.own, &self.models, index, markers) else {
            self.refuse(FusionSource::Marker, Disposition::Invalid);
            return;
        };
        let start = self.state.target_at(index);
        let moving = self.models.targets[index].model != TargetModel::Static;
        let t = self.state.t;
        self.state.targets[index] = match before {
            Some(before) if moving => started_again(mean, t, &before),
            Some(before) => Target { seen: before.seen + 1, ..started(mean, t) },
            None => started(mean, t),
        };
        self.state.learnt.target_q[index] = self.learning.start.target_q[index];
        let heading_var = if heading_known { 1.0 } else { UNKNOWN_HEADING.powi(2) };
        let (speed_var, rate_var) = if moving { (9.0, 1.0) } else { (0.0, 0.0) };
        self.state.renew(start, &[GUESSED_VAR, GUESSED_VAR, heading_var, speed_var, rate_var]);
        self.fuse_first(index, markers);
        self.state.settle(index);
    }

    /// Whether a believed track comes back into view with a heading too uncertain to linearise about.
    pub(super) fn is_back_in_doubt(&self, index: usize) -> bool {
        let (target, heading) = (&self.state.targets[index], self.state.target_at(index) + 2);
        let away_s = (self.state.t - target.last_seen).s();
        target.status != TrackStatus::Acquiring
            && away_s > BLINK_S
            && self.state.cov.at(heading, heading) > DOUBTFUL_HEADING.powi(2)
    }

    /// A track that comes back elsewhere than expected, or as if from nowhere: place and heading are what its
    /// markers show, while speed and yaw rate are still about what they were. `false` where they show no heading.
    pub(super) fn place_anew(&mut self, index: usize, markers: &[MarkerDetection]) -> bool {
        let before = self.state.targets[index];
        let Some((mut mean, true)) = guess(&self.state.own, &self.models, index, markers) else {
            return false;
        };
        mean[3..].copy_from_slice(&before.mean[3..]);
        let (s, t) = (self.state.target_at(index), self.state.t);
        let motion: [f64; 2] = std::array::from_fn(|k| {
            self.state.cov.at(s + 3 + k, s + 3 + k) + ANEW_S * self.models.target_walks[k]
        });
        self.state.targets[index] = Target {
            mean,
            placed_anew: true,
            rejected: 0,
            last_seen: t,
            started: t,
            motion: MOVING,
            ..before
        };
        self.state.learnt.target_q[index] = self.learning.start.target_q[index];
        self.state.renew(s, &[GUESSED_VAR, GUESSED_VAR, 1.0, motion[0], motion[1]]);
        self.fuse_first(index, markers);
        self.state.settle(index);
        true
    }

    /// Fuses what a new prior was guessed from: the first marker as it is, the others through the gate, since one that
    /// was found elsewhere than it is would bend the helicopter's attitude to make the two agree.
    fn fuse_first(&mut self, index: usize, markers: &[MarkerDetection]) {
        let mut gated = false;
        for detection in markers {
            if let Some((t, marker)) = self.models.find(detection.marker)
                && t == index
            {
                self.fuse_marker(index, marker, detection, gated);
                gated = true;
            }
        }
    }
}

/// How long a track that is placed anew may have driven as configured since its motion was known, s.
const ANEW_S: f64 = 1.0;
/// Heading sigma beyond which an update linearised about it is worth nothing, rad.
const DOUBTFUL_HEADING: f64 = 0.3;
/// Heading quite unknown, one sigma of a uniform circle, rad.
const UNKNOWN_HEADING: f64 = 1.8;
/// Farthest that a ray is followed to the ground, m.
const FARTHEST_M: f64 = 1_000.0;

/// The ground point `above_m` over the ground seen at a pixel.
pub(super) fn ground_point(
    own: &Own,
    models: &Models,
    px: Vector2<f64>,
    above_m: f64,
) -> Option<Vector3<f64>> {
    let ned_from_camera =
        own.ned_from_body * nalgebra::Rotation3::from_matrix_unchecked(models.camera_from_body.transpose());
    let camera = own.position + own.ned_from_body * models.camera_at;
    locate(&models.camera, &camera, &ned_from_camera, px, &models.ground, above_m, FARTHEST_M)
        .ok()
        .map(|found| found.ned_m)
}

/// First guess of a target from one frame: (state, whether the heading is known).
fn guess(
    own: &Own,
    models: &Models,
    index: usize,
    markers: &[MarkerDetection],
) -> Option<([f64; at::TARGET], bool)> {
    let target = &models.targets[index];
    let mut first = None;
    let mut heading = None;
    for seen in markers {
        let Some(marker) = target.markers.iter().find(|marker| marker.id == seen.marker) else { continue };
        let Some(place) = ground_point(own, models, seen.center_px, -marker.center.z) else { continue };
        if let (None, Some(corners)) = (heading, &seen.corners_px) {
            let point = |k: usize| ground_point(own, models, corners[k], -marker.center.z);
            let up = point(0)? + point(1)? - point(2)? - point(3)?;
            heading = Some(wrap_angle(up.y.atan2(up.x) - marker.yaw));
        }
        let Some((other, there)) = first else {
            first = Some((marker, place));
            continue;
        };
        let (apart, along): (Vector3<f64>, Vector3<f64>) = (place - there, marker.center - other.center);
        if along.xy().norm() > 1e-3 {
            heading = heading.or(Some(wrap_angle(apart.y.atan2(apart.x) - along.y.atan2(along.x))));
        }
    }
    let (marker, place): (&Marker, Vector3<f64>) = first?;
    let (s, c) = heading.unwrap_or(0.0).sin_cos();
    let offset = marker.center;
    let north = place.x - (c * offset.x - s * offset.y);
    let east = place.y - (s * offset.x + c * offset.y);
    Some(([north, east, heading.unwrap_or(0.0), 0.0, 0.0], heading.is_some()))
}
