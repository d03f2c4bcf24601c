//! Cost of the detector on frames of recorded flights: each searched as a whole, tracked, and tracked with eight ground
//! features. `cargo bench --bench flights -- CAPTURE…`. A marker is predicted at its place in the previous frame plus
//! its last step, with a sigma of four pixels. Processor time of the thread, without decoding.

use std::path::Path;

use nalgebra::Vector2;
use windhover::app::replay::config_of;
use windhover::config::Config;
use windhover::io::capture::CaptureReader;
use windhover::io::clock::HostClock;
use windhover::pixels::{self, DecodedFrame};
use windhover_base::msg::{EventBody, FrameObservations, FramePrediction, MarkerDetection, MarkerPrediction};
use windhover_detect::tracking::FrameDetector;

/// One way to process the frames of a flight, and its time.
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

    /// The prediction for the next frame.
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

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let captures: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    if captures.is_empty() {
        println!("detector/flights: skipped, no captures given (-- CAPTURE…)");
    }
    captures.iter().try_for_each(|capture| flight(Path::new(capture)))
}
