//! A frame through the pipeline: detection, fusion, what is reported of it.

use nalgebra::Vector2;

use crate::pixels::{self, DecodedFrame, FrameFault};
use windhover_base::msg::{
    EstimatorOutput, Event, FramePayload, NoticeKind, Output, Source, Stamped, TargetEstimate, TrackStatus,
};
use windhover_base::settings::{MarkerKind, TargetConfig};
use windhover_base::time::{MonoTime, Span};

use super::Pipeline;
use super::misfit_words::felt_words;
use super::monitor::notice;

/// What is seen nearer than this to a lost part of a frame is not used: the size of the neighbourhood by which a
/// feature is recognised.
const LOST_MARGIN_PX: f64 = 12.0;

impl Pipeline {
    pub(super) fn frame(
        &mut self,
        payload: &FramePayload,
        decoded: Result<DecodedFrame, FrameFault>,
        event: &Event,
        out: &mut Vec<Output>,
    ) {
        let t = event.t_recv;
        self.pace.frame(t, payload.index);
        let offset = Span::from_ms(self.settings.rig.camera.exposure_offset_ms);
        let t_valid = self.exposures.exposed(payload.t_exposure, t) + offset;
        if self.last_exposure.is_some_and(|last| payload.t_exposure <= last) {
            let words = format!("frame {} is stamped no later than the one before", payload.index);
            out.push(notice(t, NoticeKind::ClockJump, Some(Source::Camera), words));
        }
        self.last_exposure = Some(payload.t_exposure);
        self.observations.frame = payload.index;
        self.observations.markers.clear();
        self.observations.features.clear();
        let (width, height) = (self.settings.rig.camera.width, self.settings.rig.camera.height);
        match decoded.and_then(|d| pixels::check_size(&d, width, height).map(|()| d)) {
            Ok(decoded) => {
                self.monitor.delivered(Source::Camera, t, out);
                let prediction = self.estimators.as_mut().map(|e| {
                    e.joint.predict(t_valid, &mut self.prediction);
                    &self.prediction
                });
                let rgb = decoded.rgb.as_ref();
                self.detector.process(decoded.gray.view(), rgb, prediction, &mut self.observations);
                if !decoded.missing.is_empty() {
                    self.keep_whole(&decoded);
                    let lost = decoded.missing.len();
                    let words =
                        format!("frame {}: {lost} parts of it are lost, the rest is used", payload.index);
                    out.push(notice(t, NoticeKind::FrameDamaged, Some(Source::Camera), words));
                }
                self.note_seen(t, out);
                out.push(Output::Detections {
                    frame: payload.index,
                    t_valid,
                    markers: self.observations.markers.clone(),
                    features: self.observations.features.clone(),
                });
            }
            Err(fault) => {
                let words = format!("frame {} cannot be used: {fault}", payload.index);
                self.monitor.frame_unusable(t, words, out);
            }
        }
        self.estimate(t_valid, event, out);
    }

    /// Removes what was seen where parts of the frame are lost.
    pub(super) fn keep_whole(&mut self, frame: &DecodedFrame) {
        self.observations
            .features
            .retain(|f| frame.is_whole((f.px.x, f.px.y), (f.px.x, f.px.y), LOST_MARGIN_PX));
        self.observations.markers.retain(|marker| {
            let radius = 0.5 * marker.size_px;
            let center = marker.center_px;
            let around = [(-radius, -radius), (radius, radius)].map(|(u, v)| center + Vector2::new(u, v));
            let corners = marker.corners_px.unwrap_or([around[0], around[0], around[1], around[1]]);
            let from = corners.iter().fold(center, |low, c| low.inf(c));
            let to = corners.iter().fold(center, |high, c| high.sup(c));
            frame.is_whole((from.x, from.y), (to.x, to.y), LOST_MARGIN_PX)
        });
    }

    pub(super) fn note_seen(&mut self, t: MonoTime, out: &mut Vec<Output>) {
        for target in 0..self.settings.rig.target.len() {
            if self.observations.markers.iter().any(|seen| self.seen.target_of(seen) == Some(target)) {
                self.monitor.seen(target);
            }
        }
        for words in self.seen.twice(&self.observations, t) {
            out.push(notice(t, NoticeKind::MarkerSeenTwice, Some(Source::Camera), words));
        }
    }

    /// One estimate for each frame and target, whatever was seen.
    pub(super) fn estimate(&mut self, t_valid: MonoTime, event: &Event, out: &mut Vec<Output>) {
        let Some(estimators) = &mut self.estimators else {
            for target in 0..self.settings.rig.target.len() {
                let frame = self.observations.frame;
                let status = TrackStatus::Lost;
                let lost = TargetEstimate { t_valid, frame, target, status, state: None };
                out.push(Output::Estimator(EstimatorOutput::Estimate(lost)));
            }
            return;
        };
        let observations = std::mem::take(&mut self.observations);
        let stamped = Stamped { t_valid, t_recv: event.t_recv, seq: event.seq, value: observations };
        estimators.joint.frame(&stamped, &mut self.estimated);
        estimators.paper.frame(&stamped, &mut self.papered);
        out.extend(self.papered.drain(..).map(Output::Paper));
        self.observations = stamped.value;
        self.take_estimated(event.t_recv, out);
    }

    pub(super) fn take_estimated(&mut self, t: MonoTime, out: &mut Vec<Output>) {
        for estimated in self.estimated.drain(..) {
            match &estimated {
                EstimatorOutput::Estimate(estimate) | EstimatorOutput::Coasted(estimate) => {
                    self.monitor.estimate(estimate, t, out);
                }
                EstimatorOutput::Fusion(result) => self.monitor.disposition(result.disposition),
                EstimatorOutput::Anchored { moved_m: d } => {
                    let detail = format!(
                        "the receiver jumped for good: everything moved by {:.1} m north, {:.1} m east, {:.1} m down",
                        d.x, d.y, d.z
                    );
                    out.push(notice(t, NoticeKind::FilterReset, None, detail));
                }
                EstimatorOutput::Reset { reason } => {
                    out.push(notice(t, NoticeKind::FilterReset, None, (*reason).to_owned()));
                }
                EstimatorOutput::TiltFelt { felt, slope } => {
                    let detail =
                        format!("the compass's tilt sensor {} (slope {slope:.2})", felt_words(*felt));
                    out.push(notice(t, NoticeKind::TiltFelt, Some(Source::Compass), detail));
                }
                EstimatorOutput::Misfit(misfit) => self.monitor.misfit(misfit, t, out),
                EstimatorOutput::Smoothed(_) | EstimatorOutput::Ownship(_) => {}
            }
            out.push(Output::Estimator(estimated));
        }
    }
}

/// Colours are needed only where a disc is identified by its colour.
pub(super) fn wants_rgb(targets: &[TargetConfig]) -> bool {
    let mut markers = targets.iter().flat_map(|t| &t.marker);
    markers.any(|m| m.kind == MarkerKind::Disc && m.color.is_some())
}
