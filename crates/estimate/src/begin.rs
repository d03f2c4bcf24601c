//! Where a track begins, and where it goes on after it was out of sight: off its markers in one frame.

use nalgebra::{Vector2, Vector3};

use windhover_base::geo::{locate, wrap_angle};
use windhover_base::msg::{Disposition, FusionSource, MarkerDetection};
use windhover_base::time::MonoTime;

use super::blocks::TARGET;
use super::core::Core;
use super::models::{Marker, Models};
use super::own::Own;
use super::standstill::Standstill;
use super::state::{GUESSED_VAR, State, Target};
use super::sway::Sway;
use super::track::{Certainty, Circumstances, Life, Sighting};

impl Core {
    /// Starts a target from the markers of one frame: where they lie on the ground, with a wide
    /// prior that the same pixels then narrow, so that everything common with the helicopter's own
    /// errors stands in the covariance. One first seen before this frame is the same track, with its speed along the
    /// heading since then.
    pub(crate) fn start_target(
        &mut self,
        index: usize,
        markers: &[MarkerDetection],
        first: Option<Sighting>,
    ) {
        let Some((mut mean, heading_known)) = guess(&self.state.own, &self.models, index, markers) else {
            self.refuse(FusionSource::Marker, Disposition::Invalid);
            return;
        };
        let (t, moves) = (self.state.t, self.models.targets[index].moves());
        let target = &mut self.state.targets[index];
        let life = match first {
            Some(first) => target.life.started_again(first),
            None => Life::started(Sighting { t, place: [mean[0], mean[1]] }),
        };
        if let Some(first) = first.filter(|_| moves) {
            mean[3] = speed_since(&first, &mean, t).unwrap_or(mean[3]);
        }
        *target = Target {
            mean,
            life,
            twin: target.twin,
            spin: target.spin,
            last_seen: t,
            tied_since: t,
            standstill: Standstill::MOVES,
            sway: if moves { Sway::presumed() } else { Sway::default() },
            ..Target::default()
        };
        self.state.learnt.target_q[index] = self.learning.start.target_q[index];
        let heading_var = if heading_known { 1.0 } else { UNKNOWN_HEADING.powi(2) };
        let [speed_var, rate_var] = if moves { START_MOTION_VAR } else { [0.0; 2] };
        let block = self.state.layout().target(index).all();
        self.state.renew(block, &[GUESSED_VAR, GUESSED_VAR, heading_var, speed_var, rate_var]);
        self.state.renew_sway(index, &self.models);
        self.fuse_first(index, markers);
        self.state.settle(index);
    }

    /// What a frame knows of a track beside its life.
    pub(crate) fn circumstances(&self, index: usize) -> Circumstances {
        let heading = self.state.layout().target(index).heading();
        Circumstances {
            away: self.state.t - self.state.targets[index].last_seen,
            // A marker that cannot move is where it was, however long nobody looked.
            lost_after: self.models.targets[index].moves().then_some(self.lost_after),
            heading_doubtful: self.state.cov.var(heading) > DOUBTFUL_HEADING.powi(2),
        }
    }

    /// A track that comes back elsewhere than expected, or as if from nowhere: place and heading are what its
    /// markers show, while speed and yaw rate are still about what they were. `false` where they show no heading.
    pub(crate) fn place_anew(&mut self, index: usize, markers: &[MarkerDetection]) -> bool {
        let before = self.state.targets[index];
        let Some((mut mean, true)) = guess(&self.state.own, &self.models, index, markers) else {
            return false;
        };
        mean[3..].copy_from_slice(&before.mean[3..]);
        let (block, t) = (self.state.layout().target(index), self.state.t);
        let motion: [f64; 2] = std::array::from_fn(|k| {
            let column = block.motion().column(k);
            self.state.cov.at(column, column) + ANEW_S * self.models.target_walks[k]
        });
        self.state.targets[index] = Target {
            mean,
            life: before.life.placed_anew(),
            last_seen: t,
            tied_since: t,
            standstill: Standstill::MOVES,
            ..before
        };
        self.state.learnt.target_q[index] = self.learning.start.target_q[index];
        self.state.renew(block.all(), &[GUESSED_VAR, GUESSED_VAR, 1.0, motion[0], motion[1]]);
        self.state.renew_sway(index, &self.models);
        self.fuse_first(index, markers);
        self.state.settle(index);
        true
    }

    /// Fuses what a new prior was guessed from: the first marker as it is, the others through the gate, since one that
    /// was found elsewhere than it is would bend the helicopter's attitude to make the two agree.
    fn fuse_first(&mut self, index: usize, markers: &[MarkerDetection]) {
        let mut first = None;
        for detection in markers {
            if let Some((target, marker)) = self.models.find(detection.marker)
                && target == index
            {
                if let Some(first) = first {
                    self.judge_size(index, first, detection);
                    let inside = self.fuse_marker(index, marker, detection, true);
                    self.judge_tag(index, marker, inside);
                } else {
                    self.fuse_first_marker(index, marker, detection);
                }
                first = first.or(Some(detection));
            }
        }
    }
}

impl State {
    /// What target `i` is after it was fused or started in a frame that shows it.
    pub(crate) fn settle(&mut self, i: usize) {
        let block = self.layout().target(i);
        let certainty = Certainty::of(self.cov.sigma(block.heading(), 0), self.cov.sigma(block.speed(), 0));
        self.targets[i].life = self.targets[i].life.settled(certainty);
    }
}

/// Speed along the heading since a track was first seen; `None` where that is but a moment ago.
fn speed_since(first: &Sighting, mean: &[f64; TARGET], t: MonoTime) -> Option<f64> {
    let elapsed_s = (t - first.t).s();
    let (s, c) = mean[2].sin_cos();
    let along = (mean[0] - first.place[0]) * c + (mean[1] - first.place[1]) * s;
    (elapsed_s > 0.01).then(|| along / elapsed_s)
}

/// Variances of speed and yaw rate at the start.
const START_MOTION_VAR: [f64; 2] = [9.0, 1.0];
/// How long a track that is placed anew may have driven as configured since its motion was known, s.
const ANEW_S: f64 = 1.0;
/// Heading sigma beyond which an update linearised about it does not hold, rad.
const DOUBTFUL_HEADING: f64 = 0.3;
/// Heading quite unknown, one sigma of a uniform circle, rad.
const UNKNOWN_HEADING: f64 = 1.8;
/// Farthest that a ray is followed to the ground, m.
const FARTHEST_M: f64 = 1_000.0;

/// The ground point `above_m` over the ground seen at a pixel.
pub(crate) fn ground_point(
    own: &Own,
    models: &Models,
    px: Vector2<f64>,
    above_m: f64,
) -> Option<Vector3<f64>> {
    let ned_from_camera =
        own.ned_from_body * nalgebra::Rotation3::from_matrix_unchecked(models.camera_from_body.transpose());
    let camera = own.position + own.ned_from_body * models.camera_at;
    locate(&models.lens(own), &camera, &ned_from_camera, px, &models.ground, above_m, FARTHEST_M)
        .ok()
        .map(|found| found.ned_m)
}

/// First guess of a target from one frame: (state, whether the heading is known).
pub(crate) fn guess(
    own: &Own,
    models: &Models,
    index: usize,
    markers: &[MarkerDetection],
) -> Option<([f64; TARGET], bool)> {
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
