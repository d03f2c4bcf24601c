//! Scores the estimator on simulated flights, without pixels or bytes, and prints a table.
//!
//! `cargo bench --bench estimator -- [--runs N] [--seconds S] [--no-features] [--marker-px X] [--feature-px X]
//! [--no-bound] [SCENARIO[+DEVIATION[=FIGURE]]…]…`

mod bound;
mod score;

use std::sync::Arc;

use windhover::io::clock::HostClock;
use windhover_base::geo::Ground;
use windhover_base::msg::Stamped;
use windhover_base::settings::EstimatorConfig;
use windhover_base::time::{FrameClock, Span};
use windhover_estimate::{Estimator, EstimatorOutput, PaperEstimator, Site};
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

use bound::bound;
use score::{Figures, Score, line, mean_and_spread, shows, summary};

struct Run {
    filter: Figures,
    in_view: Figures,
    smoothed: Figures,
    paper: Figures,
    bound: Figures,
    /// NEES of heading, speed and yaw rate each.
    apart: [f64; 3],
    us_per_frame: f64,
    resets: usize,
    delay_error_ms: f64,
}

fn run(scenario: &Scenario, seed: u64, with_bound: bool, verbose: bool) -> Run {
    let world = Arc::new(World::new(scenario.clone(), seed));
    let rig = &world.scenario().rig;
    let site = Site {
        frame: *world.frame(),
        ground: Ground::Flat { down_m: scenario.configured_ground_down_m().unwrap_or(0.0) },
        declination_rad: scenario.rig.compass.declination_deg.unwrap_or(0.0).to_radians(),
    };
    let mut filter = Estimator::new(rig, &EstimatorConfig::default(), &site);
    let mut paper = PaperEstimator::new(rig, &EstimatorConfig::default(), &site);
    let mut suite = SensorSuite::new(Arc::clone(&world));
    let (mut out, mut paper_out) = (Vec::new(), Vec::new());
    let (mut f, mut s, mut p) = (Score::default(), Score::default(), Score::default());
    let mut in_view = Score::default();
    let (mut busy, mut frames, mut resets) = (Span::ZERO, 0usize, 0usize);
    let offset = Span::from_ms(rig.camera.exposure_offset_ms);
    let error = suite.gps_latency_error().ms();
    let mut exposures = FrameClock::default();
    while let Some(sample) = suite.next() {
        let begun = HostClock::thread_processor_time();
        match &sample {
            Sample::Gnss { stamped, .. } => filter.gnss(stamped, &mut out),
            Sample::Attitude { stamped, .. } => filter.attitude(stamped, &mut out),
            Sample::Frame { truth, seq } => {
                frames += 1;
                let frame = Stamped {
                    t_valid: exposures.exposed(truth.t_stamp, truth.t_recv) + offset,
                    t_recv: truth.t_recv,
                    seq: *seq,
                    value: suite.observations().clone(),
                };
                filter.frame(&frame, &mut out);
            }
        }
        busy = busy + (HostClock::thread_processor_time() - begun);
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
                EstimatorOutput::Estimate(e) => {
                    if verbose {
                        println!("{}", line(&e, &world));
                    }
                    f.add(&e, &world);
                    if shows(suite.observations(), rig, e.target) {
                        in_view.add(&e, &world);
                    }
                }
                EstimatorOutput::Smoothed(e) => s.add(&e, &world),
                EstimatorOutput::Reset { .. } | EstimatorOutput::Anchored { .. } => resets += 1,
                EstimatorOutput::Coasted(_)
                | EstimatorOutput::Ownship(_)
                | EstimatorOutput::Fusion(_)
                | EstimatorOutput::TiltFelt { .. }
                | EstimatorOutput::Misfit(_) => {}
            }
        }
        for estimate in paper_out.drain(..) {
            p.add(&estimate, &world);
        }
    }
    Run {
        filter: f.figures(),
        in_view: in_view.figures(),
        smoothed: s.figures(),
        paper: p.figures(),
        bound: if with_bound { bound(&world, &site) } else { Figures([f64::NAN; 8]) },
        apart: f.apart(),
        us_per_frame: busy.s() * 1e6 / frames.max(1) as f64,
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
    let mut with_bound = true;
    let (mut marker_px, mut feature_px) = (None, None);
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--runs" => runs = arguments.next().and_then(|n| n.parse().ok()).expect("--runs takes a number"),
            "--seconds" => seconds = arguments.next().and_then(|n| n.parse().ok()),
            "--no-features" => features = Some(0),
            "--no-bound" => with_bound = false,
            "--marker-px" => marker_px = arguments.next().and_then(|n| n.parse().ok()),
            "--feature-px" => feature_px = arguments.next().and_then(|n| n.parse().ok()),
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
        let mut scenario = Scenario::described(&name).unwrap_or_else(|e| panic!("{name}: {e}"));
        scenario.duration_s = seconds.unwrap_or(scenario.duration_s);
        scenario.camera.features = features.unwrap_or(scenario.camera.features);
        scenario.camera.marker_noise_px = marker_px.unwrap_or(scenario.camera.marker_noise_px);
        scenario.camera.feature_noise_px = feature_px.unwrap_or(scenario.camera.feature_noise_px);
        let results: Vec<Run> = (0..runs).map(|seed| run(&scenario, seed + 1, with_bound, verbose)).collect();
        for (seed, r) in results.iter().enumerate().filter(|_| verbose) {
            let [_, heading, speed, yaw_rate, nees, ..] = r.filter.0;
            println!(
                "seed {}: {heading:.3} deg {speed:.3} m/s {yaw_rate:.3} rad/s, NEES {nees:.2} {:.2?}",
                seed + 1,
                r.apart
            );
        }
        let of = |pick: fn(&Run) -> Figures| summary(&results.iter().map(pick).collect::<Vec<_>>());
        println!("{name:<18} filter    {}", of(|r| r.filter));
        println!("{name:<18} in view   {}", of(|r| r.in_view));
        println!("{name:<18} smoothed  {}", of(|r| r.smoothed));
        println!("{name:<18} paper     {}", of(|r| r.paper));
        println!("{name:<18} bound     {}", of(|r| r.bound));
        let ratio = |i: usize| {
            let rms =
                |pick: fn(&Run) -> Figures| results.iter().map(|r| pick(r).0[i].powi(2)).sum::<f64>().sqrt();
            rms(|r| r.in_view) / rms(|r| r.bound)
        };
        println!("{name:<18} of the bound, in view: {:.3} {:.3} {:.3}", ratio(1), ratio(2), ratio(3));
        let n = results.len() as f64;
        let mean = |pick: fn(&Run) -> f64| results.iter().map(pick).sum::<f64>() / n;
        let apart = |i: usize| {
            let (mean, spread) = mean_and_spread(results.iter().map(|r| r.apart[i]), false);
            format!("{mean:.2}±{spread:.2}")
        };
        println!("{name:<18} NEES of heading {}, speed {}, yaw rate {}", apart(0), apart(1), apart(2));
        println!(
            "{name:<18} {:.0} us of processor a frame, {} resets, GPS delay error {:.1} ms rms",
            mean(|r| r.us_per_frame),
            results.iter().map(|r| r.resets).sum::<usize>(),
            mean(|r| r.delay_error_ms.powi(2)).sqrt()
        );
    }
}
