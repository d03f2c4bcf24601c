//! What a frame costs the detector: whole frames at two smallest sizes, a tracked region, ground features.
//!
//! `cargo bench --bench detector`. The frame is generated: textured ground, noise, two tags of 40 and 90 px.
//!
//! `cargo bench --bench detector -- --flights CAPTURE…`: the frames of recorded flights instead, each searched
//! whole, tracked, and tracked with eight ground features. A marker is foretold where it was in the frame before,
//! plus its last step, with a sigma of four pixels. Processor time of the thread, decoding left out.

use std::hint::black_box;
use std::path::Path;

use criterion::{Criterion, criterion_group};
use nalgebra::Vector2;
use rand::{Rng, SeedableRng};
use windhover::app::replay::config_of;
use windhover::config::Config;
use windhover::io::capture::CaptureReader;
use windhover::io::clock::HostClock;
use windhover::pixels::{self, DecodedFrame};
use windhover_base::msg::TagFamily;
use windhover_base::msg::{
    EventBody, FrameObservations, FramePrediction, GrayImage, ImageView, MarkerDetection, MarkerId,
    MarkerPrediction,
};
use windhover_detect::{FrameDetector, Region, Simd, TagDetector, tag_pattern};

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
    let mut out = Vec::new();
    for min_px in [24.0, 16.0] {
        for (name, simd) in [("best", Simd::best()), ("scalar", Simd::scalar())] {
            let mut detector = TagDetector::new(&[TagFamily::Tag36h11], min_px, 2).with_simd(simd);
            detector.detect(image.view(), &mut out);
            assert_eq!(out.len(), 2, "both tags are found");
            c.bench_function(&format!("detector/frame 1280x1024/min {min_px} px/{name}"), |b| {
                b.iter(|| {
                    out.clear();
                    detector.detect(black_box(image.view()), &mut out);
                });
            });
            out.clear();
        }
    }
    let mut detector = TagDetector::new(&[TagFamily::Tag36h11], 24.0, 2);
    let region = Region::around(image.view(), Vector2::new(525.0, 425.0), 127.5).expect("inside the frame");
    c.bench_function("detector/region 256x256", |b| {
        b.iter(|| {
            out.clear();
            detector.detect_region(black_box(image.view()), region, &mut out);
        });
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

/// A frame while tracking: both tags where they were foretold, one strip of the rest, eight ground features.
fn tracked(c: &mut Criterion) {
    let image = frame();
    let text =
        include_str!("../config/windhover.toml").replace("id = 0", "id = 3").replace("id = 1", "id = 4");
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
    };
    for features in [0, 8] {
        let mut config = Config::parse(&text).expect("the shipped configuration");
        config.detector.ground_features = features;
        let mut detector = FrameDetector::new(&config.detector, &config.target, &config.camera.intrinsics);
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

/// One way to look at the frames of a flight, and what it took.
struct Way {
    name: &'static str,
    track: bool,
    detector: FrameDetector,
    before: Vec<MarkerDetection>,
    prediction: FramePrediction,
    seen: FrameObservations,
    ms: Vec<f64>,
    markers: usize,
}

impl Way {
    fn new(name: &'static str, config: &Config, track: bool, features: usize) -> Self {
        let mut config = config.clone();
        config.detector.ground_features = features;
        Self {
            name,
            track,
            detector: FrameDetector::new(&config.detector, &config.target, &config.camera.intrinsics),
            before: Vec::new(),
            prediction: FramePrediction::default(),
            seen: FrameObservations::default(),
            ms: Vec::new(),
            markers: 0,
        }
    }

    fn take(&mut self, image: &DecodedFrame) {
        let prediction = (self.track && !self.seen.markers.is_empty()).then_some(&self.prediction);
        self.before.clone_from(&self.seen.markers);
        let start = HostClock::thread_processor_time();
        self.detector.process(image.gray.view(), image.rgb.as_ref(), prediction, &mut self.seen);
        self.ms.push((HostClock::thread_processor_time() - start).ms());
        self.markers += self.seen.markers.len();
        self.foretell();
    }

    /// What the next frame should show.
    fn foretell(&mut self) {
        self.prediction.markers.clear();
        self.prediction.occupied.clear();
        for m in &self.seen.markers {
            let was = self.before.iter().find(|b| b.marker == m.marker);
            let step = was.map_or(Vector2::zeros(), |b| m.center_px - b.center_px);
            let center_px = m.center_px + step;
            self.prediction.markers.push(MarkerPrediction {
                marker: m.marker,
                center_px,
                sigma_px: 4.0,
                size_px: m.size_px,
            });
            self.prediction.occupied.push((center_px, 2.0 * m.size_px));
        }
        let sizes = self.seen.markers.iter().map(|m| m.size_px);
        let range = sizes.fold((f64::MAX, 0.0f64), |(low, high), s| (low.min(s), high.max(s)));
        self.prediction.size_range_px = (range.1 > 0.0).then_some((0.8 * range.0, 1.2 * range.1));
    }

    fn report(&mut self) {
        self.ms.sort_by(f64::total_cmp);
        let at = |share: f64| self.ms[((self.ms.len() - 1) as f64 * share) as usize];
        println!(
            "| {} | {} | {:.3} | {:.3} | {} |",
            self.name,
            self.ms.len(),
            at(0.5),
            at(0.95),
            self.markers
        );
    }
}

fn flight(capture: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let config = config_of(capture)?;
    let mut ways = [
        Way::new("whole frame", &config, false, 0),
        Way::new("tracked", &config, true, 0),
        Way::new("tracked, 8 features", &config, true, 8),
    ];
    for item in CaptureReader::open(capture)? {
        let Some(EventBody::Frame(payload)) = item.event.map(|event| event.body) else { continue };
        let image = pixels::decode(&payload, true)?;
        ways.iter_mut().for_each(|way| way.take(&image));
    }
    println!(
        "{}\n| | frames | median ms | p95 ms | markers seen |\n|---|---|---|---|---|",
        capture.display()
    );
    ways.iter_mut().filter(|way| !way.ms.is_empty()).for_each(Way::report);
    Ok(())
}

criterion_group!(benches, tags, tracked);

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    if let Some(at) = arguments.iter().position(|a| a == "--flights") {
        let mut captures = arguments[at + 1..].iter().filter(|a| !a.starts_with("--"));
        return captures.try_for_each(|capture| flight(Path::new(capture)));
    }
    benches();
    Criterion::default().configure_from_args().final_summary();
    println!("detector/flights: skipped, no captures given (-- --flights CAPTURE…)");
    Ok(())
}
