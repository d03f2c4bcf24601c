//! Whether the errors of a vehicle's speed, yaw rate and position agree with their stated variances, whatever the
//! quality of the pixels; and whether a track survives its vehicle's absence.

use std::sync::Arc;

use windhover_base::geo::Ground;
use windhover_base::msg::{FrameObservations, Stamped, TargetEstimate, TrackStatus};
use windhover_base::settings::EstimatorConfig;
use windhover_base::time::Span;
use windhover_estimate::{Estimator, EstimatorOutput, Site};
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

/// Flies a scenario whose pixels are this good (px); gives the world and the estimates of its first target.
fn fly(name: &str, seconds: f64, seed: u64, px: (f64, f64)) -> (Arc<World>, Vec<TargetEstimate>) {
    fly_with(name, seconds, seed, px, |_, _| ())
}

/// The same with what the camera saw changed before the filter has it: seconds into the flight, observations.
fn fly_with(
    name: &str,
    seconds: f64,
    seed: u64,
    (marker_px, feature_px): (f64, f64),
    mut change: impl FnMut(f64, &mut FrameObservations),
) -> (Arc<World>, Vec<TargetEstimate>) {
    let mut scenario = Scenario::named(name).expect("a named scenario");
    scenario.duration_s = seconds;
    (scenario.camera.marker_noise_px, scenario.camera.feature_noise_px) = (marker_px, feature_px);
    let declination_rad = scenario.declination_deg.to_radians();
    let world = Arc::new(World::new(scenario, seed));
    let site = Site { frame: *world.frame(), ground: Ground::Flat { down_m: 0.0 }, declination_rad };
    let rig = &world.scenario().rig;
    let offset = Span::from_ms(rig.camera.exposure_offset_ms);
    let mut filter = Estimator::new(rig, &EstimatorConfig::default(), &site);
    let mut suite = SensorSuite::new(Arc::clone(&world));
    let mut out = Vec::new();
    while let Some(sample) = suite.next() {
        match &sample {
            Sample::Gnss { stamped, .. } => filter.gnss(stamped, &mut out),
            Sample::Attitude { stamped, .. } => filter.attitude(stamped, &mut out),
            Sample::Frame { truth, seq } => {
                let (t_valid, t_recv) = (truth.t_stamp + offset, truth.t_recv);
                let mut value = suite.observations().clone();
                change(world.seconds(t_valid), &mut value);
                filter.frame(&Stamped { t_valid, t_recv, seq: *seq, value }, &mut out);
            }
        }
    }
    let estimates = out.into_iter().filter_map(|o| match o {
        EstimatorOutput::Estimate(e) if e.target == 0 => Some(e),
        _ => None,
    });
    let estimates = estimates.collect();
    (world, estimates)
}

/// Mean over frames and seeds of squared error over stated variance, of speed and of yaw rate.
fn squared_over_stated(name: &str, px: (f64, f64)) -> [f64; 2] {
    let (mut sums, mut n) = ([0.0; 2], 0.0);
    for seed in 1..4 {
        let (world, estimates) = fly(name, 25.0, seed, px);
        for estimate in estimates.iter().filter(|e| world.seconds(e.t_valid) > 6.0) {
            let state = estimate.state.expect("it is in view all the time");
            let truth = world.vehicle(0, estimate.t_valid);
            let p = state.covariance.expect("the filter tells it");
            sums[0] += (state.speed_mps - truth.speed_mps).powi(2) / p[(3, 3)];
            sums[1] += (state.yaw_rate_radps - truth.yaw_rate_radps).powi(2) / p[(4, 4)];
            n += 1.0;
        }
    }
    sums.map(|sum| sum / n)
}

#[test]
fn speed_and_yaw_rate_are_off_by_their_stated_sigma() {
    for px in [(0.5, 0.5), (0.03, 0.1)] {
        for name in ["follow", "circle20"] {
            let ratios = squared_over_stated(name, px);
            assert!(ratios.iter().all(|r| (0.7..1.4).contains(r)), "{name}, {px:?} px: {ratios:.2?}");
        }
    }
}

#[test]
fn a_tag_badly_seen_for_a_while_is_no_vehicle_that_jumps() {
    // Given half a second in which both tags' corners are several sigmas off, as a shadow's edge or motion blur makes
    // them, so that their shape is wrong and their place is not.
    let blurred = 12.0..12.5;
    let spoil = |t: f64, seen: &mut FrameObservations| {
        for marker in seen.markers.iter_mut().filter(|_| blurred.contains(&t)) {
            for (i, corner) in marker.corners_px.iter_mut().flatten().enumerate() {
                corner.x += if i % 2 == 0 { 0.25 } else { -0.25 };
            }
        }
    };
    let (world, estimates) = fly_with("follow", 16.0, 1, (0.03, 0.1), spoil);
    let sigma = |from: f64, to: f64| {
        let seen = estimates.iter().filter(|e| (from..to).contains(&world.seconds(e.t_valid)));
        let sigmas = seen.map(|e| e.state.and_then(|s| s.covariance).expect("tracked")[(3, 3)].sqrt());
        sigmas.fold(0.0, f64::max)
    };
    // Then the stated sigma of speed is a little larger meanwhile, and the same afterwards.
    let (before, during, after) = (sigma(10.0, 12.0), sigma(12.0, 12.6), sigma(13.0, 15.0));
    assert!(during < 4.0 * before && after < 2.0 * before, "{before:.4} {during:.4} {after:.4} m/s");
}

#[test]
fn ground_features_tell_nothing_of_where_they_are() {
    // Given a flight of three minutes over some five hundred ground features, one after the other.
    let seconds = 180.0;
    let (world, estimates) = fly("follow", seconds, 1, (0.5, 0.5));
    let last = estimates.last().and_then(|e| e.state).and_then(|s| s.covariance).expect("tracked");
    // Then position is known as well as a receiver with a Gauss-Markov bias of known sigma and correlation time gives
    // it in that time if every movement is known, and no better: `2 σ² τ / (T + 2 τ)`.
    let gps = &world.scenario().rig.gps;
    let least = 2.0 * gps.bias_sigma_m.powi(2) * gps.bias_tau_s / (seconds + 2.0 * gps.bias_tau_s);
    for axis in 0..2 {
        let ratio = last[(axis, axis)] / least;
        assert!((0.97..1.15).contains(&ratio), "axis {axis}: {ratio:.3} of the least variance");
    }
}

#[test]
fn a_track_outlives_its_vehicles_absence() {
    for seed in [1, 2] {
        let (world, estimates) = fly("leave-and-return", 30.0, seed, (0.1, 0.2));
        let late = estimates.iter().filter(|e| world.seconds(e.t_valid) > 6.0);
        assert!(late.clone().any(|e| e.status == TrackStatus::Coasting), "seed {seed}: it leaves");
        for e in late {
            let known = matches!(e.status, TrackStatus::Tracking | TrackStatus::Coasting);
            assert!(known, "seed {seed}: {:?} at {:.2} s", e.status, world.seconds(e.t_valid));
        }
    }
}
