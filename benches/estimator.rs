//! Scores the estimator on simulated flights, without pixels or bytes, and prints a table.
//!
//! `cargo bench --bench estimator -- [--runs N] [--seconds S] [--no-features] [SCENARIO…]`

use std::sync::Arc;

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use windhover::config::Config;
use windhover::estimate::{Bound, BoundTruth, Estimator, EstimatorOutput, PaperEstimator, Site};
use windhover::geo::{Ground, wrap_angle};
use windhover::io::clock::HostClock;
use windhover::msg::{Stamped, TargetEstimate, TrackStatus};
use windhover::simulate::{Sample, Scenario, SensorSuite, World};
use windhover::time::{MonoTime, Span};

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

/// The truth as the bound takes it.
fn truth_at(world: &World, t: MonoTime, gps_delay_s: f64) -> BoundTruth {
    let own = world.ownship(t);
    let targets = (0..world.vehicles()).map(|i| {
        let v = world.vehicle(i, t);
        [v.north_m, v.east_m, v.heading_rad, v.speed_mps, v.yaw_rate_radps]
    });
    BoundTruth {
        position: own.position_ned_m,
        velocity: own.velocity_ned_mps,
        acceleration: own.acceleration_ned_mps2,
        ned_from_body: own.ned_from_body,
        rate: own.body_rate_radps,
        tilt_gain: world.scenario().compass.tilt_gain,
        drag_per_s: world.scenario().helicopter.drag_per_s,
        gps_delay_s,
        targets: targets.collect(),
    }
}

/// The configuration whose intensities of motion are those of the true motion, from its increments
/// over about as long as the filter remembers (0.2 s with ground features, else 0.5 s), and whose
/// noise figures are the true ones.
fn told_the_truth(world: &World) -> Config {
    let step_s = if world.scenario().camera.features > 0 { 0.2 } else { 0.5 };
    let scenario = world.scenario();
    let mut config = scenario.config.clone();
    let times = || (0..).map(|k| BURN_S + step_s * f64::from(k)).take_while(|t| *t < scenario.duration_s);
    let rms = |increment: &dyn Fn(f64) -> f64| {
        let (sum, n) = times().fold((0.0, 0.0), |(s, n), t| (s + increment(t).powi(2), n + 1.0));
        f64::sqrt(sum / f64::max(n, 1.0))
    };
    let walk = |value: &dyn Fn(MonoTime) -> f64| {
        rms(&|t| value(world.time(t + step_s)) - value(world.time(t))) / step_s.sqrt()
    };
    let e = &mut config.estimator;
    let vehicle = |t| world.vehicle(0, t);
    // A vehicle at rest has no intensity at all; a figure must be positive.
    e.target_speed_walk = walk(&|t| vehicle(t).speed_mps).max(0.02);
    e.target_yaw_rate_walk = walk(&|t| vehicle(t).yaw_rate_radps).max(0.01);
    let rate = |axis: usize| walk(&|t| world.ownship(t).body_rate_radps[axis]);
    e.tilt_rate_walk = (0.5 * (rate(0).powi(2) + rate(1).powi(2))).sqrt();
    e.yaw_rate_walk = rate(2);
    let force = |axis: usize| {
        walk(&|t| {
            let own = world.ownship(t);
            let drag = own.velocity_ned_mps * scenario.helicopter.drag_per_s;
            let felt = own.acceleration_ned_mps2 + drag - Vector3::z() * 9.806_65;
            (own.ned_from_body.inverse() * felt)[axis]
        })
    };
    // A Gauss–Markov process of variance s² walks by 2 s²/τ.
    let sigma = |walk: f64| walk * (0.5 * e.force_tau_s).sqrt();
    (e.side_force_mps2, e.thrust_mps2) = (sigma((force(0) * force(1)).sqrt()), sigma(force(2)));
    let (gps, compass) = (&scenario.gps, &scenario.compass);
    (e.marker_noise_px, e.feature_sigma_factor) = (0.0, 1.0);
    (config.gps.bias_sigma_m, config.gps.noise_m) = (gps.bias_sigma_m, gps.noise_m);
    config.gps.velocity_noise_mps = gps.velocity_noise_mps;
    config.compass.heading_noise_deg = compass.heading_noise_deg;
    config.compass.tilt_noise_deg = compass.tilt_noise_deg;
    config
}

/// Mean variances of the bound over a run, of every target.
#[derive(Default)]
struct BoundScore {
    frames: f64,
    variance: SVector<f64, 5>,
}

impl BoundScore {
    fn add(&mut self, covariance: &SMatrix<f64, 5, 5>) {
        self.frames += 1.0;
        self.variance += covariance.diagonal();
    }

    fn figures(&self) -> Figures {
        let rms = |i: usize| (self.variance[i] / self.frames.max(1.0)).sqrt();
        let none = f64::NAN;
        Figures([none, rms(2).to_degrees(), rms(3), rms(4), none, none, none, none])
    }
}

/// The bound over a flight: its measurements in order of when they were true.
fn bound(world: &Arc<World>, site: &Site) -> Figures {
    let mut suite = SensorSuite::new(Arc::clone(world));
    let delay_s = suite.gps_latency_error().s();
    let mut taken = Vec::new();
    while let Some(sample) = suite.next() {
        let t = match &sample {
            Sample::Gnss { stamped, .. } => stamped.t_valid - Span::from_s(delay_s),
            Sample::Attitude { t_true, .. } => *t_true,
            Sample::Frame { truth, .. } => truth.t_true,
        };
        let seen = matches!(sample, Sample::Frame { .. }).then(|| suite.observations().clone());
        taken.push((t, sample, seen));
    }
    taken.sort_by_key(|(t, ..)| *t);
    let mut bound = Bound::new(&told_the_truth(world), site);
    let mut score = BoundScore::default();
    for (t, sample, seen) in &taken {
        // A fix enters where its stamp puts it, with the delay that is to be learnt.
        let truth = truth_at(world, *t, 0.0);
        match sample {
            Sample::Gnss { stamped, .. } => bound.gnss(*t, &stamped.value, &truth),
            Sample::Attitude { stamped, .. } => bound.attitude(*t, &stamped.value, &truth),
            Sample::Frame { .. } => {
                if let Some(seen) = seen {
                    bound.frame(*t, seen, &truth);
                }
                let scored = world.seconds(*t) >= BURN_S;
                for target in (0..world.vehicles()).filter(|_| scored) {
                    if let Some(covariance) = bound.target(target) {
                        score.add(&covariance);
                    }
                }
            }
        }
    }
    score.figures()
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
    bound: Figures,
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
    let (mut busy, mut frames, mut resets) = (Span::ZERO, 0usize, 0usize);
    let offset = Span::from_ms(config.camera.exposure_offset_ms);
    let error = suite.gps_latency_error().ms();
    while let Some(sample) = suite.next() {
        let begun = HostClock::thread_processor_time();
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
                EstimatorOutput::Estimate(e) => f.add(&e, &world),
                EstimatorOutput::Smoothed(e) => s.add(&e, &world),
                EstimatorOutput::Reset { .. } | EstimatorOutput::Anchored { .. } => resets += 1,
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
        bound: bound(&world, &site),
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
        println!("{name:<18} bound     {}", of(|r| r.bound));
        let n = results.len() as f64;
        let mean = |pick: fn(&Run) -> f64| results.iter().map(pick).sum::<f64>() / n;
        println!(
            "{name:<18} {:.0} us of processor a frame, {} resets, GPS delay error {:.1} ms rms",
            mean(|r| r.us_per_frame),
            results.iter().map(|r| r.resets).sum::<usize>(),
            mean(|r| r.delay_error_ms.powi(2)).sqrt()
        );
    }
}
