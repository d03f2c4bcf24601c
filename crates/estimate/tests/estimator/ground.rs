//! The ground through the estimator: a marker at rest surveyed in passes, and a vehicle on a slope.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Rotation3, Vector2, Vector3};
use windhover_base::geo::{Geodetic, Ground, LocalFrame, Terrain, Tile, euler_321, rot_y, wrap_angle};
use windhover_base::msg::{AttitudeSample, GnssEpoch, Stamped, TargetEstimate, TrackStatus};
use windhover_base::settings::EstimatorConfig;
use windhover_estimate::{Estimator, EstimatorOutput, Site};
use windhover_simulate::{Route, Sample, Scenario, SensorSuite, World};

/// Flies a scenario on a plane turned by `tilt` about the scenario's origin, through the filter over
/// `ground`. Turning the whole world leaves every image as it is: only fixes and compass turn.
fn estimates(world: &Arc<World>, tilt: &Rotation3<f64>, ground: Ground) -> Vec<TargetEstimate> {
    let scenario = world.scenario();
    let mut rig = scenario.rig.clone();
    rig.target.truncate(1);
    let declination_rad = scenario.declination_deg.to_radians();
    let site = Site { frame: *world.frame(), ground, declination_rad };
    let mut filter = Estimator::new(&rig, &EstimatorConfig::default(), &site);
    let mut suite = SensorSuite::new(Arc::clone(world));
    let mut out = Vec::new();
    while let Some(sample) = suite.next() {
        match sample {
            Sample::Gnss { mut stamped, .. } => {
                turn_fix(&mut stamped.value, world.frame(), tilt);
                filter.gnss(&stamped, &mut out);
            }
            Sample::Attitude { mut stamped, .. } => {
                turn_compass(&mut stamped.value, scenario, tilt);
                filter.attitude(&stamped, &mut out);
            }
            Sample::Frame { truth, seq } => {
                let value = suite.observations().clone();
                let frame = Stamped { t_valid: truth.t_stamp, t_recv: truth.t_recv, seq, value };
                filter.frame(&frame, &mut out);
            }
        }
    }
    filter.finish(&mut out);
    out.iter().filter_map(|o| if let EstimatorOutput::Estimate(e) = o { Some(*e) } else { None }).collect()
}

fn turn_fix(epoch: &mut GnssEpoch, frame: &LocalFrame, tilt: &Rotation3<f64>) {
    let geoid_m = epoch.geoid_m.unwrap_or(0.0);
    if let (Some(lat_deg), Some(lon_deg), Some(alt_m)) = (epoch.lat_deg, epoch.lon_deg, epoch.alt_msl_m) {
        let at = tilt * frame.ned(Geodetic { lat_deg, lon_deg, height_m: alt_m + geoid_m });
        let turned = frame.geodetic(&at);
        epoch.lat_deg = Some(turned.lat_deg);
        epoch.lon_deg = Some(turned.lon_deg);
        epoch.alt_msl_m = Some(turned.height_m - geoid_m);
    }
    epoch.vel_ned_mps = epoch.vel_ned_mps.map(|v| tilt * v);
}

fn turn_compass(sample: &mut AttitudeSample, scenario: &Scenario, tilt: &Rotation3<f64>) {
    let (Some(heading), Some(level)) = (sample.heading, sample.tilt) else { return };
    let angles = scenario.rig.compass.angles;
    let north = if sample.heading_is_true { 0.0 } else { scenario.declination_deg.to_radians() };
    let Some(upright) = angles.ned_from_body(heading + north, level) else { return };
    let turned = tilt * upright;
    sample.heading = Some(euler_321(&turned).0 - north);
    sample.tilt = Some(angles.tilt_of(&(turned.inverse() * Vector3::z())));
}

/// The plane as heights, three rows of three a fifth of a kilometre apart.
fn sloping(frame: &LocalFrame, grade: f64) -> Ground {
    const STEP_DEG: f64 = 0.002;
    let datum = frame.datum();
    let (north_deg, west_deg) = (datum.lat_deg + STEP_DEG, datum.lon_deg - STEP_DEG);
    let height = |row: usize| {
        let at = Geodetic { lat_deg: north_deg - row as f64 * STEP_DEG, ..datum };
        (datum.height_m + grade * frame.ned(at).x) as f32
    };
    let heights = (0..9).map(|k| height(k / 3)).collect();
    let tile = Tile::new((north_deg, west_deg), [STEP_DEG; 2], (3, 3), heights).expect("a whole tile");
    Ground::Terrain(Arc::new(Terrain::new(Arc::new(tile), frame, 0.0)))
}

/// Root mean square of position without its mean (m), heading (deg), speed (m/s) from 6 s on, and NEES
/// of the last two and yaw rate.
fn score(world: &World, tilt: &Rotation3<f64>, found: &[TargetEstimate]) -> [f64; 4] {
    let (mut off, mut sums, mut n) = (Vec::new(), [0.0; 3], 0.0);
    for e in found.iter().filter(|e| world.seconds(e.t_valid) > 6.0) {
        let Some(s) = e.state.filter(|_| e.status == TrackStatus::Tracking) else { continue };
        let truth = world.vehicle(0, e.t_valid);
        let at = tilt * Vector3::new(truth.north_m, truth.east_m, 0.0);
        let (sin, cos) = truth.heading_rad.sin_cos();
        let ahead = tilt * Vector3::new(cos, sin, 0.0);
        let level = ahead.xy().norm();
        off.push(Vector2::new(s.north_m - at.x, s.east_m - at.y));
        let error = Vector3::new(
            wrap_angle(s.heading_rad - ahead.y.atan2(ahead.x)),
            s.speed_mps - truth.speed_mps * level,
            s.yaw_rate_radps - truth.yaw_rate_radps,
        );
        let p = s.covariance.expect("the filter tells it").fixed_view::<3, 3>(2, 2).into_owned();
        sums[0] += error.x * error.x;
        sums[1] += error.y * error.y;
        sums[2] += p.try_inverse().map_or(0.0, |inverse| error.dot(&(inverse * error)));
        n += 1.0;
    }
    let mean = off.iter().sum::<Vector2<f64>>() / n;
    let spread = off.iter().map(|o| (o - mean).norm_squared()).sum::<f64>() / n;
    [spread.sqrt(), (sums[0] / n).sqrt().to_degrees(), (sums[1] / n).sqrt(), sums[2] / n]
}

/// A slope of this grade, uphill to the north: 6 m in 100.
const GRADE: f64 = 0.06;

/// Scores over terrain and over level ground, the mean of `runs` flights of half a minute.
fn on_a_slope(name: &str, runs: u64) -> [[f64; 4]; 2] {
    let tilt = rot_y(GRADE.atan());
    let mut mean = [[0.0; 4]; 2];
    for seed in 1..=runs {
        let mut scenario = Scenario::named(name).expect("a named scenario");
        scenario.duration_s = 30.0;
        let world = Arc::new(World::new(scenario, seed));
        let grounds = [sloping(world.frame(), GRADE), Ground::Flat { down_m: 0.0 }];
        for (sum, ground) in mean.iter_mut().zip(grounds) {
            let one = score(&world, &tilt, &estimates(&world, &tilt, ground));
            sum.iter_mut().zip(one).for_each(|(s, v)| *s += v / runs as f64);
        }
    }
    mean
}

#[test]
fn terrain_keeps_a_vehicle_on_a_slope_accurate() {
    let [terrain, level] = on_a_slope("follow", 4);
    println!("terrain {terrain:?}, level {level:?}");
    // Heading and its covariance do not distinguish the two: the slow errors of own motion absorb the slope.
    assert!(terrain[0] < level[0] && terrain[1] < 0.35, "{terrain:?} {level:?}");
    assert!(terrain[3] < 4.5, "the covariances stay honest: {terrain:?}");
}

/// The table of docs/estimator.md: `cargo test --release -p windhover-estimate --test estimator -- --ignored --nocapture slope`.
#[test]
#[ignore = "12 flights take a minute"]
fn slope_table() {
    for name in ["follow", "circle20"] {
        let [terrain, level] = on_a_slope(name, 6);
        println!(
            "{name}: position m, heading deg, speed m/s, NEES: terrain {terrain:.3?}, level {level:.3?}"
        );
        assert!(terrain[1] < level[1] && terrain[3] < level[3]);
    }
}

/// A marker at rest on the ground, passed again and again by a helicopter that follows a guide
/// around an eight much wider than its view.
fn passes(seconds: f64) -> Scenario {
    let mut scenario = Scenario::named("static-survey").expect("a named scenario");
    scenario.duration_s = seconds;
    scenario.camera.features = 0;
    scenario.rig.camera.fps = 4.0;
    scenario.follow_guide(4.0, Route::Eight { a_m: 25.0, b_m: 12.0 });
    scenario
}

/// One-sigma of the best estimate of a constant seen through a Gauss-Markov error of this sigma and
/// time constant for `t_s` seconds: `σ √(2τ / (2τ + T))` (Ornstein-Uhlenbeck mean, maximum likelihood).
fn floor_m(sigma_m: f64, tau_s: f64, t_s: f64) -> f64 {
    sigma_m * (2.0 * tau_s / (2.0 * tau_s + t_s)).sqrt()
}

/// Result of a survey after some seconds, over several flights: stated sigma, error (root mean square, per axis), and
/// normalised error squared of both axes.
fn survey(seconds: f64, at_s: &[f64], runs: u64) -> BTreeMap<u64, [f64; 3]> {
    let mut table: BTreeMap<u64, [f64; 3]> = BTreeMap::new();
    for seed in 1..=runs {
        let world = Arc::new(World::new(passes(seconds), seed));
        let found = estimates(&world, &Rotation3::identity(), Ground::Flat { down_m: 0.0 });
        for at in at_s {
            let seen = found.iter().rfind(|e| world.seconds(e.t_valid) <= *at);
            let state = seen.and_then(|e| e.state).expect("a marker at rest stays known between passes");
            let truth = world.vehicle(0, seen.expect("just found").t_valid);
            let e = Vector2::new(state.north_m - truth.north_m, state.east_m - truth.east_m);
            let p = state.covariance.expect("reported").fixed_view::<2, 2>(0, 0).into_owned();
            let row = table.entry(*at as u64).or_default();
            let share = 1.0 / runs as f64;
            row[0] += (0.5 * p.trace()).sqrt() * share;
            row[1] += 0.5 * e.norm_squared() * share;
            row[2] += e.dot(&(p.try_inverse().expect("positive") * e)) * share;
        }
    }
    table.values_mut().for_each(|row| row[1] = row[1].sqrt());
    table
}

#[test]
fn a_survey_gets_better_with_passes_down_to_what_the_receiver_sets() {
    let table = survey(300.0, &[20.0, 100.0, 300.0], 3);
    let gps = passes(1.0).rig.gps;
    println!("{table:?}");
    for (t, [sigma, _, nees]) in &table {
        let floor = floor_m(gps.bias_sigma_m, gps.bias_tau_s, *t as f64);
        assert!((0.85..1.3).contains(&(sigma / floor)), "{t} s: sigma {sigma}, floor {floor}");
        assert!(*nees < 8.0, "{t} s: {nees}");
    }
    assert!(table[&300][0] < 0.75 * table[&20][0], "{table:?}");
}

/// The table of docs/calibration.md: `cargo test --release -p windhover-estimate --test estimator -- --ignored --nocapture survey`.
#[test]
#[ignore = "24 flights of 20 minutes take some minutes"]
fn survey_table() {
    let times = [20.0, 60.0, 120.0, 300.0, 600.0, 1200.0];
    let gps = passes(1.0).rig.gps;
    for (t, [sigma, error, nees]) in survey(1200.0, &times, 24) {
        let floor = floor_m(gps.bias_sigma_m, gps.bias_tau_s, t as f64);
        println!(
            "{t:>5} s: sigma {sigma:.3} m, error {error:.3} m, floor {floor:.3} m, NEES {nees:.2} (ideal 2)"
        );
    }
}
