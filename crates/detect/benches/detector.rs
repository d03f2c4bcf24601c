//! Time that the detector needs for a frame: whole frames at two smallest sizes, a region, a tracked frame with and
//! without ground features. `cargo bench -p windhover-detect`. The frame is generated: textured ground, noise, two tags
//! of 40 and 90 px.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use nalgebra::{Matrix3, Vector2};
use rand::{Rng, SeedableRng};
use windhover_base::msg::{FrameObservations, FramePrediction, MarkerId, MarkerPrediction};
use windhover_base::settings::DetectorConfig;
use windhover_detect::tracking::FrameDetector;
use windhover_detect::{Detector, GrayImage, ImageView, Limits, Roi, Simd, TagFamily, tag_pattern};

#[path = "../tests/detector/common.rs"]
#[expect(dead_code, reason = "the discs of the tests are not timed")]
mod common;

#[path = "../tests/detector/bound.rs"]
mod bound;

/// The smallest possible error of a tag's corners, in focus: the figures of the detector's page, with which the proof
/// `corners_beside_the_least_error_that_there_can_be` compares.
fn bounds(_: &mut Criterion) {
    let pattern = tag_pattern(TagFamily::Tag36h11, 3);
    let blur = (0.7f64.powi(2) + 1.0 / 12.0).sqrt();
    for edge in [16.0, 24.0, 36.0, 60.0, 100.0, 200.0] {
        let (sin, cos) = 0.3f64.sin_cos();
        let half = 0.5 * edge;
        let middle = 150.3;
        let view =
            Matrix3::new(half * cos, -half * sin, middle, half * sin, half * cos, middle, 0.0, 0.0, 1.0);
        let [low, high] = [2.0, 5.0].map(|noise| {
            let seen = bound::Seen { view: &view, pattern: &pattern, blur, contrast: 135.0, noise };
            bound::corner_bound(seen)
        });
        println!(
            "least RMS error of a corner, tag of {edge} px: {low:.4} px at noise 2, {high:.4} px at noise 5"
        );
    }
}

fn put_tag(image: &mut GrayImage, id: u32, at: (usize, usize), cell: usize) {
    let pattern = tag_pattern(TagFamily::Tag36h11, id);
    for y in 0..pattern.side() * cell {
        for x in 0..pattern.side() * cell {
            let light = if pattern.white(x / cell, y / cell) { 200 } else { 30 };
            image.data[(at.1 + y) * image.stride + at.0 + x] = light;
        }
    }
}

/// 1280×1024: slabs of brick size with light joints, two tags, blur of three pixels, noise.
fn frame() -> GrayImage {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    let mut sharp = GrayImage::new(1280, 1024);
    let slabs: Vec<u8> = (0..4096).map(|_| rng.random_range(70..110)).collect();
    for (i, p) in sharp.data.iter_mut().enumerate() {
        let (u, v) = (i % 1280, i / 1280);
        let course = v / 18;
        let shifted = u + course % 2 * 20;
        *p = if v % 18 < 3 || shifted % 40 < 3 {
            150
        } else {
            slabs[(shifted / 40 * 57 + course * 31) % 4096]
        };
    }
    put_tag(&mut sharp, 3, (500, 400), 5);
    put_tag(&mut sharp, 4, (700, 420), 11);
    let mut image = sharp.clone();
    for v in 1..1023 {
        for u in 1..1279 {
            let sum: u32 =
                (0..9).map(|k| u32::from(sharp.data[(v + k / 3 - 1) * 1280 + u + k % 3 - 1])).sum();
            let noise = rng.random_range(-8i32..=8);
            image.data[v * 1280 + u] = (sum as i32 / 9 + noise).clamp(0, 255) as u8;
        }
    }
    image
}

fn tags(c: &mut Criterion) {
    let image = frame();
    for min_px in [24.0, 16.0] {
        for (name, simd) in [("best", Simd::best()), ("scalar", Simd::scalar())] {
            let limits = Limits { min_px, max_hamming: 2 };
            let mut detector = Detector::new(&[TagFamily::Tag36h11], limits).with_simd(simd);
            assert_eq!(detector.detect(image.view()).len(), 2, "both tags are found");
            c.bench_function(&format!("detector/frame 1280x1024/min {min_px} px/{name}"), |b| {
                b.iter(|| detector.detect(black_box(image.view())).len());
            });
        }
    }
    let limits = Limits { min_px: 24.0, max_hamming: 2 };
    let mut detector = Detector::new(&[TagFamily::Tag36h11], limits);
    let roi = Roi::around(image.view(), Vector2::new(525.0, 425.0), 127.5).expect("inside the frame");
    c.bench_function("detector/region 256x256", |b| {
        b.iter(|| detector.detect_roi(black_box(image.view()), roi).len());
    });
}

/// The frame as seen by a camera that moved by some pixels: a window of the same buffer.
fn moved(image: &GrayImage, by: usize) -> ImageView<'_> {
    let mut view = image.view();
    view.data = &view.data[by * view.stride + by..];
    view.width -= 8;
    view.height -= 8;
    view
}

/// A frame while tracking: both tags at their predicted places, one strip of the rest, eight ground features.
fn tracked(c: &mut Criterion) {
    let image = frame();
    let family = TagFamily::Tag36h11;
    let marker = |id, u, size_px| MarkerPrediction {
        marker: MarkerId::Tag { family, id },
        center_px: Vector2::new(u, 425.0),
        sigma_px: 4.0,
        size_px,
    };
    let prediction = FramePrediction {
        markers: vec![marker(3, 525.0, 40.0), marker(4, 755.0, 88.0)],
        search: false,
        size_range_px: Some((30.0, 110.0)),
        occupied: vec![(Vector2::new(640.0, 440.0), 220.0)],
        ..FramePrediction::default()
    };
    for features in [0, 8] {
        let settings = DetectorConfig { ground_features: features, ..DetectorConfig::default() };
        let targets = [common::target(vec![common::tag(3), common::tag(4)])];
        let mut detector = FrameDetector::new(&settings, &targets, &common::lens(1020.0, (645.0, 527.0)));
        let mut seen = FrameObservations::default();
        let mut n = 0;
        c.bench_function(&format!("detector/tracked frame/{features} features"), |b| {
            b.iter(|| {
                n += 1;
                detector.process(black_box(moved(&image, n % 2 * 4)), None, Some(&prediction), &mut seen);
            });
        });
        assert_eq!((seen.markers.len(), seen.features.len()), (2, features), "all are seen");
    }
}

criterion_group!(benches, bounds, tags, tracked);
criterion_main!(benches);
