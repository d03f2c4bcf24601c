//! Prints the detector's output for drawn tags and the filter's output for a simulated flight with all bits, to compare
//! processors: `cargo run -p windhover-estimate --example bits`. Each line begins with its kind: `tag`, `input`,
//! `estimate`.

use std::sync::Arc;

use windhover_base::geo::Ground;
use windhover_base::msg::{EstimatorOutput, GrayImage, Stamped, TagFamily};
use windhover_base::settings::EstimatorConfig;
use windhover_detect::{Detector, Limits, tag_pattern};
use windhover_estimate::{Estimator, Site};
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

/// Length of the flight, seconds.
const SECONDS: f64 = 20.0;
/// Subdivisions of a pixel along each axis.
const PARTS: i64 = 4;

fn main() {
    let mut detector = Detector::new(&[TagFamily::Tag36h11], Limits::default());
    for id in 0..8 {
        for tag in detector.detect(drawn(id).view()) {
            println!("tag {tag:?}");
        }
    }
    flight();
}

/// A tag, sheared and turned: drawn with whole numbers alone, so that it is the same everywhere.
fn drawn(id: u32) -> GrayImage {
    const SCALE: i64 = 1 << 16;
    let pattern = tag_pattern(TagFamily::Tag36h11, id);
    let side = pattern.side() as i64;
    // Cells a part of a pixel, times SCALE.
    let (along, across) = (2_100 + 97 * i64::from(id), 130 * i64::from(id) - 400);
    let mut image = GrayImage::new(200, 200);
    for (at, pixel) in image.data.iter_mut().enumerate() {
        let (u, v) = ((at % 200) as i64, (at / 200) as i64);
        let mut sum = 0;
        for part in 0..PARTS * PARTS {
            let (du, dv) = (PARTS * (u - 100) + part % PARTS, PARTS * (v - 100) + part / PARTS);
            let x = (du * along + dv * across).div_euclid(SCALE) + side / 2;
            let y = (dv * along - du * across / 2).div_euclid(SCALE) + side / 2;
            let inside = (0..side).contains(&x) && (0..side).contains(&y);
            sum += if !inside || pattern.white(x as usize, y as usize) { 210 } else { 30 };
        }
        *pixel = (sum / (PARTS * PARTS)) as u8;
    }
    image
}

/// Twenty seconds behind a vehicle, as values.
fn flight() {
    let mut scenario = Scenario::named("follow").expect("a named scenario");
    scenario.duration_s = SECONDS;
    let declination_rad = scenario.declination_deg.to_radians();
    let world = Arc::new(World::new(scenario, 5));
    let site = Site { frame: *world.frame(), ground: Ground::Flat { down_m: 0.0 }, declination_rad };
    let mut filter = Estimator::new(&world.scenario().rig, &EstimatorConfig::default(), &site);
    let (mut suite, mut out) = (SensorSuite::new(Arc::clone(&world)), Vec::new());
    while let Some(sample) = suite.next() {
        println!("input {sample:?} {:?}", suite.observations());
        match &sample {
            Sample::Gnss { stamped, .. } => filter.gnss(stamped, &mut out),
            Sample::Attitude { stamped, .. } => filter.attitude(stamped, &mut out),
            Sample::Frame { truth, seq } => {
                let value = suite.observations().clone();
                let (t_valid, t_recv) = (truth.t_stamp, truth.t_recv);
                filter.frame(&Stamped { t_valid, t_recv, seq: *seq, value }, &mut out);
            }
        }
        for output in out.drain(..) {
            if let EstimatorOutput::Estimate(estimate) = output {
                println!("estimate {estimate:?}");
            }
        }
    }
}
