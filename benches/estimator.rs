//! Scores the estimator on simulated flights, without pixels or bytes, and prints a table.
//!
//! `cargo bench --bench estimator -- [--runs N] [--seconds S] [--no-features] [SCENARIO…]`

use std::sync::Arc;
use std::time::Instant;

use nalgebra::{Matrix3, SMatrix, SVector};
use windhover::estimate::{Estimator, EstimatorOutput, PaperEstimator, Site};
use windhover::geo::{Ground, wrap_angle};
use windhover::msg::{Stamped, TargetEstimate, TrackStatus};
use windhover::simulate::{Sample, Scenario, SensorSuite, World};
use windhover::time::Span;

/// What is scored begins here, seconds into the flight.
const BURN_S: f64 = 6.0;

/// Squared errors of one run.
#[derive(Default, Clone)]
struct Score {
    frames: usize,
    owed: usize,
    squared: SVector<f64, 5>,
    sum: SVector<f64, 5>,
    nees3: f64,
    nees5: f64,
    nees2: f64,
    lost: usize,
}

impl Score {
    fn add(&mut self, estimate: &TargetEstimate, world: &World) {
        let truth = world.vehicle(estimate.target, estimate.t_valid);
        if world.seconds(estimate.t_valid) < BURN_S {
            return;
        }
        self.owed += 1;
        let live = matches!(estimate.status, TrackStatus::Tracking | TrackStatus::Coasting);
        let Some(state) = estimate.state.filter(|_| live) else {
            self.lost += 1;
            return;
        };
        let reference = truth.reference(world.scenario().config.target[estimate.target].reference_m);
        let e = SVector::<f64, 5>::from([
            state.north_m - reference.x,
            state.east_m - reference.y,
            wrap_angle(state.heading_rad - truth.heading_rad),
            state.speed_mps - truth.speed_mps,
            state.yaw_rate_radps - truth.yaw_rate_radps,
        ]);
        self.frames += 1;
        self.squared += e.component_mul(&e);
        self.sum += e;
        if let Some(p) = state.covariance {
            let last: Matrix3<f64> = p.fixed_view::<3, 3>(2, 2).into();
            let e3 = e.fixed_rows::<3>(2).into_owned();
            self.nees3 += last.try_inverse().map_or(f64::NAN, |i| (e3.transpose() * i * e3)[0]);
            self.nees5 +=
                p.try_inverse().map_or(f64::NAN, |i: SMatrix<f64, 5, 5>| (e.transpose() * i * e)[0]);
            let two = p.fixed_view::<2, 2>(0, 0).into_owned();
            let e2 = e.fixed_rows::<2>(0).into_owned();
            self.nees2 += two.try_inverse().map_or(f64::NAN, |i| (e2.transpose() * i * e2)[0]);
        }
    }

    fn figures(&self) -> Figures {
        let n = self.frames.max(1) as f64;
        let mean = self.sum / n;
        let rms = |i: usize| (self.squared[i] / n).sqrt();
        let rel = ((self.squared[0] + self.squared[1]) / n - mean[0] * mean[0] - mean[1] * mean[1]).max(0.0);
        Figures([
            rel.sqrt(),
            rms(2).to_degrees(),
            rms(3),
            rms(4),
            self.nees3 / n,
            self.nees5 / n,
            self.nees2 / n,
            self.frames as f64 / self.owed.max(1) as f64,
        ])
    }
}

/// rel m, heading deg, speed, yaw rate, NEES of three, of five, of position, coverage.
#[derive(Clone, Copy)]
struct Figures([f64; 8]);

/// Mean square over runs (plain mean of the NEES and coverage) with the spread over runs.
fn summary(runs: &[Figures]) -> String {
    let n = runs.len() as f64;
    let mut text = String::new();
    for i in 0..8 {
        let values = runs.iter().map(|f| f.0[i]);
        let mean = if i < 4 {
            (values.clone().map(|x| x * x).sum::<f64>() / n).sqrt()
        } else {
            values.clone().sum::<f64>() / n
        };
        let spread = (values.map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
        let cell = if i == 7 { format!("{mean:6.3}") } else { format!("{mean:7.3}±{spread:<6.3}") };
        text += &cell;
        text.push(' ');
    }
    text
}

struct Run {
    filter: Figures,
    smoothed: Figures,
    paper: Figures,
    us_per_frame: f64,
    resets: usize,
    delay_error_ms: f64,
}

fn run(scenario: &Scenario, seed: u64, verbose: bool) -> Run {
    let world = Arc::new(World::new(scenario.clone(), seed));
    let config = &world.scenario().config;
    let site = Site {
        frame: *world.frame(),
        ground: Ground::Flat { down_m: 0.0 },
        declination_rad: scenario.declination_deg.to_radians(),
    };
    let mut filter = Estimator::new(config, &site);
    let mut paper = PaperEstimator::new(config, &site);
    let mut suite = SensorSuite::new(Arc::clone(&world));
    let (mut out, mut paper_out) = (Vec::new(), Vec::new());
    let (mut f, mut s, mut p) = (Score::default(), Score::default(), Score::default());
    let (mut busy, mut frames, mut resets) = (std::time::Duration::ZERO, 0usize, 0usize);
    let offset = Span::from_ms(config.camera.exposure_offset_ms);
    let error = suite.gps_latency_error().ms();
    while let Some(sample) = suite.next() {
        let begun = Instant::now();
        match &sample {
            Sample::Gnss { stamped, .. } => filter.gnss(stamped, &mut out),
            Sample::Attitude { stamped, .. } => filter.attitude(stamped, &mut out),
            Sample::Frame { truth, seq } => {
                frames += 1;
                let frame = Stamped {
                    t_valid: truth.t_stamp + offset,
                    t_recv: truth.t_recv,
                    seq: *seq,
                    value: suite.observations().clone(),
                };
                filter.frame(&frame, &mut out);
            }
        }
        busy += begun.elapsed();
        match &sample {
            Sample::Gnss { stamped, .. } => paper.gnss(stamped, &mut paper_out),
            Sample::Attitude { stamped, .. } => paper.attitude(stamped, &mut paper_out),
            Sample::Frame { truth, seq } => {
                let value = suite.observations().clone();
                let (t_valid, t_recv) = (truth.t_stamp + offset, truth.t_recv);
                paper.frame(&Stamped { t_valid, t_recv, seq: *seq, value }, &mut paper_out);
            }
        }
        if verbose && matches!(sample, Sample::Frame { .. }) && frames % 15 == 0 {
            println!("{:6.2} {}", world.seconds(sample.t_recv()), filter.inside());
        }
        for output in out.drain(..) {
            match output {
                EstimatorOutput::Estimate(e) => f.add(&e, &world),
                EstimatorOutput::Smoothed(e) => s.add(&e, &world),
                EstimatorOutput::Reset { .. } => resets += 1,
                EstimatorOutput::Ownship(_) | EstimatorOutput::Fusion(_) => {}
            }
        }
        for estimate in paper_out.drain(..) {
            p.add(&estimate, &world);
        }
    }
    Run {
        filter: f.figures(),
        smoothed: s.figures(),
        paper: p.figures(),
        us_per_frame: busy.as_secs_f64() * 1e6 / frames.max(1) as f64,
        resets,
        delay_error_ms: filter.gps_delay_s() * 1e3 - error,
    }
}

fn main() {
    let mut runs = 6;
    let mut seconds = None;
    let mut features = None;
    let mut names = Vec::new();
    let mut verbose = false;
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--runs" => runs = arguments.next().and_then(|n| n.parse().ok()).expect("--runs takes a number"),
            "--seconds" => seconds = arguments.next().and_then(|n| n.parse().ok()),
            "--no-features" => features = Some(0),
            "--verbose" => verbose = true,
            "--bench" => {}
            name => names.push(name.to_owned()),
        }
    }
    if names.is_empty() {
        names = Scenario::names().iter().map(|(name, _)| (*name).to_owned()).collect();
    }
    println!(
        "{:<18} {:<9} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>14} {:>6}",
        "scenario",
        "method",
        "rel m",
        "heading deg",
        "speed m/s",
        "yaw rate",
        "NEES3",
        "NEES5",
        "NEES pos",
        "cover"
    );
    for name in names {
        let mut scenario = Scenario::named(&name).unwrap_or_else(|| panic!("no scenario {name}"));
        scenario.duration_s = seconds.unwrap_or(scenario.duration_s);
        scenario.camera.features = features.unwrap_or(scenario.camera.features);
        let results: Vec<Run> = (0..runs).map(|seed| run(&scenario, seed + 1, verbose)).collect();
        let of = |pick: fn(&Run) -> Figures| summary(&results.iter().map(pick).collect::<Vec<_>>());
        println!("{name:<18} filter    {}", of(|r| r.filter));
        println!("{name:<18} smoothed  {}", of(|r| r.smoothed));
        println!("{name:<18} paper     {}", of(|r| r.paper));
        let n = results.len() as f64;
        let mean = |pick: fn(&Run) -> f64| results.iter().map(pick).sum::<f64>() / n;
        println!(
            "{name:<18} {:.0} us a frame, {} resets, GPS delay error {:.1} ms rms",
            mean(|r| r.us_per_frame),
            results.iter().map(|r| r.resets).sum::<usize>(),
            mean(|r| r.delay_error_ms.powi(2)).sqrt()
        );
    }
}
