//! After its first frames the detector allocates no memory, for tags, discs and ground features: a counting allocator.

#[path = "detector/common.rs"]
mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use nalgebra::Vector2;
use windhover_base::msg::{FrameObservations, FramePrediction, MarkerId, MarkerPrediction, RgbImage};
use windhover_base::settings::{Brightness, DetectorConfig};
use windhover_detect::tracking::FrameDetector;
use windhover_detect::{Detector, GrayImage, Limits, Roi, TagFamily, tag_pattern};

/// Counts the allocations of the calling thread.
struct Counting;

thread_local! {
    static ASKED: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: every call is passed to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ASKED.with(|n| n.set(n.get() + 1));
        // SAFETY: as the caller guarantees.
        unsafe { System.alloc(layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ASKED.with(|n| n.set(n.get() + 1));
        // SAFETY: as the caller guarantees.
        unsafe { System.realloc(at, layout, size) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: as the caller guarantees.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Speckled ground with two tags, one of them at the place numbered `at`.
fn frame(at: usize) -> GrayImage {
    let mut image = GrayImage::new(640, 480);
    for (i, p) in image.data.iter_mut().enumerate() {
        *p = 90 + ((i % 640 / 3 * 31 + i / 640 / 3 * 57) % 61) as u8;
    }
    for (id, u, v, cell) in [(3, at, 100, 4), (7, 300, 200, 9)] {
        let pattern = tag_pattern(TagFamily::Tag36h11, id);
        for y in 0..pattern.side() * cell {
            for x in 0..pattern.side() * cell {
                image.data[(v + y) * 640 + u + x] = if pattern.white(x / cell, y / cell) { 210 } else { 25 };
            }
        }
    }
    image
}

#[test]
fn frames_after_the_first_take_no_memory() {
    let frames = [frame(60), frame(90), frame(120)];
    let mut detector = Detector::new(&[TagFamily::Tag36h11], Limits::default());
    let pass = |detector: &mut Detector| {
        for image in &frames {
            assert_eq!(detector.detect(image.view()).len(), 2, "both tags are found");
            let roi = Roi::around(image.view(), Vector2::new(340.0, 240.0), 90.0).expect("inside");
            assert_eq!(detector.detect_roi(image.view(), roi).len(), 1, "the region holds one of them");
        }
    };
    pass(&mut detector);
    let before = ASKED.with(Cell::get);
    assert!(before > 0, "the allocator counts");
    pass(&mut detector);
    assert_eq!(ASKED.with(Cell::get), before, "allocations in the second pass over the same frames");
}

/// For tags 3 and 7, and a second target with a pair of dark discs.
fn detector_of_all() -> FrameDetector {
    let discs = [(0.4, 0.0), (0.6, 2.0)]
        .map(|(diameter, ahead)| common::disc(diameter, Some(Brightness::Dark), ahead));
    let targets = [common::target(vec![common::tag(3), common::tag(7)]), common::target(discs.to_vec())];
    let detector = DetectorConfig { ground_features: 8, ..DetectorConfig::default() };
    FrameDetector::new(&detector, &targets, &common::lens(1020.0, (645.0, 527.0)))
}

/// Diameters of the discs, pixels.
const DISCS: [f64; 2] = [30.0, 45.0];

fn disc_at(frame: usize, disc: usize) -> Vector2<f64> {
    Vector2::new(120.0 + 150.0 * disc as f64 + 4.0 * frame as f64, 380.0)
}

/// A frame with tags, discs and patches of light that have corners to follow, in grey and in colour.
fn full_frame(n: usize) -> (GrayImage, RgbImage) {
    let mut image = frame(60 + 4 * n);
    for (i, p) in image.data.iter_mut().enumerate() {
        let at = Vector2::new((i % 640) as f64, (i / 640) as f64);
        let (u, v) = (i % 640 + 640 - 4 * n, i / 640);
        if u % 97 < 20 && v % 83 < 20 && *p > 60 && *p < 170 {
            *p = 200;
        }
        for (disc, diameter) in DISCS.into_iter().enumerate() {
            match (at - disc_at(n, disc)).norm() {
                r if r < 0.5 * diameter => *p = 20,
                r if r < 0.5 * diameter + 14.0 => *p = 180,
                _ => {}
            }
        }
    }
    let data = image.data.iter().flat_map(|&p| [p; 3]).collect();
    (image, RgbImage { width: 640, height: 480, data })
}

/// The prediction for everything in a frame.
fn predicted(n: usize) -> FramePrediction {
    let tag = |id, u: usize, v: usize, cell: usize| MarkerPrediction {
        marker: MarkerId::Tag { family: TagFamily::Tag36h11, id },
        center_px: Vector2::new((u + 5 * cell) as f64, (v + 5 * cell) as f64),
        sigma_px: 2.0,
        size_px: 8.0 * cell as f64,
    };
    let disc = |marker: usize| MarkerPrediction {
        marker: MarkerId::Disc { target: 1, marker },
        center_px: disc_at(n, marker),
        sigma_px: 2.0,
        size_px: DISCS[marker],
    };
    FramePrediction {
        markers: vec![tag(3, 60 + 4 * n, 100, 4), tag(7, 300, 200, 9), disc(0), disc(1)],
        search: false,
        size_range_px: Some((20.0, 100.0)),
        occupied: vec![(Vector2::new(345.0, 245.0), 70.0)],
        ..FramePrediction::default()
    }
}

#[test]
fn whole_frames_with_discs_and_features_take_none_either() {
    let frames = [full_frame(0), full_frame(1), full_frame(2)];
    let predictions = [predicted(0), predicted(1), predicted(2)];
    let mut detector = detector_of_all();
    let mut seen = FrameObservations::default();
    let mut pass = |detector: &mut FrameDetector| {
        // Tracked after the first frame, and over a cut at which most features are lost.
        for (k, n) in [0, 1, 2, 1, 0, 2].into_iter().enumerate() {
            let (gray, rgb) = &frames[n];
            let prediction = (k > 0).then_some(&predictions[n]);
            detector.process(gray.view(), Some(rgb), prediction, &mut seen);
            assert_eq!(seen.markers.len(), 4, "two tags and two discs in frame {n}");
            assert!(seen.features.len() >= 4, "{} features in frame {n}", seen.features.len());
        }
    };
    for _ in 0..3 {
        pass(&mut detector);
    }
    let before = ASKED.with(Cell::get);
    for _ in 0..6 {
        pass(&mut detector);
    }
    assert_eq!(ASKED.with(Cell::get), before, "allocations after three passes over the same frames");
}
