//! Incomplete recordings: each is refined as far as possible, or refused with a reason.

use windhover_base::msg::{MarkerId, TagFamily};
use windhover_base::settings::EstimatorConfig;
use windhover_base::time::Span;
use windhover_refine::{OutsidePosition, Recording, RefineError, Refined, SurveyedMarker, refine};

use crate::flown::{Flown, fly};

fn of(flown: &Flown, recordings: &[Recording]) -> Result<Refined, RefineError> {
    let rig = &flown.world.scenario().rig;
    refine(rig, &EstimatorConfig::default(), &flown.site, recordings, &mut |_| true)
}

#[test]
fn without_fixes_or_compass_there_is_nothing_to_begin_from() {
    let flown = fly("follow", 3.0, 1, |_| {});
    let whole = &flown.recording;
    let no_fixes = Recording { epochs: Vec::new(), ..whole.clone() };
    assert_eq!(of(&flown, &[no_fixes]).err(), Some(RefineError::NoFix));
    let no_compass = Recording { readings: Vec::new(), ..whole.clone() };
    assert_eq!(of(&flown, &[no_compass]).err(), Some(RefineError::NoCompass));
    assert_eq!(of(&flown, &[Recording::default()]).err(), Some(RefineError::NoFix));
}

#[test]
fn without_a_camera_the_helicopter_is_estimated() {
    let flown = fly("follow", 8.0, 2, |_| {});
    let blind = Recording { frames: Vec::new(), ..flown.recording.clone() };
    let refined = of(&flown, &[blind]).expect("fixes and readings");
    assert!(refined.targets.is_empty());
    let (_, last) = refined.own.last().expect("the helicopter");
    let truth = flown.world.ownship(last.t_valid);
    let off = last.velocity_ned_mps - truth.velocity_ned_mps;
    assert!(off.norm() < 0.3, "velocity is off by {off}");
}

#[test]
fn one_frame_is_enough_for_a_place() {
    let flown = fly("follow", 6.0, 3, |_| {});
    let frame = flown.recording.frames[60].clone();
    let one = Recording { frames: vec![frame.clone()], ..flown.recording.clone() };
    let refined = of(&flown, &[one]).expect("fixes and readings");
    let [(_, estimate)] = &refined.targets[..] else {
        panic!("one frame, {} estimates", refined.targets.len())
    };
    let state = estimate.state.expect("its markers are in it");
    let truth = flown.world.vehicle(0, frame.t_valid);
    let off = nalgebra::Vector2::new(state.north_m - truth.north_m, state.east_m - truth.east_m);
    assert!(off.norm() < 8.0, "off by {off}");
}

#[test]
fn behind_a_long_silence_the_trajectory_begins_anew() {
    let flown = fly("follow", 30.0, 4, |_| {});
    let gone = |t: windhover_base::time::MonoTime| (8.0..22.0).contains(&flown.world.seconds(t));
    let mut holed = flown.recording.clone();
    holed.epochs.retain(|e| !gone(e.t_valid));
    holed.readings.retain(|r| !gone(r.t_valid));
    holed.frames.retain(|f| !gone(f.t_valid));
    let refined = of(&flown, &[holed]).expect("two flights in one");
    assert_eq!(refined.begins.len(), 2);
    let latest = refined.targets.iter().rev().find_map(|(_, e)| e.state.map(|s| (e.t_valid, s)));
    let (t, state) = latest.expect("seen again");
    let truth = flown.world.vehicle(0, t);
    assert!((state.speed_mps - truth.speed_mps).abs() < 0.1);
}

/// Two flights over the same markers have their constants in common.
#[test]
fn several_flights_share_their_constants() {
    let flown = fly("follow", 8.0, 5, |_| {});
    let (first, mut second) = (flown.recording.clone(), flown.recording.clone());
    // The same flight once more, an hour later.
    let later = Span::from_s(3600.0);
    second.epochs.iter_mut().for_each(|e| (e.t_valid, e.t_recv) = (e.t_valid + later, e.t_recv + later));
    second.readings.iter_mut().for_each(|r| (r.t_valid, r.t_recv) = (r.t_valid + later, r.t_recv + later));
    second.frames.iter_mut().for_each(|f| (f.t_valid, f.t_recv) = (f.t_valid + later, f.t_recv + later));
    let alone = of(&flown, std::slice::from_ref(&first)).expect("a flight");
    let both = of(&flown, &[first, second]).expect("two flights");
    assert_eq!(both.own.len(), 2 * alone.own.len());
    for (one, two) in alone.constants.iter().zip(&both.constants) {
        assert!(two.sigma <= 1.05 * one.sigma, "{one:?} {two:?}");
    }
}

/// With an external position the receiver's error is removed.
#[test]
fn with_positions_from_outside_the_place_is_theirs() {
    let flown = fly("follow", 8.0, 6, |_| {});
    let mut recording = flown.recording.clone();
    let arm = nalgebra::Vector3::from(flown.world.scenario().rig.gps.antenna_position_m);
    for k in 0..70 {
        let t = flown.world.time(0.5 + 0.1 * f64::from(k));
        let own = flown.world.ownship(t);
        let at = flown.site.frame.geodetic(&(own.position_ned_m + own.ned_from_body * arm));
        recording.positions.push(OutsidePosition { t, at, sigma_m: [0.02, 0.02, 0.04] });
    }
    let refined = of(&flown, &[recording]).expect("a flight");
    let (_, estimate) = refined.targets[refined.targets.len() / 2];
    let state = estimate.state.expect("in view");
    let truth = flown.world.vehicle(0, estimate.t_valid);
    let reference = truth.reference(flown.world.scenario().rig.target[0].reference_m);
    let off = nalgebra::Vector2::new(state.north_m - reference.x, state.east_m - reference.y);
    assert!(off.norm() < 0.3, "off by {off}");
    let sigma = state.covariance.expect("reported")[(0, 0)].sqrt();
    assert!(sigma < 0.3, "{sigma}");
}

/// With a surveyed marker the receiver's error is removed likewise.
#[test]
fn over_a_surveyed_marker_the_place_is_known() {
    let flown = fly("static-survey", 8.0, 7, |_| {});
    let (mut recording, rig) = (flown.recording.clone(), &flown.world.scenario().rig);
    let vehicle = flown.world.vehicle(0, flown.world.time(0.0));
    let place = nalgebra::Vector3::new(vehicle.north_m, vehicle.east_m, 0.0);
    let id = rig.target[0].marker[0].id.expect("a tag");
    recording.surveyed.push(SurveyedMarker {
        marker: MarkerId::Tag { family: TagFamily::default(), id },
        at: flown.site.frame.geodetic(&place),
        sigma_m: 0.02,
    });
    let refined = of(&flown, &[recording]).expect("a flight");
    let (_, own) = refined.own[refined.own.len() / 2];
    let truth = flown.world.ownship(own.t_valid);
    let off = (own.position_ned_m - truth.position_ned_m).xy();
    let sigma = own.position_sigma_m().xy();
    assert!(off.norm() < 3.0 * sigma.norm() && sigma.norm() < 0.5, "off by {off} ± {sigma}");
}

#[test]
fn who_stops_gets_nothing() {
    let flown = fly("follow", 3.0, 1, |_| {});
    let recordings = std::slice::from_ref(&flown.recording);
    let rig = &flown.world.scenario().rig;
    let stopped =
        refine(rig, &EstimatorConfig::default(), &flown.site, recordings, &mut |share| share < 0.01);
    assert_eq!(stopped.err(), Some(RefineError::Stopped));
}
