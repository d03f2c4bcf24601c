//! Flights that their configuration does not fit: sigmas remain those of errors, and constants are found.

use nalgebra::{Rotation3, Vector3};
use windhover_base::geo::ned_from_body_321;
use windhover_base::msg::FeltTilt;
use windhover_refine::{ConstantKind as Kind, Refined};
use windhover_simulate::Scenario;

use crate::flown::{Flown, Score, fly};

/// Largest normalised square of heading, speed and yaw rate together; 3 is ideal.
const MOST_NEES: f64 = 4.2;
/// Deviations that a refinement of measurements can meet: those of the ground and of the camera's quarter turns are the
/// pipeline's.
const OF_MARKERS: [&str; 6] =
    ["tag-size", "one-tag-size", "one-tag-ahead", "one-tag-right", "one-tag-turn", "people"];
const OF_VEHICLES: [&str; 5] = ["sway", "bounce", "rolls-and-bounces", "slip", "hurry"];
const OF_TIME: [&str; 6] =
    ["readout", "stamp-jitter", "gps-late", "compass-late", "camera-late", "vibration"];
const OF_RIG: [&str; 7] =
    ["antenna", "velocity-filter", "gps-wander", "focal", "no-distortion", "mount", "iron"];

/// The true value of a constant in a scenario; `None` where it is not known here.
fn truth(kind: Kind, scenario: &Scenario) -> Option<f64> {
    let (misfit, camera) = (&scenario.misfit, &scenario.camera);
    let [yaw, pitch, roll] = camera.mount_error_deg.map(f64::to_radians);
    let mount: Rotation3<f64> = ned_from_body_321(yaw, pitch, roll);
    match kind {
        Kind::Mount(i) => Some(mount.scaled_axis()[i]),
        Kind::CameraAt(_) => Some(0.0),
        Kind::AntennaAt(i) => Some(Vector3::from(misfit.antenna_m)[i]),
        Kind::Focal => Some((1.0 + misfit.focal).ln()),
        Kind::CameraDelay => Some(1e-3 * camera.stamp_late_ms),
        Kind::Readout => Some(1e-3 * (camera.readout_ms - scenario.rig.camera.readout_ms)),
        _ => None,
    }
}

/// Errors of the constants with a known truth, over their sigmas.
fn normalised(refined: &Refined, scenario: &Scenario) -> Vec<(Kind, f64)> {
    let estimated = refined.constants.iter().filter(|constant| constant.prior_sigma > 0.0);
    let error =
        |c: &windhover_refine::Constant| Some((c.kind, (c.value - truth(c.kind, scenario)?) / c.sigma));
    estimated.filter_map(error).collect()
}

/// Asserts that sigmas are those of the errors, and that the error of speed is below this share of the filter's.
fn assert_honest_and_closer(flown: &Flown, share: f64) {
    let refined = flown.refined();
    let score = Score::of(refined.targets.iter().map(|(_, e)| e), &flown.world);
    let filter = Score::of(&flown.filtered(), &flown.world);
    assert!(score.nees < MOST_NEES * score.frames, "{score}");
    assert!(score.rms(1) < share * filter.rms(1), "{score}\nfilter: {filter}");
}

/// A vehicle that sways is seen to sway: its sigmas are those of its errors.
#[test]
fn a_vehicle_that_sways_is_not_believed_to_drive_so() {
    let flown = fly("rolls-and-bounces", 16.0, 2, |_| {});
    assert_honest_and_closer(&flown, 0.6);
}

/// A body that sways by less than a pixel's noise: its motion is not taken for driving.
#[test]
fn a_body_that_sways_a_little_is_not_believed_to_drive_so() {
    let flown = fly("follow", 16.0, 3, |scenario| scenario.deviate("sway", Some(1.5)).expect("known"));
    assert_honest_and_closer(&flown, 0.4);
}

/// Where a receiver that filters its velocity hides from the filter what the tilt sensor measures, the whole flight shows it, and no
/// part of the rig absorbs the difference.
#[test]
fn what_the_tilt_sensor_measures_is_found_by_the_whole_flight() {
    let flown = fly("all-a-little", 16.0, 3, |_| {});
    let refined = flown.refined();
    assert_eq!(refined.felt, Some(FeltTilt::Force));
    let of = |kind: Kind| *refined.constants.iter().find(|c| c.kind == kind).expect("estimated");
    for kind in [Kind::Mount(0), Kind::Mount(1), Kind::Mount(2), Kind::Focal, Kind::AntennaAt(2)] {
        let (constant, truth) = (of(kind), truth(kind, flown.world.scenario()).expect("known"));
        assert!((constant.value - truth).abs() < 3.5 * constant.sigma, "{constant:?}, truth {truth}");
    }
    // Of 0.2 s in velocity against 0.1 s in position.
    let delay = of(Kind::VelocityDelay);
    assert!(delay.value > 0.05 && delay.is_determined(), "{delay:?}");
}

/// A camera whose stamps are late: that it is late against compass and receiver is known, which of them are wrong is not.
#[test]
fn a_camera_that_is_late_leaves_absolute_time_unknown() {
    let flown = fly("camera-late", 14.0, 3, |_| {});
    let refined = flown.refined();
    let score = Score::of(refined.targets.iter().map(|(_, e)| e), &flown.world);
    assert!(score.nees < MOST_NEES * score.frames, "{score}");
    let delay = refined.constants.iter().find(|c| c.kind == Kind::CameraDelay).expect("estimated");
    assert!((delay.value - 0.04).abs() < 3.0 * delay.sigma && delay.sigma > 0.01, "{delay:?}");
    let clock = refined.clocks.iter().find(|clock| clock.other == Kind::CompassDelay).expect("estimated");
    assert!(clock.is_settled() && clock.sigma_s < 0.5 * delay.sigma, "{clock:?}");
}

/// A rolling shutter that vibrates: frames are displaced row by row, and nothing else is believed to be wrong.
#[test]
fn a_rolling_shutter_that_vibrates_shows_no_other_misfit() {
    let flown = fly("shaken-shutter", 12.0, 4, |_| {});
    let refined = flown.refined();
    let score = Score::of(refined.targets.iter().map(|(_, e)| e), &flown.world);
    let filter = Score::of(&flown.filtered(), &flown.world);
    assert!(score.nees < 6.0 * score.frames, "{score}");
    assert!(score.rms(1) < 0.4 * filter.rms(1), "{score}\nfilter: {filter}");
    for (kind, off) in normalised(&refined, flown.world.scenario()) {
        assert!(off.abs() < 3.5, "{kind:?} is off by {off} sigmas");
    }
}

/// Flies scenarios and prints their errors: every one must have consistent sigmas, and of the constants 95 % must be within three
/// sigmas.
fn meet(names: &[&str]) {
    let (mut within, mut all, mut over) = (0usize, 0usize, Vec::new());
    for name in names {
        let flown = fly(name, 20.0, 3, |_| {});
        let filter = Score::of(&flown.filtered(), &flown.world);
        let refined = flown.refined();
        let score = Score::of(refined.targets.iter().map(|(_, e)| e), &flown.world);
        println!("{name}, filter: {filter}\n{name}, refined: {score}");
        if score.nees > MOST_NEES * score.frames {
            over.push((name, score.nees / score.frames));
        }
        for (kind, off) in normalised(&refined, flown.world.scenario()) {
            (within, all) = (within + usize::from(off.abs() < 3.0), all + 1);
            if off.abs() >= 3.0 {
                println!("  {kind:?} is off by {off:.1} sigmas");
            }
        }
    }
    println!("{within} of {all} constants within three sigmas; over: {over:.1?}");
    assert!(within as f64 >= 0.95 * all as f64, "{within} of {all}");
    assert!(over.is_empty(), "{over:?}");
}

// `cargo test -p windhover-refine --test refine -- --ignored --nocapture proof_`

/// Everything a little, over flights: of heading each flight is one draw.
#[test]
#[ignore = "minutes"]
fn proof_all_a_little_stays_near_its_sigmas() {
    let mut all = [Score::default(); 2];
    for seed in 1..=6 {
        let flown = fly("all-a-little", 20.0, seed, |_| {});
        all[0].add(&Score::of(&flown.filtered(), &flown.world));
        let refined = flown.refined();
        let score = Score::of(refined.targets.iter().map(|(_, e)| e), &flown.world);
        println!("all-a-little, seed {seed}, {:?}, refined: {score}", refined.felt);
        all[1].add(&score);
    }
    println!("all, filter: {}\nall, refined: {}", all[0], all[1]);
    // The aim of every misfit is MOST_NEES; with all of them at once 4.8 is reached.
    assert!(all[1].nees <= 5.5 * all[1].frames, "{}", all[1]);
}

#[test]
#[ignore = "minutes"]
fn proof_misfits_of_markers_are_met() {
    meet(&OF_MARKERS);
}

#[test]
#[ignore = "minutes"]
fn proof_misfits_of_vehicles_are_met() {
    meet(&OF_VEHICLES);
}

#[test]
#[ignore = "minutes"]
fn proof_misfits_of_time_are_met() {
    meet(&OF_TIME);
}

#[test]
#[ignore = "minutes"]
fn proof_misfits_of_the_rig_are_met() {
    meet(&OF_RIG);
}
