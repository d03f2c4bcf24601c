//! A frame: which of its markers and ground features are fused, and what becomes of tracks and features by it.

use windhover_base::msg::{Disposition, FeatureTrack, FrameObservations, FusionSource, MarkerDetection};

use super::aid::disc::Disc;
use super::aid::feature::FeaturePixel;
use super::aid::tag::Tag;
use super::begin::ground_point;
use super::core::Core;
use super::models::{Marker, Models};
use super::state::{GUESSED_VAR, State};
use super::track::{OnSight, Verdict};

impl Core {
    /// Fuses a frame's ground features, then its markers.
    pub(crate) fn fuse_frame(&mut self, frame: &FrameObservations) {
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
        self.state.copy_targets(frame.frame, self.keep_copies);
    }

    fn fuse_target(&mut self, index: usize, markers: &[MarkerDetection]) {
        let seen = markers.iter().any(|d| self.models.find(d.marker).is_some_and(|(t, _)| t == index));
        let now = self.circumstances(index);
        let life = self.state.targets[index].life;
        if !seen {
            self.state.targets[index].life = life.unseen(&now);
            return;
        }
        match life.on_sight(&now) {
            OnSight::Start => self.start_target(index, markers, None),
            OnSight::StartAgain(first) => self.start_target(index, markers, Some(first)),
            OnSight::PlaceAnew if self.place_anew(index, markers) => {}
            OnSight::PlaceAnew | OnSight::Fuse => self.fuse_seen(index, markers),
        }
    }

    /// Fuses the markers of a target that is held.
    fn fuse_seen(&mut self, index: usize, markers: &[MarkerDetection]) {
        let mut accepted = false;
        for detection in markers {
            if let Some((target, marker)) = self.models.find(detection.marker)
                && target == index
            {
                accepted |= self.fuse_marker(index, marker, detection);
            }
        }
        let t = self.state.t;
        let target = &mut self.state.targets[index];
        if accepted {
            target.life = target.life.accepted();
            target.last_seen = t;
        } else {
            target.life = target.life.refused();
            match target.life.verdict(self.restart_after, self.models.targets[index].moves()) {
                Verdict::Keep => self.state.wake(&self.learning, index),
                Verdict::PlaceAnew if self.place_anew(index, markers) => return,
                Verdict::PlaceAnew | Verdict::Start => return self.start_target(index, markers, None),
            }
        }
        self.state.settle(index);
    }

    /// Fuses one marker through the gate: a tag's four corners at once, or its or a disc's centre. Whether it was inside.
    pub(crate) fn fuse_marker(&mut self, target: usize, marker: usize, seen: &MarkerDetection) -> bool {
        let marker = self.models.targets[target].markers[marker].clone();
        match as_tag(target, &marker, seen) {
            Some(tag) => tag.fuse(self),
            None => as_disc(target, &marker, seen).fuse(self),
        }
    }

    /// Fuses one marker as it is: a prior was just made from it.
    pub(crate) fn fuse_first_marker(&mut self, target: usize, marker: usize, seen: &MarkerDetection) {
        let marker = self.models.targets[target].markers[marker].clone();
        match as_tag(target, &marker, seen) {
            Some(tag) => self.fuse_aid_as_it_is(&tag),
            None => self.fuse_aid_as_it_is(&as_disc(target, &marker, seen)),
        }
    }

    /// Ground features: those in use are fused or dropped, and free places taken.
    fn fuse_features(&mut self, tracks: &[FeatureTrack]) {
        for slot in 0..self.state.features.len() {
            let Some(id) = self.state.features[slot].id else { continue };
            match tracks.iter().find(|track| track.id == id) {
                Some(track) => self.fuse_feature(slot, track),
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
        self.state.renew(self.state.layout().feature(slot), &[GUESSED_VAR; 2]);
        match self.linearise(&pixel_of(slot, track)) {
            Ok(()) => _ = self.fuse(FusionSource::Feature, None),
            Err(_) => self.drop_feature(slot),
        }
    }

    pub(crate) fn drop_feature(&mut self, slot: usize) {
        self.state.features[slot].id = None;
        self.state.renew(self.state.layout().feature(slot), &[0.0; 2]);
    }

    /// Fuses a feature in use; what is outside the gate twice in a row, or cannot be seen, is dropped.
    pub(crate) fn fuse_feature(&mut self, slot: usize, track: &FeatureTrack) {
        let Some(outcome) = pixel_of(slot, track).fuse(self) else {
            return self.drop_feature(slot);
        };
        let rejected = &mut self.state.features[slot].rejected;
        *rejected = if outcome.ratio > 1.0 { *rejected + 1 } else { 0 };
        if *rejected >= 2 {
            self.drop_feature(slot);
        }
    }
}

fn as_tag<'a>(target: usize, marker: &'a Marker, seen: &'a MarkerDetection) -> Option<Tag<'a>> {
    let (points, corners_px) = marker.corners.as_ref().zip(seen.corners_px.as_ref())?;
    Some(Tag { target, points, corners_px, cov_px2: &seen.corner_cov_px2 })
}

fn as_disc<'a>(target: usize, marker: &'a Marker, seen: &'a MarkerDetection) -> Disc<'a> {
    Disc { target, point: &marker.center, center_px: &seen.center_px, cov_px2: &seen.center_cov_px2 }
}

fn pixel_of(slot: usize, track: &FeatureTrack) -> FeaturePixel {
    FeaturePixel { slot, px: track.px, sigma_px: track.sigma_px }
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
