//! What a flight needs beside single images: the markers of targets searched where they are predicted, the rest
//! of the frame in strips; discs; and ground features from frame to frame.
//!
//! Where an image holds tags is [`Detector`]'s to say; this module is made for the daemon's pipeline.

use super::detector::{Detector, Limits};
use super::disc_pairs::DiscPairs;
use super::family::TagLayout;
use super::features::{Circle, FeatureTracker, Obstacles};
use super::roi::Roi;
use windhover_base::geo::CameraModel;
use windhover_base::msg::{
    FrameObservations, FramePrediction, ImageView, MarkerDetection, MarkerId, MarkerPrediction, RgbImage,
    TagFamily,
};
use windhover_base::settings::{DetectorConfig, MarkerConfig, MarkerKind, TargetConfig};

/// Frames over which the strips cover the whole image once.
const STRIPS: usize = 8;

/// How far a vehicle reaches about a tag that is of none of ours, in sizes of that tag: two and a half metres of one of half
/// a metre.
const STRANGERS_REACH: f64 = 5.0;

/// What a vehicle may cover beyond its markers and axles, m.
const MARGIN_M: f64 = 0.5;

/// Sigmas of a predicted centre that its region of interest covers.
const ROI_SIGMAS: f64 = 4.0;

/// Finds the configured markers in frames, and ground features between them.
#[derive(Clone, Debug)]
pub struct FrameDetector {
    tags: Option<Detector>,
    min_px: f64,
    next_strip: usize,
    scratch: Vec<MarkerDetection>,
    discs: Option<DiscPairs>,
    features: FeatureTracker,
    /// What the vehicle of each marker covers about it, in sizes of that marker.
    reach: Vec<(MarkerId, f64)>,
    occupied: Vec<Circle>,
}

impl FrameDetector {
    /// For the markers of `targets`, seen through `lens`.
    pub fn new(detector: &DetectorConfig, targets: &[TargetConfig], lens: &CameraModel) -> Self {
        let mut layouts: Vec<TagLayout> = targets
            .iter()
            .flat_map(|t| &t.marker)
            .filter(|m| m.kind == MarkerKind::Apriltag)
            .filter_map(|m| Some(layout_of(m.family?, m)))
            .collect();
        layouts.sort_unstable();
        layouts.dedup();
        let limits = Limits { min_px: detector.min_px, max_hamming: detector.max_hamming };
        let tags = (!layouts.is_empty()).then(|| Detector::new(&layouts, limits));
        Self {
            tags,
            min_px: detector.min_px,
            next_strip: 0,
            scratch: Vec::new(),
            discs: DiscPairs::new(targets, lens),
            features: FeatureTracker::new(detector.ground_features),
            reach: targets.iter().enumerate().flat_map(|(i, target)| reach(i, target)).collect(),
            occupied: Vec::new(),
        }
    }

    /// Fills `out` with what is seen; its frame number is the caller's.
    pub fn process(
        &mut self,
        image: ImageView<'_>,
        rgb: Option<&RgbImage>,
        prediction: Option<&FramePrediction>,
        out: &mut FrameObservations,
    ) {
        out.markers.clear();
        out.features.clear();
        if image.width == 0 || image.height == 0 {
            return;
        }
        self.find_tags(image, prediction, &mut out.markers);
        if let Some(discs) = &mut self.discs {
            discs.find(image, rgb, prediction, &mut out.markers);
        }
        self.occupied.clear();
        self.occupied.extend(prediction.iter().flat_map(|p| &p.occupied));
        // A vehicle where it is predicted is covered by its own circle.
        let predicted = prediction.map_or(&[][..], |p| &p.occupied);
        let ours =
            |m: &MarkerDetection| predicted.iter().any(|(at, radius)| (m.center_px - at).norm() < *radius);
        let reach = &self.reach;
        let covered = |m: &MarkerDetection| {
            let sizes = if ours(m) { 1.0 } else { reach_of(reach, m.marker) };
            (m.center_px, sizes * m.size_px)
        };
        self.occupied.extend(out.markers.iter().map(covered));
        let off = Obstacles {
            occupied: &self.occupied,
            moving: prediction.map_or(&[], |p| &p.moving),
            moving_radius_px: prediction.map_or(0.0, |p| p.moving_radius_px),
        };
        self.features.process(image, off, &mut out.features);
    }

    fn find_tags(
        &mut self,
        image: ImageView<'_>,
        prediction: Option<&FramePrediction>,
        out: &mut Vec<MarkerDetection>,
    ) {
        let Some(tags) = &mut self.tags else { return };
        let smallest = prediction.and_then(|p| p.size_range_px).map_or(0.0, |(low, _)| 0.7 * low);
        let min_px = self.min_px.max(smallest);
        tags.set_min_px(min_px);
        let Some(prediction) = prediction.filter(|p| !p.search) else {
            out.extend(tags.detect(image).iter().map(MarkerDetection::from));
            return;
        };
        self.scratch.clear();
        for marker in prediction.markers.iter().filter(|m| matches!(m.marker, MarkerId::Tag { .. })) {
            if let Some(roi) = roi_of(image, marker) {
                tags.set_min_px((0.6 * marker.size_px).max(self.min_px));
                let found = tags.detect_roi(image, roi);
                self.scratch.extend(found.iter().map(MarkerDetection::from));
            }
        }
        tags.set_min_px(min_px);
        let overlap = prediction.size_range_px.map_or(128.0, |(_, high)| 1.5 * high);
        let found = tags.detect_roi(image, strip(image, self.next_strip, overlap));
        self.scratch.extend(found.iter().map(MarkerDetection::from));
        self.next_strip = (self.next_strip + 1) % STRIPS;
        for found in &self.scratch {
            if !out.iter().any(|o| o.marker == found.marker && near(o, found)) {
                out.push(*found);
            }
        }
    }
}

/// How a marker of a family is printed.
fn layout_of(family: TagFamily, m: &MarkerConfig) -> TagLayout {
    TagLayout { family, border: m.border, mirrored: m.mirrored, inverted: m.inverted }
}

/// How far a vehicle reaches about each of its markers, in sizes of that marker.
fn reach(index: usize, target: &TargetConfig) -> impl Iterator<Item = (MarkerId, f64)> {
    let size = |m: &MarkerConfig| m.size_m.or(m.diameter_m).unwrap_or(0.0);
    let at = |m: &MarkerConfig| m.position_m[0].hypot(m.position_m[1]);
    let markers = target.marker.iter();
    let reach_m =
        markers.map(|m| at(m) + size(m)).fold(target.wheelbase_m.unwrap_or(0.0), f64::max) + MARGIN_M;
    target.marker.iter().enumerate().filter(move |(_, m)| size(m) > 0.0).map(move |(k, m)| {
        let id = match m.family.zip(m.id) {
            Some((family, id)) => MarkerId::Tag { family, id },
            None => MarkerId::Disc { target: index, marker: k },
        };
        (id, reach_m / size(m))
    })
}

fn reach_of(known: &[(MarkerId, f64)], marker: MarkerId) -> f64 {
    known.iter().find(|(id, _)| *id == marker).map_or(STRANGERS_REACH, |(_, reach)| *reach)
}

fn near(a: &MarkerDetection, b: &MarkerDetection) -> bool {
    (a.center_px - b.center_px).norm() < 0.5 * a.size_px
}

/// Where a marker is looked for: its own size around it, its diagonal, and the doubt about its place.
fn roi_of(image: ImageView<'_>, marker: &MarkerPrediction) -> Option<Roi> {
    let radius = marker.size_px + ROI_SIGMAS * marker.sigma_px + 8.0;
    radius.is_finite().then(|| Roi::around(image, marker.center_px, radius)).flatten()
}

fn strip(image: ImageView<'_>, index: usize, overlap: f64) -> Roi {
    let top = image.height * index / STRIPS;
    let bottom = image.height * (index + 1) / STRIPS;
    let overlap = overlap.clamp(0.0, image.height as f64) as usize;
    Roi { u: 0, v: top, width: image.width, height: (bottom - top + overlap).min(image.height - top) }
}
