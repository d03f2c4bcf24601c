//! A frame: which of its markers and ground features are fused, and what becomes of tracks and features by it.

use windhover_base::msg::{Disposition, FrameObservations, FusionSource, MarkerDetection};

use super::aid::disc::Disc;
use super::aid::tag::Tag;
use super::core::Core;
use super::models::Marker;
use super::track::{OnSight, Verdict};

impl Core {
    /// Fuses a frame's ground features, then its markers.
    pub(crate) fn fuse_frame(&mut self, frame: &FrameObservations) {
        let since_s = self.state.since_frame();
        self.begin_shake(frame.features.len());
        self.fuse_features(&frame.features, since_s);
        let mut chosen = std::mem::take(&mut self.chosen);
        self.choose_markers(&frame.markers, &mut chosen);
        for target in 0..self.state.targets.len() {
            self.fuse_target(target, &chosen);
        }
        self.chosen = chosen;
        for detection in &frame.markers {
            if self.models.find(detection.marker).is_none() {
                self.refuse(FusionSource::Marker, Disposition::Unknown);
            }
        }
        self.end_shake(since_s);
        self.state.learn_targets(&self.learning);
        self.judge_turns();
        self.judge_lens();
        self.bound_readout();
        self.state.copy_targets(frame.frame, self.keep_copies);
        self.judge_camera_clock();
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
            OnSight::Start | OnSight::StartAgain(_) if !self.height_agrees(index, markers) => {
                self.refuse(FusionSource::Marker, Disposition::GateRejected);
            }
            OnSight::Start => self.start_target(index, markers, None),
            OnSight::StartAgain(first) => self.start_target(index, markers, Some(first)),
            OnSight::PlaceAnew if self.place_anew(index, markers) => {}
            OnSight::Return if self.is_elsewhere(index, markers) && self.place_anew(index, markers) => {}
            OnSight::PlaceAnew | OnSight::Return | OnSight::Fuse => self.fuse_seen(index, markers),
        }
    }

    /// Fuses the markers of a target that is held.
    fn fuse_seen(&mut self, index: usize, markers: &[MarkerDetection]) {
        let before = self.before_fusion(index);
        let mut accepted = false;
        let mut first = None;
        for detection in markers {
            if let Some((target, marker)) = self.models.find(detection.marker)
                && target == index
            {
                let beside = accepted;
                if let Some(first) = first {
                    self.judge_size(index, first, detection);
                }
                let inside = self.fuse_marker(index, marker, detection, beside);
                accepted |= inside;
                first = first.or(inside.then_some(detection));
                // Where none of them is inside it is the vehicle that is elsewhere.
                if beside {
                    self.judge_tag(index, marker, inside);
                }
            }
        }
        let t = self.state.t;
        let target = &mut self.state.targets[index];
        if accepted {
            target.life = target.life.accepted();
            target.last_seen = t;
            self.judge_vehicle(index, &before);
        } else {
            target.life = target.life.refused();
            match target.life.verdict(self.restart_after, self.models.targets[index].moves()) {
                Verdict::Keep => {
                    self.state.wake(&self.learning, index);
                    let target = &mut self.state.targets[index];
                    if target.life.refusals() > 1 {
                        target.slip.open();
                    }
                }
                Verdict::PlaceAnew if self.place_anew(index, markers) => return,
                Verdict::PlaceAnew | Verdict::Start => return self.start_target(index, markers, None),
            }
        }
        self.state.settle(index);
    }

    /// Whether all markers of a target lie outside the gate.
    fn is_elsewhere(&mut self, index: usize, markers: &[MarkerDetection]) -> bool {
        markers.iter().all(|seen| match self.models.find(seen.marker) {
            Some((target, marker)) if target == index => self.marker_ratio(index, marker, seen) > 1.0,
            _ => true,
        })
    }

    /// The marker's normalised innovation squared over the gate; above one as well where it cannot be predicted.
    fn marker_ratio(&mut self, target: usize, marker: usize, seen: &MarkerDetection) -> f64 {
        let marker = self.models.targets[target].markers[marker].clone();
        let expected = match as_tag(target, &marker, seen) {
            Some(tag) => self.linearise(&tag),
            None => self.linearise(&as_disc(target, &marker, seen)),
        };
        match expected {
            Err(_) => return f64::INFINITY,
            Ok(()) if self.at_truth => return 0.0,
            Ok(()) => {}
        }
        self.gate_ratio().unwrap_or(f64::INFINITY)
    }

    /// Fuses one marker through the gate: a tag's four corners at once, or its or a disc's centre. Whether it was inside.
    /// `beside` says whether another marker of the target was, in the same frame.
    pub(crate) fn fuse_marker(
        &mut self,
        target: usize,
        marker: usize,
        seen: &MarkerDetection,
        beside: bool,
    ) -> bool {
        let marker = self.models.targets[target].markers[marker].clone();
        match as_tag(target, &marker, seen) {
            Some(tag) => {
                tag.fuse(self, beside && tag.fit.is_some_and(|slot| !self.state.tags[slot].is_open()))
            }
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
}

fn as_tag<'a>(target: usize, marker: &'a Marker, seen: &'a MarkerDetection) -> Option<Tag<'a>> {
    let (points, corners_px) = marker.corners.as_ref().zip(seen.corners_px.as_ref())?;
    let (center, fit) = (&marker.center, marker.fit);
    Some(Tag { target, center, points, fit, corners_px, cov_px2: &seen.corner_cov_px2 })
}

fn as_disc<'a>(target: usize, marker: &'a Marker, seen: &'a MarkerDetection) -> Disc<'a> {
    Disc { target, point: &marker.center, center_px: &seen.center_px, cov_px2: &seen.center_cov_px2 }
}
