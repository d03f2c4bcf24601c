//! The estimator on simulated flights, without bytes or pixels: accuracy, honesty, order of arrival,
//! outages, wrong inputs.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector2};
use windhover_base::geo::{Ground, wrap_angle};
use windhover_base::msg::{
    AttitudeSample, Disposition, FrameObservations, GnssEpoch, Ownship, Stamped, TargetEstimate, TrackStatus,
};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::{MonoTime, Span};
use windhover_estimate::{Estimator, EstimatorOutput, PaperEstimator, Site};
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

/// One measurement as the pipeline hands it over.
#[derive(Clone)]
#[expect(clippy::large_enum_variant, reason = "a value at a time, handed on")]
pub(super) enum Input {
    Gnss(Stamped<GnssEpoch>),
    Attitude(Stamped<AttitudeSample>),
    Frame(Stamped<FrameObservations>),
}

impl Input {
    pub(super) fn t_recv(&self) -> MonoTime {
        match self {
            Self::Gnss(s) => s.t_recv,
            Self::Attitude(s) => s.t_recv,
            Self::Frame(s) => s.t_recv,
        }
    }

    pub(super) fn t_valid(&self) -> MonoTime {
        match self {
            Self::Gnss(s) => s.t_valid,
            Self::Attitude(s) => s.t_valid,
            Self::Frame(s) => s.t_valid,
        }
    }

    fn set_t_recv(&mut self, t: MonoTime) {
        match self {
            Self::Gnss(s) => s.t_recv = t,
            Self::Attitude(s) => s.t_recv = t,
            Self::Frame(s) => s.t_recv = t,
        }
    }

    pub(super) fn give(&self, filter: &mut Estimator, out: &mut Vec<EstimatorOutput>) {
        match self {
            Self::Gnss(s) => filter.gnss(s, out),
            Self::Attitude(s) => filter.attitude(s, out),
            Self::Frame(s) => filter.frame(s, out),
        }
    }
}

pub(super) struct Flight {
    pub(super) world: Arc<World>,
    pub(super) site: Site,
    pub(super) inputs: Vec<Input>,
}

pub(super) fn fly(name: &str, seconds: f64, seed: u64, change: impl FnOnce(&mut Scenario)) -> Flight {
    let mut scenario = Scenario::named(name).expect("a named scenario");
    scenario.duration_s = seconds;
    change(&mut scenario);
    let declination_rad = scenario.declination_deg.to_radians();
    let world = Arc::new(World::new(scenario, seed));
    let site = Site { frame: *world.frame(), ground: Ground::Flat { down_m: 0.0 }, declination_rad };
    let mut suite = SensorSuite::new(Arc::clone(&world));
    let mut inputs = Vec::new();
    while let Some(sample) = suite.next() {
        inputs.push(match sample {
            Sample::Gnss { stamped, .. } => Input::Gnss(stamped),
            Sample::Attitude { stamped, .. } => Input::Attitude(stamped),
            Sample::Frame { truth, seq } => Input::Frame(Stamped {
                t_valid: truth.t_stamp,
                t_recv: truth.t_recv,
                seq,
                value: suite.observations().clone(),
            }),
        });
    }
    Flight { world, site, inputs }
}

impl Flight {
    pub(super) fn rig(&self) -> &Rig {
        &self.world.scenario().rig
    }

    pub(super) fn filter(&self) -> Estimator {
        Estimator::new(self.rig(), &EstimatorConfig::default(), &self.site)
    }

    pub(super) fn outputs(&self) -> Vec<EstimatorOutput> {
        self.through(self.filter())
    }

    /// Through a filter of another configuration.
    pub(super) fn outputs_as(&self, rig: &Rig, ground: Ground) -> Vec<EstimatorOutput> {
        let site = Site { ground, ..self.site.clone() };
        self.through(Estimator::new(rig, &EstimatorConfig::default(), &site))
    }

    fn through(&self, mut filter: Estimator) -> Vec<EstimatorOutput> {
        let mut out = Vec::new();
        for input in &self.inputs {
            input.give(&mut filter, &mut out);
        }
        filter.finish(&mut out);
        out
    }
}

pub(super) fn estimates(out: &[EstimatorOutput]) -> Vec<TargetEstimate> {
    out.iter().filter_map(|o| if let EstimatorOutput::Estimate(e) = o { Some(*e) } else { None }).collect()
}

fn smoothed(out: &[EstimatorOutput]) -> Vec<TargetEstimate> {
    out.iter().filter_map(|o| if let EstimatorOutput::Smoothed(e) = o { Some(*e) } else { None }).collect()
}

/// RMSE of heading (rad), speed, yaw rate; NEES of the three; share of frames with a live estimate.
#[derive(Clone, Copy, Debug)]
pub(super) struct Score {
    pub(super) heading: f64,
    pub(super) speed: f64,
    pub(super) yaw_rate: f64,
    pub(super) nees: f64,
    pub(super) coverage: f64,
}

pub(super) fn score(estimates: &[TargetEstimate], world: &World, from_s: f64) -> Score {
    let (mut sums, mut nees, mut live, mut owed) = ([0.0; 3], 0.0, 0.0, 0.0);
    for estimate in estimates.iter().filter(|e| world.seconds(e.t_valid) >= from_s) {
        owed += 1.0;
        let known = matches!(estimate.status, TrackStatus::Tracking | TrackStatus::Coasting);
        let Some(state) = estimate.state.filter(|_| known) else { continue };
        live += 1.0;
        let truth = world.vehicle(estimate.target, estimate.t_valid);
        let e = nalgebra::Vector3::new(
            wrap_angle(state.heading_rad - truth.heading_rad),
            state.speed_mps - truth.speed_mps,
            state.yaw_rate_radps - truth.yaw_rate_radps,
        );
        (0..3).for_each(|i| sums[i] += e[i] * e[i]);
        let p: Matrix3<f64> = state.covariance.expect("the filter tells it").fixed_view::<3, 3>(2, 2).into();
        nees += p.try_inverse().map_or(0.0, |inverse| e.dot(&(inverse * e)));
    }
    let [heading, speed, yaw_rate] = sums.map(|s: f64| (s / live).sqrt());
    Score { heading, speed, yaw_rate, nees: nees / live, coverage: live / owed }
}

#[test]
fn following_is_accurate_honest_and_smoothing_helps() {
    let flight = fly("follow", 30.0, 3, |_| {});
    let out = flight.outputs();
    let (filtered, later) =
        (score(&estimates(&out), &flight.world, 6.0), score(&smoothed(&out), &flight.world, 6.0));
    assert!(filtered.speed < 0.07 && filtered.yaw_rate < 0.045, "{filtered:?}");
    assert!(filtered.heading < 0.015 && filtered.nees < 6.0 && filtered.coverage > 0.98, "{filtered:?}");
    assert!(later.speed < 0.6 * filtered.speed && later.yaw_rate < 0.6 * filtered.yaw_rate, "{later:?}");
    let frames = estimates(&out).len();
    assert!(smoothed(&out).len() + 10 > frames, "{} of {frames} smoothed", smoothed(&out).len());
}

#[test]
fn the_order_of_arrival_does_not_matter() {
    let flight = fly("follow", 8.0, 5, |_| {});
    let end = flight.world.time(9.5);
    let last = Input::Frame(Stamped {
        t_valid: end,
        t_recv: end,
        seq: u64::MAX,
        value: FrameObservations { frame: 9_999, ..FrameObservations::default() },
    });
    let after = |inputs: &[Input]| -> Ownship {
        let (mut filter, mut out) = (flight.filter(), Vec::new());
        inputs.iter().chain([&last]).for_each(|h| h.give(&mut filter, &mut out));
        let state =
            out.iter().rev().find_map(|o| if let EstimatorOutput::Ownship(s) = o { Some(*s) } else { None });
        state.expect("a frame gives the helicopter's state")
    };
    // From the same start: everything in order of validity and received at once, compared with the order of arrival.
    let mut in_order = flight.inputs.clone();
    in_order[60..].sort_by_key(Input::t_valid);
    in_order[60..].iter_mut().for_each(|h| h.set_t_recv(h.t_valid() + Span::from_ms(350.0)));
    let (a, b) = (after(&flight.inputs), after(&in_order));
    assert!((a.position_ned_m - b.position_ned_m).norm() < 1e-6, "{a:?} {b:?}");
    assert!(a.ned_from_body.angle_to(&b.ned_from_body) < 1e-7);
}

#[test]
fn too_old_and_too_new_are_refused_and_reported() {
    let flight = fly("follow", 5.0, 6, |_| {});
    let (mut filter, mut out) = (flight.filter(), Vec::new());
    flight.inputs.iter().for_each(|h| h.give(&mut filter, &mut out));
    let now = flight.world.time(5.0);
    let dispositions = |out: &[EstimatorOutput]| -> Vec<Disposition> {
        out.iter()
            .filter_map(|o| if let EstimatorOutput::Fusion(f) = o { Some(f.disposition) } else { None })
            .collect()
    };
    for (valid_s, want) in [(1.0, Disposition::TooOld), (500.0, Disposition::TooNew)] {
        out.clear();
        let t_valid = flight.world.time(valid_s);
        let value = AttitudeSample { heading: Some(1.0), ..AttitudeSample::default() };
        filter.attitude(&Stamped { t_valid, t_recv: now, seq: 99_999, value }, &mut out);
        assert_eq!(dispositions(&out), vec![want]);
    }
}

#[test]
fn a_vehicle_seen_before_there_is_a_fix_waits() {
    let flight = fly("follow", 3.0, 7, |_| {});
    let frames: Vec<_> = flight.inputs.iter().filter(|h| matches!(h, Input::Frame(_))).collect();
    let (mut filter, mut out) = (flight.filter(), Vec::new());
    frames.iter().for_each(|h| h.give(&mut filter, &mut out));
    let reported = estimates(&out);
    assert_eq!(reported.len(), frames.len());
    assert!(reported.iter().all(|e| e.status == TrackStatus::Lost && e.state.is_none()));
}

#[test]
fn outages_are_survived() {
    for name in ["gps-outage", "compass-outage", "blackout", "hidden-marker", "leave-and-return"] {
        let flight = fly(name, 45.0, 2, |_| {});
        let out = flight.outputs();
        let s = score(&estimates(&out), &flight.world, 6.0);
        assert!(s.nees < 6.0 && s.coverage > 0.9, "{name}: {s:?}");
        let last = *estimates(&out).last().expect("frames");
        assert!(last.status != TrackStatus::Lost, "{name}: {last:?}");
        assert!(!out.iter().any(|o| matches!(o, EstimatorOutput::Reset { .. })), "{name}");
    }
}

#[test]
fn one_tag_of_two_hidden_costs_little() {
    let flight = fly("hidden-marker", 30.0, 2, |_| {});
    let out = flight.outputs();
    // The second tag is covered from 15 s on.
    let (both, one): (Vec<_>, Vec<_>) =
        estimates(&out).into_iter().partition(|e| flight.world.seconds(e.t_valid) < 15.0);
    let (both, one) = (score(&both, &flight.world, 8.0), score(&one, &flight.world, 15.5));
    assert!(one.coverage == 1.0 && one.nees < 6.0, "{one:?}");
    assert!(one.speed < 2.0 * both.speed && one.yaw_rate < 3.0 * both.yaw_rate, "{one:?} after {both:?}");
}

#[test]
fn a_tilt_sensor_that_reads_little_costs_little() {
    let speed = |name: &str| {
        let flight = fly(name, 30.0, 4, |_| {});
        score(&estimates(&flight.outputs()), &flight.world, 6.0)
    };
    let (perfect, poor) = (speed("follow"), speed("tilt15"));
    assert!(poor.speed < 1.3 * perfect.speed && poor.nees < 6.0, "{poor:?} after {perfect:?}");
}

#[test]
fn outliers_lose_no_track() {
    for seed in 1..4 {
        let flight = fly("follow", 25.0, seed, |s| s.camera.marker_outlier = 0.03);
        let s = score(&estimates(&flight.outputs()), &flight.world, 6.0);
        assert!(s.coverage > 0.995 && s.nees < 6.0 && s.speed < 0.08, "seed {seed}: {s:?}");
    }
}

#[test]
fn every_kind_of_target_is_tracked() {
    for (name, speed) in
        [("two-vehicles", 0.08), ("static-survey", 1e-6), ("discs", 0.08), ("crooked-mount", 0.07)]
    {
        let flight = fly(name, 20.0, 8, |_| {});
        let out = flight.outputs();
        for target in 0..flight.world.vehicles() {
            let of: Vec<_> = estimates(&out).into_iter().filter(|e| e.target == target).collect();
            let s = score(&of, &flight.world, 6.0);
            assert!(s.coverage > 0.98 && s.speed < speed && s.heading < 0.08, "{name} {target}: {s:?}");
        }
    }
}

#[test]
fn gps_latency_is_learnt_from_motion() {
    let flight = fly("late-gps", 60.0, 3, |_| {});
    let (mut filter, mut out) = (flight.filter(), Vec::new());
    flight.inputs.iter().for_each(|h| h.give(&mut filter, &mut out));
    assert!((filter.gps_delay_s() - 0.1).abs() < 0.025, "{}", filter.gps_delay_s());
}

#[test]
fn one_wrong_compass_reading_does_not_start_the_filter() {
    let mut flight = fly("follow", 10.0, 9, |_| {});
    let first =
        flight.inputs.iter_mut().find_map(|h| if let Input::Attitude(a) = h { Some(a) } else { None });
    let first = first.expect("a reading");
    first.value.heading = first.value.heading.map(|h| h + 3.0);
    let s = score(&estimates(&flight.outputs()), &flight.world, 3.0);
    assert!(s.heading < 0.1 && s.coverage > 0.95, "{s:?}");
}

#[test]
fn absurd_numbers_pass_without_harm() {
    let mut flight = fly("follow", 15.0, 10, |_| {});
    for (i, input) in flight.inputs.iter_mut().enumerate().filter(|(i, _)| i % 37 == 5) {
        let value = [f64::NAN, f64::INFINITY, 1e300, -1e300, 1e9][i % 5];
        match input {
            Input::Gnss(g) => (g.value.lat_deg, g.value.alt_msl_m) = (Some(value), Some(value)),
            Input::Attitude(a) => a.value.heading = Some(value),
            Input::Frame(f) => {
                for marker in &mut f.value.markers {
                    marker.corners_px = Some([Vector2::new(value, value); 4]);
                    marker.center_px = Vector2::new(value, 3.0);
                }
                f.value.features.iter_mut().for_each(|feature| feature.px.x = value);
            }
        }
    }
    let out = flight.outputs();
    for estimate in estimates(&out) {
        if let Some(state) = estimate.state {
            assert!(
                state.north_m.is_finite()
                    && state.covariance.is_some_and(|p| p.iter().all(|x| x.is_finite()))
            );
        }
    }
    let s = score(&estimates(&out), &flight.world, 10.0);
    assert!(s.coverage > 0.8 && s.heading < 0.1, "{s:?}");
}

#[test]
fn the_papers_estimator_is_exact_without_noise() {
    let flight = fly("follow", 4.0, 11, |s| {
        let gps = &mut s.gps;
        (gps.bias_sigma_m, gps.noise_m, gps.velocity_noise_mps) = (0.0, 0.0, 0.0);
        (gps.latency_spread_ms, gps.stamp_noise_ms, gps.rate_hz) = (0.0, 0.0, 50.0);
        let compass = &mut s.compass;
        (compass.bias_sigma_deg, compass.heading_noise_deg, compass.tilt_noise_deg) = (0.0, 0.0, 0.0);
        (compass.latency_spread_ms, compass.jitter_ms, compass.rate_hz) = (0.0, 0.0, 200.0);
        (s.camera.marker_noise_px, s.camera.stamp_noise_ms) = (0.0, 0.0);
        // Everything is received as soon as it is valid, so that the latest reading is that of the frame.
        s.rig.compass.baud = 921_600;
        (s.rig.gps.latency_ms, s.rig.compass.latency_ms) = (0.0, 0.0);
    });
    let (mut paper, mut out) =
        (PaperEstimator::new(flight.rig(), &EstimatorConfig::default(), &flight.site), Vec::new());
    for input in &flight.inputs {
        match input {
            Input::Gnss(g) => paper.gnss(g, &mut out),
            Input::Attitude(a) => paper.attitude(a, &mut out),
            Input::Frame(f) => paper.frame(f, &mut out),
        }
    }
    assert!(out.len() > 40);
    for estimate in &out {
        let state = estimate.state.expect("the paper's estimator tells only what it has");
        let truth = flight.world.vehicle(0, estimate.t_valid);
        // The reading is up to a frame's transfer newer than the frame.
        assert!(wrap_angle(state.heading_rad - truth.heading_rad).abs() < 0.03, "{state:?} {truth:?}");
        assert!((state.north_m - truth.north_m).abs() < 0.4, "{state:?} {truth:?}");
    }
}
