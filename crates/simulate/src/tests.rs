//! The simulated world obeys physics, and sensors measure it with their configured errors.

use std::sync::Arc;

use nalgebra::Vector3;

use super::*;
use windhover_base::settings::TargetModel;
use windhover_base::time::Span;

fn world(name: &str, seed: u64) -> Arc<World> {
    Arc::new(World::new(Scenario::named(name).expect("a known scenario"), seed))
}

#[test]
fn helicopter_motion_and_attitude_agree() {
    for (name, _) in Scenario::names() {
        let world = world(name, 3);
        let h = Span::from_ms(1.0);
        for k in 0..60 {
            let t = world.time(f64::from(k) * 0.97 + 0.5);
            let (before, at, after) = (world.ownship(t - h), world.ownship(t), world.ownship(t + h));
            let v = (after.position_ned_m - before.position_ned_m) / (2.0 * h.s());
            assert!((v - at.velocity_ned_mps).norm() < 1e-3, "{name}: velocity at {t:?}");
            let a = (after.velocity_ned_mps - before.velocity_ned_mps) / (2.0 * h.s());
            assert!((a - at.acceleration_ned_mps2).norm() < 1e-2, "{name}: acceleration at {t:?}");
            let rate = (before.ned_from_body.inverse() * after.ned_from_body).scaled_axis() / (2.0 * h.s());
            assert!((rate - at.body_rate_radps).norm() < 1e-3, "{name}: rate at {t:?}");
            // Thrust is what remains of the acceleration without gravity and drag; it has no
            // component across the body's z axis, so lateral specific force is drag alone.
            let specific = at.ned_from_body.inverse() * (at.acceleration_ned_mps2 - Vector3::z() * 9.80665);
            let drag_limit = world.scenario().helicopter.drag_per_s * 25.0;
            assert!(specific.xy().norm() < drag_limit && specific.z < -4.0, "{name}: {specific}");
        }
    }
}

#[test]
fn vehicles_move_as_their_models_say() {
    for (name, _) in Scenario::names() {
        let world = world(name, 5);
        let h = Span::from_ms(1.0);
        for target in 0..world.vehicles() {
            let mut fastest = 0.0_f64;
            for k in 0..60 {
                let t = world.time(f64::from(k) * 0.97 + 0.5);
                let (before, at, after) =
                    (world.vehicle(target, t - h), world.vehicle(target, t), world.vehicle(target, t + h));
                let along = (after.north_m - before.north_m) * at.heading_rad.cos()
                    + (after.east_m - before.east_m) * at.heading_rad.sin();
                let across = (after.east_m - before.east_m) * at.heading_rad.cos()
                    - (after.north_m - before.north_m) * at.heading_rad.sin();
                assert!((along / (2.0 * h.s()) - at.speed_mps).abs() < 1e-3, "{name}: speed at {t:?}");
                assert!((across / (2.0 * h.s())).abs() < 1e-3, "{name}: the rear axle slips at {t:?}");
                let turned = windhover_base::geo::wrap_angle(after.heading_rad - before.heading_rad);
                assert!((turned / (2.0 * h.s()) - at.yaw_rate_radps).abs() < 2e-3, "{name}: turn at {t:?}");
                fastest = fastest.max(at.speed_mps.abs());
            }
            let moves = world.scenario().moves(target);
            assert!(fastest < 6.0 && (fastest > 0.3) == moves, "{name}: fastest {fastest}");
            let model = world.scenario().rig.target[target].model;
            assert!(model != TargetModel::Static || !moves);
        }
    }
}

#[test]
fn markers_are_in_view_where_the_scenario_wants_them() {
    for (name, least, most) in [
        ("hover10", 0.98, 1.0),
        ("follow", 0.97, 1.0),
        ("hover20", 0.97, 1.0),
        ("circle20", 0.95, 1.0),
        ("figure-eight", 0.97, 1.0),
        ("fast-turns", 0.9, 1.0),
        ("two-vehicles", 0.95, 1.0),
        ("crooked-mount", 0.95, 1.0),
        ("elevation-compass", 0.7, 1.0),
        ("leave-and-return", 0.25, 0.75),
    ] {
        let (mut seen, mut frames) = (0.0, 0.0);
        for seed in 0..3 {
            let mut suite = SensorSuite::new(world(name, seed));
            while let Some(sample) = suite.next() {
                if let Sample::Frame { .. } = sample {
                    frames += 1.0;
                    let all = suite.marker_truths().iter().filter(|m| m.visible).count();
                    let markers: usize =
                        suite.world().scenario().rig.target.iter().map(|t| t.marker.len()).sum();
                    seen += f64::from(u8::from(all == markers));
                }
            }
        }
        let share = seen / frames;
        assert!((least..=most).contains(&share), "{name}: all markers in view in {share} of the frames");
    }
}

#[test]
fn samples_arrive_in_order_and_repeat() {
    let arrivals = |seed| -> Vec<(i64, String)> {
        let mut suite = SensorSuite::new(world("noisy", seed));
        let mut all = Vec::new();
        while let Some(sample) = suite.next() {
            all.push((sample.t_recv().ns(), format!("{sample:?} {:?}", suite.observations())));
        }
        all
    };
    let first = arrivals(11);
    assert!(first.windows(2).all(|pair| pair[0].0 <= pair[1].0), "out of order");
    assert!(first == arrivals(11), "the same seed gave another flight");
    assert!(first != arrivals(12));
    // 5 fixes, 30 readings and 15 frames a second for a minute, less what the scenario loses.
    assert!((2_800..3_000).contains(&first.len()), "{}", first.len());
}

#[test]
fn sensor_errors_have_the_figures_asked_for() {
    let (mut velocity, mut heading, mut tilt, mut pixels) = ([0.0; 2], [0.0; 2], [0.0; 2], [0.0; 2]);
    let add = |sum: &mut [f64; 2], error: f64| {
        sum[0] += error * error;
        sum[1] += 1.0;
    };
    let mut bias = [0.0; 2];
    for seed in 0..12 {
        let mut suite = SensorSuite::new(world("follow", seed));
        let compass_bias = suite.compass_bias_rad();
        let arm = Vector3::from(suite.world().scenario().rig.gps.antenna_position_m);
        let world = Arc::clone(suite.world());
        while let Some(sample) = suite.next() {
            match sample {
                Sample::Gnss { t_true, stamped } => {
                    let own = world.ownship(t_true);
                    let swing = own.ned_from_body * own.body_rate_radps.cross(&arm);
                    let said = stamped.value.vel_ned_mps.expect("a fix");
                    add(&mut velocity, said.x - own.velocity_ned_mps.x - swing.x);
                    let at = world.frame().ned(windhover_base::geo::Geodetic {
                        lat_deg: stamped.value.lat_deg.expect("a fix"),
                        lon_deg: stamped.value.lon_deg.expect("a fix"),
                        height_m: stamped.value.alt_msl_m.expect("a fix") - 27.0,
                    });
                    add(&mut bias, at.x - (own.position_ned_m + own.ned_from_body * arm).x);
                }
                Sample::Attitude { t_true, stamped } => {
                    let own = world.ownship(t_true);
                    let magnetic = own.heading_rad + 3.4_f64.to_radians();
                    let said = stamped.value.heading.expect("valid") - magnetic - compass_bias;
                    add(&mut heading, windhover_base::geo::wrap_angle(said).to_degrees());
                    let (_, pitch, _) = windhover_base::geo::euler_321(&own.ned_from_body);
                    add(&mut tilt, (stamped.value.tilt.expect("valid").pitch - pitch).to_degrees());
                }
                Sample::Frame { .. } => {
                    for (seen, truth) in suite.observations().markers.iter().zip(suite.marker_truths()) {
                        let corners = seen.corners_px.expect("a tag");
                        add(&mut pixels, corners[2].x - truth.corners_px[2].x);
                    }
                }
            }
        }
    }
    let rms = |sum: [f64; 2]| (sum[0] / sum[1]).sqrt();
    assert!((rms(velocity) - 0.05).abs() < 0.004, "velocity {}", rms(velocity));
    assert!((rms(heading) - 0.5).abs() < 0.02, "heading {}", rms(heading));
    assert!((rms(tilt) - 0.3).abs() < 0.02, "tilt {}", rms(tilt));
    assert!((rms(pixels) - 0.5).abs() < 0.05, "pixels {}", rms(pixels));
    assert!((0.6..2.6).contains(&rms(bias)), "position {}", rms(bias));
}

#[test]
fn ground_features_are_static_points() {
    let world = world("follow", 2);
    let mut suite = SensorSuite::new(Arc::clone(&world));
    let (mut frames, mut followed) = (0, 0);
    let mut places = std::collections::BTreeMap::new();
    while let Some(sample) = suite.next() {
        let Sample::Frame { truth, .. } = sample else { continue };
        frames += 1;
        let pose = world.camera_pose(truth.t_true);
        for feature in &suite.observations().features {
            followed += 1;
            let place = world.ground_at(&pose, feature.px).expect("on the ground");
            let first = *places.entry(feature.id).or_insert(place);
            // 0.5 px twice at 15 m is two centimetres; five sigma of that.
            assert!((place - first).norm() < 0.12, "feature {} moved", feature.id);
        }
    }
    assert!(followed > 7 * frames, "{followed} features in {frames} frames");
    assert!(places.len() < followed / 10, "features live too short: {} of {followed}", places.len());
}
