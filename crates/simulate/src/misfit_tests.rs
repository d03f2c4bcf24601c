//! Each deviation has its effect and no other, measured on the delivered data.

use std::sync::Arc;

use nalgebra::Vector3;

use super::*;
use windhover_base::geo::{euler_321, wrap_angle};
use windhover_base::msg::{GrayImage, MarkerId};
use windhover_base::settings::GroundSource;
use windhover_base::time::Span;
use windhover_detect::{Detector, Limits};

const SECONDS: f64 = 30.0;

fn scenario(name: &str, with: &[(&str, f64)]) -> Scenario {
    let mut scenario = Scenario::named(name).expect("a known scenario");
    scenario.duration_s = SECONDS;
    for (deviation, value) in with {
        scenario.deviate(deviation, Some(*value)).expect("within its limits");
    }
    scenario
}

fn flown(with: &[(&str, f64)], seed: u64) -> Arc<World> {
    Arc::new(World::new(scenario("follow", with), seed))
}

/// Moments of the flight, a fifth of a second apart.
fn moments(world: &World) -> impl Iterator<Item = windhover_base::time::MonoTime> {
    (5..(SECONDS * 5.0) as u32).map(|k| world.time(f64::from(k) * 0.2))
}

fn mean_and_rms(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt())
}

/// All events, as text.
fn received(world: &Arc<World>) -> Vec<String> {
    let mut suite = SensorSuite::new(Arc::clone(world));
    let mut all = Vec::new();
    while let Some(sample) = suite.next() {
        all.push(format!("{sample:?} {:?}", suite.observations()));
    }
    all
}

/// Pairs of every GPS epoch without and with these deviations.
fn fixes(with: &[(&str, f64)], seed: u64) -> Vec<[windhover_base::msg::GnssEpoch; 2]> {
    let of = |world: Arc<World>| {
        SensorSuite::new(world).filter_map(|sample| match sample {
            Sample::Gnss { stamped, .. } => Some(stamped.value),
            _ => None,
        })
    };
    of(flown(&[], seed)).zip(of(flown(with, seed))).map(|(a, b)| [a, b]).collect()
}

/// Pairs of the tilt that is read and the true one, degrees: pitch and roll of each reading.
fn tilts(with: &[(&str, f64)], seed: u64) -> Vec<[f64; 2]> {
    let world = flown(with, seed);
    let mut pairs = Vec::new();
    for sample in SensorSuite::new(Arc::clone(&world)) {
        let Sample::Attitude { t_true, stamped } = sample else { continue };
        let (_, pitch, roll) = euler_321(&world.ownship(t_true).ned_from_body);
        let tilt = stamped.value.tilt.expect("valid");
        pairs.extend([[tilt.pitch, pitch], [tilt.roll, roll]].map(|pair| pair.map(f64::to_degrees)));
    }
    pairs
}

#[test]
fn a_figure_of_nothing_leaves_the_flight_as_it_was_to_the_bit() {
    let nominal = received(&flown(&[], 4));
    let mut nothing = scenario("follow", &[]);
    for d in Deviation::all().iter().filter(|d| d.limits.0 <= 0.0) {
        let keeps = matches!(
            d.name,
            "stamp-jitter"
                | "gps-late"
                | "gps-delay"
                | "compass-late"
                | "from-rest"
                | "speed"
                | "gps-wander"
                | "tilt-share"
                | "wind"
                | "gusts"
                | "restless"
                | "gone"
                | "hurry"
        );
        if !keeps {
            nothing.deviate(d.name, Some(0.0)).expect("nought lies within");
        }
    }
    nothing.camera.hidden.clear();
    assert!(received(&Arc::new(World::new(nothing, 4))) == nominal);
}

#[test]
fn markers_differ_from_the_configuration_by_what_is_said() {
    let (with, plain) =
        (flown(&[("tag-size", 5.0), ("one-tag-turn", 5.0), ("one-tag-ahead", 4.0)], 1), flown(&[], 1));
    let edge = |m: &MarkerTruth| (m.corners_px[0] - m.corners_px[1]).norm();
    for t in moments(&plain).step_by(10) {
        let pair =
            |marker| (with.marker(0, marker, t).expect("below"), plain.marker(0, marker, t).expect("below"));
        let (first, one) = (pair(0), pair(1));
        assert!((edge(&first.0) / edge(&first.1) - 1.05).abs() < 0.004);
        assert!((first.0.center_px - first.1.center_px).norm() < 1e-9);
        let way = |m: &MarkerTruth| {
            let up = m.corners_px[0] - m.corners_px[3];
            up.y.atan2(up.x)
        };
        let turned = wrap_angle(way(&one.0) - way(&one.1)).to_degrees();
        assert!((turned - 5.0).abs() < 0.5, "{turned}");
        // Some 70 px a metre at 15 m.
        let moved = (one.0.center_px - one.1.center_px).norm();
        assert!((2.0..4.0).contains(&moved), "{moved}");
    }
    assert_eq!(with.scenario().rig, plain.scenario().rig, "the configuration says what it said");
}

#[test]
fn ground_is_configured_wrongly_or_not_at_all() {
    let right = scenario("follow", &[]).ground().elevation_msl_m.expect("configured");
    assert_eq!(scenario("follow", &[("ground-lower", 10.0)]).ground().elevation_msl_m, Some(right + 10.0));
    let takeoff = scenario("follow", &[("takeoff-in-air", 1.0)]).ground();
    assert_eq!((takeoff.elevation_msl_m, takeoff.source), (None, Some(GroundSource::Takeoff)));
}

/// How many of the features followed for a second moved over the ground by more than half a metre, and of how many.
fn riding(world: &Arc<World>) -> (usize, usize) {
    let mut suite = SensorSuite::new(Arc::clone(world));
    let mut places = std::collections::BTreeMap::<u64, Vec<Vector3<f64>>>::new();
    while let Some(sample) = suite.next() {
        let Sample::Frame { truth, .. } = sample else { continue };
        let pose = world.camera_pose(truth.t_true);
        for feature in &suite.observations().features {
            places
                .entry(feature.id)
                .or_default()
                .push(world.ground_at(&pose, feature.px).expect("on the ground"));
        }
    }
    let long = places.values().filter(|p| p.len() >= 15);
    let moved = long.clone().filter(|p| (p[0] - p[p.len() - 1]).norm() > 0.5).count();
    (moved, long.count())
}

#[test]
fn people_and_vehicles_carry_ground_features_along() {
    assert_eq!(riding(&flown(&[], 3)).0, 0);
    for with in [("people", 2.0), ("convoy", 1.0)] {
        let (moved, all) = riding(&flown(&[with], 3));
        assert!((all / 8..all * 2 / 3).contains(&moved), "{with:?}: {moved} of {all} features ride");
    }
}

#[test]
fn people_walk_near_the_vehicle_and_show_in_frames() {
    let (with, plain) = (flown(&[("people", 3.0)], 2), flown(&[], 2));
    for t in moments(&with) {
        let vehicle = with.vehicle(0, t);
        for person in 1..4 {
            let person = with.mover(person, t);
            let apart = (person.north_m - vehicle.north_m).hypot(person.east_m - vehicle.east_m);
            assert!((0.2..7.0).contains(&apart), "{apart} m");
        }
    }
    let picture = |world: &Arc<World>| {
        let mut image = GrayImage::default();
        render::Renderer::new(Arc::clone(world)).render(world.time(9.0), 0, &mut image);
        image
    };
    let differs =
        picture(&with).data.iter().zip(&picture(&plain).data).filter(|(a, b)| a.abs_diff(**b) > 20).count();
    // A person is some 20 by 30 px from above.
    assert!((500..12_000).contains(&differs), "{differs} pixels differ");
}

#[test]
fn the_same_ids_are_seen_twice() {
    let world = flown(&[("same-ids", 1.0)], 2);
    let mut suite = SensorSuite::new(Arc::clone(&world));
    let (mut frames, mut twice) = (0, 0);
    while let Some(sample) = suite.next() {
        let Sample::Frame { .. } = sample else { continue };
        frames += 1;
        let seen = suite.observations().markers.iter();
        twice += u32::from(seen.filter(|m| matches!(m.marker, MarkerId::Tag { id: 0, .. })).count() == 2);
    }
    assert!(twice > frames * 3 / 4, "{twice} of {frames} frames show tag 0 twice");
    // In a picture too.
    let mut image = GrayImage::default();
    render::Renderer::new(Arc::clone(&world)).render(world.time(9.0), 0, &mut image);
    let family = world.rig().target[0].marker[0].family.expect("a tag");
    let mut detector = Detector::new(&[family], Limits { min_px: 10.0, max_hamming: 1 });
    assert_eq!(detector.detect(image.view()).iter().filter(|d| d.id == 0).count(), 2);
}

#[test]
fn stamps_jitter_and_are_late() {
    let errors = |with: &[(&str, f64)]| -> (f64, f64) {
        let frames = SensorSuite::new(flown(with, 6)).filter_map(|sample| match sample {
            Sample::Frame { truth, .. } => Some((truth.t_stamp - truth.t_true).ms()),
            _ => None,
        });
        mean_and_rms(&frames.collect::<Vec<_>>())
    };
    let (mean, rms) = errors(&[("stamp-jitter", 3.0), ("camera-late", 40.0)]);
    assert!((mean - 40.0).abs() < 0.6 && (rms - 3.0).abs() < 0.3, "{mean} ± {rms} ms");
    let (mean, rms) = errors(&[]);
    assert!(mean.abs() < 0.02 && rms < 0.1, "{mean} ± {rms} ms");
}

#[test]
fn a_rolling_shutter_is_drawn_as_configured() {
    let with = [("readout", 40.0), ("speed", 4.0)];
    let (world, still) = (flown(&with, 8), flown(&with[1..], 8));
    let family = world.rig().target[0].marker[0].family.expect("a tag");
    let mut detector = Detector::new(&[family], Limits { min_px: 10.0, max_hamming: 1 });
    let (mut image, mut bent) = (GrayImage::default(), 0.0_f64);
    for t_s in [5.0, 12.0, 19.0] {
        let t = world.time(t_s);
        render::Renderer::new(Arc::clone(&world)).with_threads(2).render(t, 0, &mut image);
        for found in detector.detect(image.view()) {
            let truth = world.marker(0, found.id as usize, t).expect("below the camera");
            let off = (found.center_px - truth.center_px).norm();
            assert!(off < 0.5, "tag {} at {t_s} s: {off} px off", found.id);
            let global = still.marker(0, found.id as usize, t).expect("below the camera");
            bent = bent.max((truth.center_px - global.center_px).norm());
        }
    }
    assert!(bent > 1.0, "the shutter moved nothing: {bent} px");
}

#[test]
fn vehicles_sway_bounce_and_slide() {
    let world = flown(&[("sway", 3.0), ("bounce", 5.0), ("slip", 10.0)], 5);
    let mut figures: [Vec<f64>; 3] = Default::default();
    for t in moments(&world) {
        let vehicle = world.vehicle(0, t);
        figures[0].push(vehicle.pitch_rad.to_degrees());
        figures[1].push(vehicle.lift_m);
        let h = Span::from_ms(1.0);
        let (before, after) = (world.vehicle(0, t - h), world.vehicle(0, t + h));
        let (north, east) = (after.north_m - before.north_m, after.east_m - before.east_m);
        figures[2].push(wrap_angle(east.atan2(north) - vehicle.heading_rad).to_degrees());
        let (s, c) = vehicle.heading_rad.sin_cos();
        assert!(
            ((north * c + east * s) / (2.0 * h.s()) - vehicle.speed_mps).abs() < 5e-3,
            "speed is along the heading"
        );
        // A tag on the roof moves as its body does.
        let tag = vehicle.ned_of(&Vector3::new(0.0, 0.0, -0.55));
        assert!((tag.z + 0.55 + vehicle.lift_m).abs() < 0.01 && tag.z != -0.55);
    }
    let rms = figures.map(|f| mean_and_rms(&f).1);
    assert!((rms[0] - 2.1).abs() < 0.5 && (rms[1] - 0.035).abs() < 0.009, "{rms:?}");
    assert!((6.0..14.0).contains(&rms[2]), "slides by {}°", rms[2]);
}

#[test]
fn vehicles_spin_hurry_and_wait() {
    let spins = flown(&[("spin", 0.8)], 2);
    let on_the_spot = moments(&spins).map(|t| spins.vehicle(0, t)).filter(|v| v.speed_mps.abs() < 0.05);
    assert!(on_the_spot.filter(|v| (v.yaw_rate_radps - 0.8).abs() < 0.02).count() > 15);
    assert_eq!(spins.scenario().rig.target[0].model, windhover_base::settings::TargetModel::Ackermann);

    let hurries = flown(&[("hurry", 3.0)], 2);
    let h = Span::from_ms(10.0);
    let hardest = (0..2_000).map(|k| {
        let t = hurries.time(1.0 + f64::from(k) * 0.014);
        (hurries.vehicle(0, t + h).speed_mps - hurries.vehicle(0, t - h).speed_mps).abs() / (2.0 * h.s())
    });
    let hardest = hardest.fold(0.0, f64::max);
    assert!((hardest - 3.0).abs() < 0.3, "{hardest} m/s²");

    let waits = flown(&[("from-rest", 10.0)], 2);
    assert!(waits.vehicle(0, waits.time(9.9)).speed_mps.abs() < 1e-9);
    assert!((waits.vehicle(0, waits.time(16.0)).speed_mps - 0.8).abs() < 0.01);
}

#[test]
fn vehicles_are_hidden_now_and_then() {
    let world = Arc::new(World::new(scenario("brief-returns", &[]), 2));
    let mut suite = SensorSuite::new(world);
    let (mut frames, mut empty) = (0, 0);
    while let Some(sample) = suite.next() {
        let Sample::Frame { .. } = sample else { continue };
        frames += 1;
        empty += u32::from(suite.observations().markers.is_empty());
    }
    // 5 frames a second; four times a second and a half.
    assert!((145..=150).contains(&frames) && (24..=40).contains(&empty), "{empty} of {frames}");
}

#[test]
fn the_antenna_is_elsewhere_and_the_receiver_wanders_further() {
    for [plain, moved] in fixes(&[("antenna", 100.0)], 3) {
        let (north, east) = (
            (moved.lat_deg.expect("a fix") - plain.lat_deg.expect("a fix")) * 110_860.0,
            (moved.lon_deg.expect("a fix") - plain.lon_deg.expect("a fix")) * 96_400.0,
        );
        assert!((north.hypot(east) - 1.0).abs() < 0.06, "{north} {east}");
    }
    let errors: Vec<f64> = (0..16)
        .flat_map(|seed| fixes(&[("gps-wander", 3.0)], seed).into_iter().step_by(40))
        .map(|[plain, far]| (far.lat_deg.expect("a fix") - plain.lat_deg.expect("a fix")) * 110_860.0)
        .collect();
    // Three times the same draws, less once: two times 1.5 m.
    let rms = mean_and_rms(&errors).1;
    assert!((2.0..4.0).contains(&rms), "{rms} m");
}

#[test]
fn a_receiver_that_filters_its_velocity_is_late_with_it() {
    let pairs = fixes(&[("velocity-filter", 0.3)], 3);
    let north = |epoch: &windhover_base::msg::GnssEpoch| epoch.vel_ned_mps.expect("a fix").x;
    assert!(pairs.iter().all(|[a, b]| a.lat_deg == b.lat_deg), "position stays");
    // Least squares of filtered − plain on the acceleration, of epochs 0.2 s apart.
    let (mut xy, mut xx) = (0.0, 0.0);
    for three in pairs.windows(3) {
        let acceleration = (north(&three[2][0]) - north(&three[0][0])) / 0.4;
        xy += acceleration * (north(&three[1][1]) - north(&three[1][0]));
        xx += acceleration * acceleration;
    }
    let lag = -xy / xx;
    assert!((0.15..0.35).contains(&lag), "late by {lag} s");
}

#[test]
fn delays_are_drawn_from_the_configured_sigma() {
    let drawn: Vec<f64> = (0..120)
        .map(|seed| {
            let mut scenario = scenario("hover10", &[("gps-delay", 1.0)]);
            scenario.duration_s = 0.1;
            SensorSuite::new(Arc::new(World::new(scenario, seed))).gps_latency_error().ms()
        })
        .collect();
    let (mean, rms) = mean_and_rms(&drawn);
    assert!(mean.abs() < 12.0 && (rms - 40.0).abs() < 8.0, "{mean} ± {rms} ms");
}

#[test]
fn compasses_read_tilt_each_in_its_way() {
    let slope = |pairs: &[[f64; 2]]| {
        let (xy, xx) = pairs.iter().fold((0.0, 0.0), |(xy, xx), [read, t]| (xy + read * t, xx + t * t));
        xy / xx
    };
    let share = slope(&tilts(&[("tilt-share", 15.0), ("wind", 8.0)], 3));
    assert!((share - 0.15).abs() < 0.02, "{share}");
    // A rotor pushes along its axis: what is felt of a tilt is what the air adds to the force.
    let calm = [("feels-force", 1.0), ("wind", 0.0), ("gusts", 0.0), ("restless", 0.8)];
    let felt = slope(&tilts(&calm, 3));
    assert!(felt.abs() < 0.35, "{felt} of the tilt is felt in calm air");
    let blown = slope(&tilts(&[("feels-force", 1.0), ("wind", 8.0)], 3));
    assert!(blown > 0.6, "{blown} of the tilt that holds against the wind is felt");
    let slow: Vec<f64> = (0..16)
        .flat_map(|seed| tilts(&[("ahrs-error", 1.5)], seed).into_iter().step_by(50))
        .map(|[read, t]| read - t)
        .collect();
    let rms = mean_and_rms(&slow).1;
    assert!((1.0..2.0).contains(&rms), "{rms}°");
}

#[test]
fn trim_tilts_the_body_under_its_rotor() {
    let (with, plain) = (flown(&[("trim", 6.0), ("wind", 0.0)], 3), flown(&[("wind", 0.0)], 3));
    for t in moments(&with) {
        let (a, b) = (with.ownship(t), plain.ownship(t));
        assert_eq!(a.position_ned_m, b.position_ned_m);
        assert!(((a.ned_from_body.inverse() * b.ned_from_body).angle().to_degrees() - 6.0).abs() < 1e-6);
        let h = Span::from_ms(1.0);
        let (before, after) = (with.ownship(t - h), with.ownship(t + h));
        let rate = (before.ned_from_body.inverse() * after.ned_from_body).scaled_axis() / (2.0 * h.s());
        assert!((rate - a.body_rate_radps).norm() < 1e-3);
        assert!((euler_321(&a.ned_from_body).0 - a.heading_rad).abs() < 1e-9);
    }
}

#[test]
fn lens_mount_and_vibration_move_the_picture() {
    let plain = flown(&[], 7);
    let centre = |world: &World, t| world.marker(0, 0, t).expect("below").center_px;
    for (with, least, most) in [
        (("focal", 1.0), 0.0, 7.0),
        (("no-distortion", 1.0), 0.0, 0.0),
        (("vibration", 0.1), 0.02, 10.0),
        (("mount", 2.0), 20.0, 90.0),
        (("image-top", 2.0), 5.0, 1600.0),
    ] {
        let world = flown(&[with], 7);
        for t in moments(&plain).step_by(9) {
            let moved = (centre(&world, t) - centre(&plain, t)).norm();
            assert!((least..=most).contains(&moved), "{with:?}: {moved} px");
        }
    }
    let configured = scenario("follow", &[("no-distortion", 1.0)]);
    assert_eq!(configured.rig.camera.intrinsics.distortion, [0.0; 5]);
}
