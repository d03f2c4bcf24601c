//! A frame: markers on vehicles and ground features, as raw pixels through the whole camera model.

use nalgebra::{Matrix2, Matrix2x3, Vector2, Vector3};

use windhover_base::geo::skew;
use windhover_base::msg::{
    Disposition, FeatureTrack, FrameObservations, FusionSource, MarkerDetection, TrackStatus,
};
use windhover_base::settings::TargetModel;

use super::begin::ground_point;
use super::core::Core;
use super::learn::{LEARN_RATIO, PIXEL_FACTORS, blend_factor};
use super::models::Models;
use super::shape;
use super::state::{GUESSED_VAR, Own, State, Target, at};
use super::track::{BLINK_S, FRAMES_TO_START};
use super::update::{Measurement, REFUSE_RATIO};

/// A point of the world in the image, with its derivatives.
pub(super) struct PointView {
    pub(super) px: Vector2<f64>,
    /// ∂px/∂(point in NED).
    pub(super) d_point: Matrix2x3<f64>,
    /// ∂px/∂(attitude error).
    pub(super) d_attitude: Matrix2x3<f64>,
}

/// Projects a point given in NED.
pub(super) fn view(own: &Own, models: &Models, point: &Vector3<f64>) -> Option<PointView> {
    let from_us = point - own.position;
    let camera_from_ned = models.camera_from_body * own.rotation().transpose();
    let in_camera = camera_from_ned * from_us - models.camera_from_body * models.camera_at;
    let seen = models.camera.project(&in_camera)?;
    let d_point = seen.d_point * camera_from_ned;
    Some(PointView { px: seen.px, d_point, d_attitude: d_point * skew(&from_us) })
}

/// A point of a target in NED, and ∂point/∂(north, east, heading).
pub(super) fn target_point(
    mean: &[f64; at::TARGET],
    models: &Models,
    point: &Vector3<f64>,
) -> (Vector3<f64>, [Vector3<f64>; 3]) {
    let [north, east, heading, ..] = *mean;
    let (s, c) = heading.sin_cos();
    let [slope_n, slope_e] = models.ground.slope(north, east);
    let down = models.ground.down_m(north, east);
    let turned = Vector3::new(c * point.x - s * point.y, s * point.x + c * point.y, point.z);
    let derivatives = [
        Vector3::new(1.0, 0.0, slope_n),
        Vector3::new(0.0, 1.0, slope_e),
        Vector3::new(-turned.y, turned.x, 0.0),
    ];
    (turned + Vector3::new(north, east, down), derivatives)
}

impl Core {
    /// Fuses a frame's markers, then its ground features.
    pub(super) fn fuse_frame(&mut self, frame: &FrameObservations) {
        self.fuse_features(&frame.features);
        for target in 0..self.state.targets.len() {
            self.fuse_target(target, &frame.markers);
        }
        for detection in &frame.markers {
            if self.models.find(detection.marker).is_none() {
                self.refuse(FusionSource::Marker, Disposition::Unknown);
            }
        }
        self.state.learn_targets(&self.learning);
        self.state.echo_targets(frame.frame, self.keep_copies);
    }

    fn fuse_target(&mut self, index: usize, markers: &[MarkerDetection]) {
        let mine = |d: &&MarkerDetection| self.models.find(d.marker).is_some_and(|(t, _)| t == index);
        let count = markers.iter().filter(mine).count();
        let t = self.state.t;
        let target = &self.state.targets[index];
        // A marker at rest is where it was, however long nobody looked.
        let rests = self.models.targets[index].model == TargetModel::Static;
        let lost_after = (!rests).then_some(self.lost_after);
        let away = target.held && lost_after.is_some_and(|limit| t - target.last_seen > limit);
        if count == 0 {
            self.state.targets[index].unseen(t, lost_after);
            return;
        }
        if !target.held || away || target.seen < FRAMES_TO_START {
            let before = target.held.then_some(*target).filter(|_| !away);
            self.start_target(index, markers, before);
            return;
        }
        if !rests && self.is_back_in_doubt(index) && self.place_anew(index, markers) {
            return;
        }
        let mut good = 0;
        for detection in markers {
            if let Some((t, marker)) = self.models.find(detection.marker)
                && t == index
            {
                good += usize::from(self.fuse_marker(index, marker, detection, true));
            }
        }
        let restart_after = self.restart_after;
        let target = &mut self.state.targets[index];
        if good > 0 {
            target.rejected = 0;
            target.placed_anew = false;
            target.seen = target.seen.saturating_add(1);
            target.last_seen = t;
        } else {
            target.rejected += 1;
            let believed = target.status == TrackStatus::Tracking && !target.placed_anew;
            if target.rejected >= if believed { restart_after } else { 2 } {
                let hopeless = rests || target.placed_anew || target.status == TrackStatus::Acquiring;
                if hopeless || !self.place_anew(index, markers) {
                    self.start_target(index, markers, None);
                }
                return;
            }
            self.state.wake(&self.learning, index);
        }
        self.state.settle(index);
    }

    /// Fuses one marker: a tag's four corners at once, or a disc's centre. Whether it was inside the
    /// gate.
    pub(super) fn fuse_marker(
        &mut self,
        index: usize,
        marker: usize,
        seen: &MarkerDetection,
        gated: bool,
    ) -> bool {
        let start = self.state.target_at(index);
        let mean = self.state.targets[index].mean;
        let model = &self.models.targets[index].markers[marker];
        let curvature = self.curvature_px2();
        let factor = self.state.learnt.marker_factor[index];
        let points: &[Vector3<f64>] = match (&model.corners, &seen.corners_px) {
            (Some(corners), Some(_)) => corners,
            _ => std::slice::from_ref(&model.center),
        };
        self.z.begin(2 * points.len());
        let position = self.z.columns(at::POSITION, 3);
        let attitude = self.z.columns(at::ATTITUDE, 3);
        let pose = self.z.columns(start, 3);
        for (i, point) in points.iter().enumerate() {
            let (world, derivatives) = target_point(&mean, &self.models, point);
            let Some(view) = view(&self.state.own, &self.models, &world) else {
                self.refuse(FusionSource::Marker, Disposition::Invalid);
                return false;
            };
            let (px, covariance) = match (points.len(), &seen.corners_px) {
                (4, Some(corners)) => (corners[i], seen.corner_cov_px2[i]),
                _ => (seen.center_px, seen.center_cov_px2),
            };
            let known = covariance + Matrix2::identity() * self.models.marker_var_px2;
            let noise = known * factor + Matrix2::identity() * curvature;
            set_point(&mut self.z, i, &(px - view.px), &view, position, attitude, &noise);
            for (k, d) in derivatives.iter().enumerate() {
                let d = view.d_point * d;
                self.z.set(2 * i, pose + k, d.x);
                self.z.set(2 * i + 1, pose + k, d.y);
            }
        }
        if gated {
            let settled = curvature < LITTLE_CURVATURE * self.z.noise[0][0];
            let worse = self.worse_than_told([pose, pose + 1, pose + 2, position + 2]);
            self.z.scale_noise(worse);
            let outcome = self.fuse_gated(FusionSource::Marker);
            if self.learning.on && settled && outcome.ratio < LEARN_RATIO {
                blend_factor(
                    &mut self.state.learnt.marker_factor[index],
                    outcome.misfit * worse,
                    MARKER_SAMPLES,
                    PIXEL_FACTORS,
                );
            }
            return outcome.ratio <= 1.0;
        }
        let outcome = self.fuse(None);
        outcome.disposition == Disposition::Fused
    }

    /// By what factor the variance of the marker's pixels in `self.z` is larger than told, by what a tag's shape shows:
    /// 1 unless that is beyond the gate, or so far beyond that it is no tag of ours. A disc's centre has no shape.
    fn worse_than_told(&self, rigid: [usize; 4]) -> f64 {
        if self.at_truth || self.z.m < 8 {
            return 1.0;
        }
        let gate = self.models.gates[shape::LEFT];
        let left =
            shape::left_over(&self.z, rigid).filter(|left| (1.0..REFUSE_RATIO).contains(&(left / gate)));
        left.map_or(1.0, |left| left / shape::LEFT as f64)
    }

    /// What the linear model leaves out of a pixel while tilt is hardly known, px²: a tilt error δ bends
    /// the image by up to `f δ²`. It dies out as tilt gets known (0.3 px at 1°, 0.03 px at 0.3°).
    fn curvature_px2(&self) -> f64 {
        let cov = &self.state.cov;
        let tilt_var = cov.at(at::ATTITUDE, at::ATTITUDE) + cov.at(at::ATTITUDE + 1, at::ATTITUDE + 1);
        (self.models.camera.fx * tilt_var).powi(2)
    }

    /// Ground features: each a point of the ground that stays where it is.
    fn fuse_features(&mut self, tracks: &[FeatureTrack]) {
        for slot in 0..self.state.features.len() {
            let Some(id) = self.state.features[slot].id else { continue };
            match tracks.iter().find(|track| track.id == id) {
                Some(track) => self.fuse_feature(slot, track, true),
                None => self.drop_feature(slot),
            }
        }
        for slot in 0..self.state.features.len() {
            if self.state.features[slot].id.is_none()
                && let Some(track) = next_feature(&self.state, &self.models, tracks)
            {
                self.start_feature(slot, &track);
            }
        }
    }

    fn start_feature(&mut self, slot: usize, track: &FeatureTrack) {
        let own = &self.state.own;
        let Some(found) = ground_point(own, &self.models, track.px, 0.0) else { return };
        let feature = &mut self.state.features[slot];
        feature.id = Some(track.id);
        feature.mean = [found.x, found.y];
        feature.rejected = 0;
        let start = self.state.feature_at(slot);
        self.state.renew(start, &[GUESSED_VAR; 2]);
        self.fuse_feature(slot, track, false);
    }

    pub(super) fn drop_feature(&mut self, slot: usize) {
        self.state.features[slot].id = None;
        let start = self.state.feature_at(slot);
        self.state.renew(start, &[0.0; 2]);
    }

    pub(super) fn fuse_feature(&mut self, slot: usize, track: &FeatureTrack, gated: bool) {
        let start = self.state.feature_at(slot);
        let [north, east] = self.state.features[slot].mean;
        let world = Vector3::new(north, east, self.models.ground.down_m(north, east));
        let Some(view) = view(&self.state.own, &self.models, &world) else {
            self.drop_feature(slot);
            return;
        };
        let [slope_n, slope_e] = self.models.ground.slope(north, east);
        self.z.begin(2);
        let position = self.z.columns(at::POSITION, 3);
        let attitude = self.z.columns(at::ATTITUDE, 3);
        let place = self.z.columns(start, 2);
        let known = track.sigma_px.powi(2) * self.models.feature_factor2;
        let curvature = self.curvature_px2();
        let noise = Matrix2::identity() * (known * self.state.learnt.feature_factor + curvature);
        set_point(&mut self.z, 0, &(track.px - view.px), &view, position, attitude, &noise);
        for (k, d) in [Vector3::new(1.0, 0.0, slope_n), Vector3::new(0.0, 1.0, slope_e)].iter().enumerate() {
            let d = view.d_point * d;
            self.z.set(0, place + k, d.x);
            self.z.set(1, place + k, d.y);
        }
        if !gated {
            self.fuse(None);
            return;
        }
        let outcome = self.fuse_gated(FusionSource::Feature);
        if self.learning.on && curvature < LITTLE_CURVATURE * noise[(0, 0)] && outcome.ratio < LEARN_RATIO {
            blend_factor(
                &mut self.state.learnt.feature_factor,
                outcome.misfit,
                FEATURE_SAMPLES,
                PIXEL_FACTORS,
            );
        }
        if outcome.ratio > 1.0 {
            self.state.features[slot].rejected += 1;
            if self.state.features[slot].rejected >= 2 {
                self.drop_feature(slot);
            }
        } else {
            self.state.features[slot].rejected = 0;
        }
    }
}

/// Noise of pixels is fitted where tilt is known: what the linear model leaves out is this part of it.
const LITTLE_CURVATURE: f64 = 0.2;
/// Sightings the fitted noise remembers: some seconds of one vehicle's tags, of eight features.
const MARKER_SAMPLES: f64 = 100.0;
const FEATURE_SAMPLES: f64 = 400.0;

fn set_point(
    z: &mut Measurement,
    i: usize,
    residual: &Vector2<f64>,
    view: &PointView,
    position: usize,
    attitude: usize,
    noise: &Matrix2<f64>,
) {
    for r in 0..2 {
        z.residual[2 * i + r] = residual[r];
        for k in 0..3 {
            z.set(2 * i + r, position + k, -view.d_point[(r, k)]);
            z.set(2 * i + r, attitude + k, view.d_attitude[(r, k)]);
        }
        for c in 0..2 {
            z.noise[2 * i + r][2 * i + c] = noise[(r, c)];
        }
    }
}

/// The track not yet used that lies farthest from those in use: spread is what separates turning from
/// moving.
fn next_feature(state: &State, models: &Models, tracks: &[FeatureTrack]) -> Option<FeatureTrack> {
    let used = |id: u64| state.features.iter().any(|f| f.id == Some(id));
    let lone = |track: &FeatureTrack| {
        let others = tracks.iter().filter(|other| used(other.id));
        others.map(|o| (o.px - track.px).norm()).fold(f64::INFINITY, f64::min)
    };
    let fit = |track: &&FeatureTrack| {
        !used(track.id)
            && track.sigma_px.is_finite()
            && track.sigma_px > 0.0
            && track.px.iter().all(|x| x.is_finite())
            && models.camera.normalised(track.px).is_some()
    };
    tracks.iter().filter(fit).max_by(|a, b| lone(a).total_cmp(&lone(b)).then(b.id.cmp(&a.id))).copied()
}

impl Target {
    /// What became of a track in a frame that does not show it; without `lost_after` it is never lost.
    fn unseen(&mut self, t: windhover_base::time::MonoTime, lost_after: Option<windhover_base::time::Span>) {
        if !self.held {
            self.status = TrackStatus::Lost;
            return;
        }
        let away = t - self.last_seen;
        if lost_after.is_some_and(|limit| away > limit)
            || (self.status == TrackStatus::Acquiring && away.s() > super::track::DOUBTFUL_S)
        {
            self.status = TrackStatus::Lost;
        } else if away.s() > BLINK_S && self.status == TrackStatus::Tracking {
            self.status = TrackStatus::Coasting;
        }
    }
}
