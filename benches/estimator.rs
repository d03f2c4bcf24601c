//! Scores the estimator on simulated flights, without pixels or bytes, and prints a table.
//!
//! `cargo bench --bench estimator -- [--runs N] [--seconds S] [--no-features] [--marker-px X] [--feature-px X]
//! [--no-bound] [SCENARIO[+DEVIATION[=FIGURE]]…]…`

use std::sync::Arc;

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use windhover::io::clock::HostClock;
use windhover_base::geo::{Ground, wrap_angle};
use windhover_base::msg::{FrameObservations, MarkerId, Stamped, TargetEstimate, TrackStatus};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::{FrameClock, MonoTime, Span};
use windhover_estimate::{Bound, BoundTruth, Estimator, EstimatorOutput, PaperEstimator, Site};
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

/// Scores start here, seconds into the flight.
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
    /// Of heading, speed and yaw rate each.
    apart: [f64; 3],
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
        let reference = truth.reference(world.scenario().rig.target[estimate.target].reference_m);
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
            for (i, sum) in self.apart.iter_mut().enumerate() {
                *sum += e[2 + i] * e[2 + i] / p[(2 + i, 2 + i)];
            }
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

    fn apart(&self) -> [f64; 3] {
        self.apart.map(|sum| sum / self.frames.max(1) as f64)
    }
}

/// An estimate and the truth: each error with its sigma.
fn line(e: &TargetEstimate, world: &World) -> String {
    let head = format!("{:6.2} target {} {:?}", world.seconds(e.t_valid), e.target, e.status);
    let Some((state, p)) = e.state.as_ref().and_then(|s| Some((s, s.covariance?))) else { return head };
    let truth = world.vehicle(e.target, e.t_valid);
    let reference = truth.reference(world.scenario().rig.target[e.target].reference_m);
    let sigma = |i: usize| p[(i, i)].sqrt();
    format!(
        "{head} north {:.2}±{:.2} m, east {:.2}±{:.2} m, heading {:.2}±{:.2} deg, speed {:.3}±{:.3} m/s, \
         yaw rate {:.4}±{:.4} rad/s",
        state.north_m - reference.x,
        sigma(0),
        state.east_m - reference.y,
        sigma(1),
        wrap_angle(state.heading_rad - truth.heading_rad).to_degrees(),
        sigma(2).to_degrees(),
        state.speed_mps - truth.speed_mps,
        sigma(3),
        state.yaw_rate_radps - truth.yaw_rate_radps,
        sigma(4),
    )
}

/// The truth in the form for the bound.
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
        tilt_error: (0.0, 30.0),
        drag_per_s: world.scenario().helicopter.drag_per_s,
        gps_delay_s,
        targets: targets.collect(),
    }
}

/// Intensities of motion: a target's speed and yaw rate, the helicopter's rates about its roll and pitch axes and about
/// its yaw axis, forces other than thrust along its axis, its thrust; units²/s.
type Intensities = [f64; 6];

/// Limits of the time scale of intensities, s.
const SCALES_S: (f64, f64) = (0.1, 5.0);
/// Time scale at which the filter learns the motion of the helicopter, and at which the bound starts, s.
const LEARNT_OVER_S: f64 = 0.4;

/// Intensities of the true motion, each by its increments over its own `scale`.
fn intensities(world: &World, scales_s: &[f64; 6]) -> Intensities {
    let scenario = world.scenario();
    let components = |t: MonoTime| -> [f64; 8] {
        let (vehicle, own) = (world.vehicle(0, t), world.ownship(t));
        let drag = own.velocity_ned_mps * scenario.helicopter.drag_per_s;
        let felt = own.acceleration_ned_mps2 + drag - Vector3::z() * 9.806_65;
        let axis = own.ned_from_body * Vector3::z();
        let (gust, rate) = (felt - axis * (felt.z / axis.z), own.body_rate_radps);
        [vehicle.speed_mps, vehicle.yaw_rate_radps, rate.x, rate.y, rate.z, gust.x, gust.y, felt.z]
    };
    let walk = |kind: usize, places: &[usize]| {
        let step_s = scales_s[kind];
        let times =
            (0..).map(|k| BURN_S + 0.1 * f64::from(k)).take_while(|t| t + step_s < scenario.duration_s);
        let (sum, n) = times.fold((0.0, 0.0), |(sum, n), t| {
            let (a, b) = (components(world.time(t)), components(world.time(t + step_s)));
            (sum + places.iter().map(|i| (b[*i] - a[*i]).powi(2)).sum::<f64>(), n + places.len() as f64)
        });
        sum / f64::max(n, 1.0) / step_s
    };
    // A vehicle at rest has intensity zero; a configured value must be positive.
    [
        walk(0, &[0]).max(4e-4),
        walk(1, &[1]).max(1e-4),
        walk(2, &[2, 3]).max(1e-8),
        walk(3, &[4]).max(1e-8),
        walk(4, &[5, 6]).max(1e-8),
        walk(5, &[7]).max(1e-8),
    ]
}

/// Correlation time of the thrust beyond the weight in the filter's model, s.
const THRUST_TAU_S: f64 = 2.0;

/// The configuration with these intensities and the true noise.
fn configured_with_truth(world: &World, q: &Intensities) -> (Rig, EstimatorConfig) {
    let scenario = world.scenario();
    let mut rig = scenario.rig.clone();
    let mut e = EstimatorConfig::default();
    (e.target_speed_walk, e.target_yaw_rate_walk) = (q[0].sqrt(), q[1].sqrt());
    (e.tilt_rate_walk, e.yaw_rate_walk) = (q[2].sqrt(), q[3].sqrt());
    // A Gauss–Markov process of variance s² walks by 2 s²/τ.
    let sigma = |q: f64, tau_s: f64| (q * 0.5 * tau_s).sqrt();
    (e.side_force_mps2, e.thrust_mps2) = (sigma(q[4], e.force_tau_s), sigma(q[5], THRUST_TAU_S));
    let (gps, compass) = (&scenario.gps, &scenario.compass);
    (e.marker_noise_px, e.feature_sigma_factor) = (0.0, 1.0);
    (rig.gps.bias_sigma_m, rig.gps.noise_m) = (gps.bias_sigma_m, gps.noise_m);
    rig.gps.velocity_noise_mps = gps.velocity_noise_mps;
    rig.compass.heading_noise_deg = compass.heading_noise_deg;
    rig.compass.tilt_noise_deg = compass.tilt_noise_deg;
    (rig, e)
}

/// Whether a frame shows a marker of a target.
fn shows(seen: &FrameObservations, rig: &Rig, target: usize) -> bool {
    seen.markers.iter().any(|detection| match detection.marker {
        MarkerId::Disc { target: of, .. } => of == target,
        MarkerId::Tag { id, .. } => rig.target[target].marker.iter().any(|marker| marker.id == Some(id)),
    })
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

    /// Memory of an optimal filter for speed and yaw rate: `4/3 P/q`.
    fn scales_s(&self, q: &Intensities) -> [f64; 2] {
        let p = [self.variance[3], self.variance[4]].map(|sum| sum / self.frames.max(1.0));
        std::array::from_fn(|i| (4.0 / 3.0 * p[i] / q[i]).clamp(SCALES_S.0, SCALES_S.1))
    }

    fn figures(&self) -> Figures {
        let rms = |i: usize| (self.variance[i] / self.frames.max(1.0)).sqrt();
        let none = f64::NAN;
        Figures([none, rms(2).to_degrees(), rms(3), rms(4), none, none, none, none])
    }
}

/// The bound over a flight: its measurements in order of validity. Motion is smoother than a random walk, so the
/// describing walk depends on the time scale: for the helicopter 0.4 s, as in the filter; for vehicles the bound's own
/// memory of the component, found by iteration.
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
    let mut scales_s = [LEARNT_OVER_S; 6];
    let mut score = BoundScore::default();
    for _ in 0..PASSES {
        let q = intensities(world, &scales_s);
        score = bound_pass(world, site, &configured_with_truth(world, &q), &taken);
        scales_s[..2].copy_from_slice(&score.scales_s(&q));
    }
    score.figures()
}

/// The measurements of a flight, their times of validity, and the detections of the frames.
type Taken = Vec<(MonoTime, Sample, Option<FrameObservations>)>;
/// Iterations of the bound until the time scales agree with it.
const PASSES: usize = 4;

fn bound_pass(world: &World, site: &Site, configured: &(Rig, EstimatorConfig), taken: &Taken) -> BoundScore {
    let mut bound = Bound::new(&configured.0, &configured.1, site);
    let mut score = BoundScore::default();
    for (t, sample, seen) in taken {
        // A fix enters at its stamp, with the delay that is to be estimated.
        let truth = truth_at(world, *t, 0.0);
        match sample {
            Sample::Gnss { stamped, .. } => bound.gnss(*t, &stamped.value, &truth),
            Sample::Attitude { stamped, .. } => bound.attitude(*t, &stamped.value, &truth),
            Sample::Frame { .. } => {
                if let Some(seen) = seen {
                    bound.frame(*t, seen, &truth);
                }
                let scored = world.seconds(*t) >= BURN_S;
                let shown = |target: &usize| {
                    seen.as_ref().is_some_and(|seen| shows(seen, &world.scenario().rig, *target))
                };
                for target in (0..world.vehicles()).filter(|_| scored).filter(shown) {
                    if let Some(covariance) = bound.target(target) {
                        score.add(&covariance);
                    }
                }
            }
        }
    }
    score
}

/// rel m, heading deg, speed, yaw rate, NEES of three, of five, of position, coverage.
#[derive(Clone, Copy)]
struct Figures([f64; 8]);

/// Mean (or root mean square) over runs, and the spread about it.
fn mean_and_spread(values: impl Iterator<Item = f64> + Clone, squared: bool) -> (f64, f64) {
    let n = values.clone().count().max(1) as f64;
    let mean = if squared {
        (values.clone().map(|x| x * x).sum::<f64>() / n).sqrt()
    } else {
        values.clone().sum::<f64>() / n
    };
    (mean, (values.map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt())
}

/// A row of the table: root mean squares of the errors over runs, means of NEES and coverage, with their spread.
fn summary(runs: &[Figures]) -> String {
    let mut text = String::new();
    for i in 0..8 {
        let (mean, spread) = mean_and_spread(runs.iter().map(|f| f.0[i]), i < 4);
        let cell = match i {
            // An estimator without a covariance has no NEES.
            4..7 if mean == 0.0 => format!("{:>7} {:6}", "–", ""),
            7 => format!("{mean:6.3}"),
            _ => format!("{mean:7.3}±{spread:<6.3}"),
        };
        text += &cell;
        text.push(' ');
    }
    text
}

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
