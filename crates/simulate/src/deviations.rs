//! The tables of deviations and of the scenarios made of them.

use super::deviation::{Composed, Deviation, Effect};
use super::misfit::GroundMisfit;
use super::scenario::{HelicopterPath, Route, Scenario, SpeedPlan};
use super::sensor_errors::HiddenMarker;

/// A row of the table: name = default amount unit (limits), the scenario that shows it, its effect, its code.
macro_rules! deviations {
    ($($effect:ident $name:literal = $usual:literal $unit:literal ($low:literal, $high:literal) in $shown_in:literal,
       $about:literal, $apply:expr;)*) => {
        &[$(Deviation {
            name: $name,
            unit: $unit,
            about: $about,
            limits: ($low, $high),
            usual: $usual,
            shown_in: $shown_in,
            effect: Effect::$effect,
            apply: $apply,
        }),*]
    };
}

/// From percent to a share.
const PERCENT: f64 = 0.01;
/// Metres in a centimetre.
const CM: f64 = 0.01;
/// When vehicles are out of view: period and first time, seconds.
const GONE_S: (f64, f64) = (6.0, 8.0);
/// And not after that, seconds.
const GONE_UNTIL_S: f64 = 600.0;
/// A step of speed of a fast driver, m/s.
const HURRY_MPS: f64 = 4.0;

/// Every deviation.
pub(super) const DEVIATIONS: &[Deviation] = deviations![
    // Markers
    Misfit "tag-size" = 5.0 "%" (-30.0, 30.0) in "follow",
        "markers larger than configured", |s, v| s.misfit.markers.size = v * PERCENT;
    Misfit "tag-turn" = 5.0 "deg" (-45.0, 45.0) in "follow",
        "markers turned clockwise", |s, v| s.misfit.markers.turn_deg = v;
    Misfit "tag-height" = 10.0 "cm" (-50.0, 50.0) in "follow",
        "markers higher than configured", |s, v| s.misfit.markers.higher_m = v * CM;
    Misfit "one-tag-size" = 5.0 "%" (-30.0, 30.0) in "follow",
        "the last marker larger than configured", |s, v| s.misfit.markers.one_size = v * PERCENT;
    Misfit "one-tag-ahead" = 5.0 "cm" (-50.0, 50.0) in "follow",
        "the last marker further forward", |s, v| s.misfit.markers.one_offset_m[0] = v * CM;
    Misfit "one-tag-right" = 5.0 "cm" (-50.0, 50.0) in "follow",
        "the last marker further to the right", |s, v| s.misfit.markers.one_offset_m[1] = v * CM;
    Misfit "one-tag-turn" = 5.0 "deg" (-45.0, 45.0) in "follow",
        "the last marker turned clockwise", |s, v| s.misfit.markers.one_turn_deg = v;
    // Ground
    Misfit "ground-lower" = 10.0 "m" (-50.0, 50.0) in "follow",
        "ground lower than configured", |s, v| s.misfit.ground = GroundMisfit::Lower(v);
    Misfit "takeoff-in-air" = 1.0 "yes" (1.0, 1.0) in "follow",
        "ground.source = \"takeoff\", and the flight starts in the air",
        |s, _| s.misfit.ground = GroundMisfit::Takeoff;
    // What else moves in view
    Misfit "people" = 2.0 "people" (0.0, 12.0) in "follow",
        "people on foot near the vehicle", |s, v| s.misfit.company.people = v as usize;
    Misfit "convoy" = 1.0 "vehicles" (0.0, 4.0) in "follow",
        "another vehicle drives along", |s, v| s.misfit.company.convoy = v as usize;
    Misfit "same-ids" = 1.0 "vehicles" (0.0, 4.0) in "follow",
        "another vehicle drives along and carries the same markers",
        |s, v| s.misfit.company.doubles = v as usize;
    // Time
    Misfit "stamp-jitter" = 3.0 "ms" (0.0, 12.0) in "follow",
        "stamps of frames jitter, one-sigma", |s, v| s.camera.stamp_noise_ms = v;
    Misfit "camera-late" = 40.0 "ms" (-200.0, 200.0) in "follow",
        "stamps of frames are late", |s, v| s.camera.stamp_late_ms = v;
    Misfit "readout" = 25.0 "ms" (-60.0, 60.0) in "follow",
        "rolling shutter: from the first row's exposure to the last one's", |s, v| s.camera.readout_ms = v;
    Condition "told-readout" = 25.0 "ms" (-60.0, 60.0) in "follow",
        "rolling shutter that is configured",
        |s, v| (s.camera.readout_ms, s.rig.camera.readout_ms) = (v, v);
    Absorbed "vibration" = 0.1 "deg" (0.0, 2.0) in "follow",
        "the camera shakes at 17 to 50 Hz, rms an axis", |s, v| s.camera.vibration_deg = v;
    Absorbed "gps-late" = 150.0 "ms" (-300.0, 500.0) in "follow",
        "GPS later than configured",
        |s, v| (s.gps.latency_offset_ms, s.gps.latency_spread_ms) = (v, 0.0);
    Condition "gps-delay" = 1.0 "sigmas" (0.0, 5.0) in "follow",
        "delay of GPS drawn from its configured sigma",
        |s, v| (s.gps.latency_sigma_ms, s.gps.latency_spread_ms) = (v * s.rig.gps.latency_sigma_ms, 0.0);
    Absorbed "compass-late" = 60.0 "ms" (-200.0, 300.0) in "follow",
        "compass later than configured",
        |s, v| (s.compass.latency_offset_ms, s.compass.latency_spread_ms) = (v, 0.0);
    // The vehicle
    Misfit "sway" = 3.0 "deg" (0.0, 15.0) in "follow",
        "the vehicle pitches and rolls", |s, v| s.misfit.driving.sway_deg = v;
    Misfit "bounce" = 5.0 "cm" (0.0, 30.0) in "follow",
        "the vehicle bounces", |s, v| s.misfit.driving.bounce_m = v * CM;
    Misfit "spin" = 0.8 "rad/s" (-2.0, 2.0) in "follow",
        "the vehicle stops and turns on the spot, though configured as ackermann",
        |s, v| s.misfit.driving.spin_radps = v;
    Misfit "slip" = 10.0 "deg" (0.0, 40.0) in "follow",
        "the vehicle slides sideways, rms of course against heading", |s, v| s.misfit.driving.slip_deg = v;
    Misfit "hurry" = 3.0 "m/s2" (0.5, 6.0) in "follow",
        "the vehicle starts and stops at this acceleration, every four seconds", hurry;
    Condition "from-rest" = 10.0 "s" (0.0, 3600.0) in "follow",
        "the vehicle stands, and starts at this time with 0.8 m/s",
        |s, v| drive(s, SpeedPlan::FromRest { rest_s: v, speed_mps: 0.8 });
    Condition "speed" = 12.0 "m/s" (0.0, 20.0) in "follow",
        "how fast the vehicle drives",
        |s, v| drive(s, SpeedPlan::Cruise { mean_mps: v, wander_mps: 0.1 * v });
    Condition "gone" = 1.5 "s" (0.0, 5.0) in "follow",
        "every six seconds the vehicle is hidden for so long", gone;
    Condition "blind" = 60.0 "s" (0.0, 3600.0) in "follow",
        "no marker shows before this time", |s, v| hide(s, 0.0, v);
    Absorbed "mud" = 30.0 "%" (0.0, 100.0) in "follow",
        "the last marker is covered in part", mud;
    Condition "fps" = 5.0 "Hz" (1.0, 120.0) in "follow",
        "frames a second, configured too", |s, v| s.rig.camera.fps = v;
    // Receiver
    Misfit "antenna" = 100.0 "cm" (-300.0, 300.0) in "follow",
        "the antenna further forward", |s, v| s.misfit.antenna_m = [v * CM, 0.0, 0.0];
    Misfit "velocity-filter" = 0.3 "s" (0.0, 2.0) in "follow",
        "the receiver filters its velocity", |s, v| s.gps.velocity_filter_s = v;
    Misfit "position-filter" = 0.3 "s" (0.0, 2.0) in "follow",
        "the receiver filters its position", |s, v| s.gps.position_filter_s = v;
    Misfit "gps-wander" = 3.0 "times" (0.0, 20.0) in "follow",
        "the receiver's slow error against the configured sigma",
        |s, v| s.gps.bias_sigma_m = v * s.rig.gps.bias_sigma_m;
    // Camera and its mount
    Absorbed "focal" = 1.0 "%" (-20.0, 20.0) in "follow",
        "focal length longer than configured", |s, v| s.misfit.focal = v * PERCENT;
    Misfit "no-distortion" = 1.0 "yes" (1.0, 1.0) in "follow",
        "the configuration leaves the lens's distortion out", |s, _| leave_distortion_out(s);
    Absorbed "mount" = 2.0 "deg" (-15.0, 15.0) in "follow",
        "the camera is turned on its mount, in yaw, pitch and roll each",
        |s, v| s.camera.mount_error_deg = [v; 3];
    Misfit "image-top" = 1.0 "quarters" (1.0, 3.0) in "follow",
        "the camera is mounted so many quarter turns further",
        |s, v| s.misfit.image_top_turns = v as usize;
    // Compass
    Absorbed "declination" = 3.0 "deg" (-30.0, 30.0) in "follow",
        "declination further east than configured", |s, v| s.declination_deg += v;
    Absorbed "iron" = 3.0 "deg" (0.0, 30.0) in "follow",
        "iron: a heading error that turns with the heading", |s, v| s.compass.iron_deg = v;
    Absorbed "tilt-share" = 15.0 "%" (0.0, 150.0) in "follow",
        "share of the tilt that the compass reads", |s, v| s.compass.tilt_gain = v * PERCENT;
    Condition "feels-force" = 1.0 "yes" (1.0, 1.0) in "follow",
        "the compass takes specific force for the vertical", |s, _| s.compass.feels_force = true;
    Condition "tilt-lag" = 0.3 "s" (0.0, 3.0) in "follow",
        "lag of the compass's tilt", |s, v| s.compass.tilt_lag_s = v;
    Condition "ahrs-error" = 1.5 "deg" (0.0, 10.0) in "follow",
        "slow error of the compass's tilt, of 30 s", |s, v| s.compass.slow_tilt_deg = v;
    // The air and the helicopter
    Condition "wind" = 8.0 "m/s" (0.0, 20.0) in "follow",
        "mean wind", |s, v| s.wind.mean_mps = v;
    Condition "gusts" = 2.0 "m/s" (0.0, 8.0) in "follow",
        "gusts, rms an axis", |s, v| s.wind.gust_mps = v;
    Condition "trim" = 3.0 "deg" (0.0, 15.0) in "follow",
        "angle between the rotor's axis and the body's", |s, v| s.helicopter.trim_deg = v;
    Condition "restless" = 0.8 "m/s2" (0.0, 4.0) in "follow",
        "restlessness of the pilot, rms", |s, v| s.helicopter.agitation_mps2 = v;
    Condition "height" = 25.0 "m" (2.0, 120.0) in "follow",
        "height over the ground", |s, v| s.helicopter.height_m = v;
    Condition "hover" = 15.0 "m" (2.0, 120.0) in "follow",
        "the helicopter hovers, at this height",
        |s, v| path(s, HelicopterPath::Hover { north_m: 0.0, east_m: 0.0 }, v);
    Condition "weave" = 15.0 "m" (2.0, 120.0) in "static-survey",
        "the helicopter weaves by 3 m each way, at this height",
        |s, v| path(s, HelicopterPath::Weave { reach_m: 3.0, period_s: 6.0 }, v);
    Condition "dash" = 30.0 "m" (2.0, 120.0) in "static-survey",
        "the helicopter dashes to and fro at 12 m/s, at this height", dash;
];

/// Scenarios made of several.
pub(super) const COMPOSED: &[Composed] = &[
    Composed {
        name: "rolls-and-bounces",
        about: "misfit: the vehicle pitches and rolls by 3 degrees and bounces by 5 cm",
        base: "follow",
        deviations: &[("sway", 3.0), ("bounce", 5.0)],
    },
    Composed {
        name: "shaken-shutter",
        about: "misfit: a rolling shutter of 25 ms on a camera that vibrates",
        base: "follow",
        deviations: &[("readout", 25.0), ("vibration", 0.1)],
    },
    Composed {
        name: "fast-shutter",
        about: "misfit: a rolling shutter of 15 ms over a vehicle at 12 m/s",
        base: "follow",
        deviations: &[("readout", 15.0), ("speed", 12.0)],
    },
    Composed {
        name: "low-ground",
        about: "misfit: ground 4 m lower than configured, from 5 m",
        base: "low",
        deviations: &[("ground-lower", 4.0)],
    },
    Composed {
        name: "still-start",
        about: "condition: the vehicle starts from rest under a very still helicopter",
        base: "follow",
        deviations: &[
            ("from-rest", 10.0),
            ("hover", 15.0),
            ("wind", 0.3),
            ("gusts", 0.05),
            ("restless", 0.02),
        ],
    },
    Composed {
        name: "brief-returns",
        about: "condition: the vehicle is out of view briefly and back, at 5 frames a second",
        base: "follow",
        deviations: &[("gone", 1.5), ("fps", 5.0)],
    },
    Composed {
        name: "all-a-little",
        about: "misfit: everything a little, as a careful user's real flight is",
        base: "follow",
        deviations: &[
            ("readout", 15.0),
            ("vibration", 0.1),
            ("sway", 1.5),
            ("camera-late", 8.0),
            ("stamp-jitter", 2.0),
            ("position-filter", 0.1),
            ("velocity-filter", 0.2),
            ("gps-late", 40.0),
            ("tag-size", 1.0),
            ("one-tag-ahead", 1.0),
            ("focal", 0.4),
            ("declination", 1.0),
            ("mount", 1.0),
            ("iron", 3.0),
            ("feels-force", 1.0),
            ("antenna", 10.0),
            ("ground-lower", 2.0),
        ],
    },
];

fn drive(scenario: &mut Scenario, speed: SpeedPlan) {
    scenario.vehicles[0].speed = speed;
}

fn hurry(scenario: &mut Scenario, acceleration_mps2: f64) {
    drive(scenario, SpeedPlan::StopAndGo { speed_mps: HURRY_MPS, go_s: 4.0, stop_s: 4.0, reverse_mps: 0.0 });
    scenario.vehicles[0].route = Route::Free { curvature_per_m: 0.05 };
    // A step of speed through two equal lags of rate ω peaks at an acceleration of step · ω / e.
    scenario.misfit.driving.drive_rate = Some(acceleration_mps2 * std::f64::consts::E / HURRY_MPS);
}

fn path(scenario: &mut Scenario, path: HelicopterPath, height_m: f64) {
    (scenario.helicopter.path, scenario.helicopter.height_m) = (path, height_m);
}

fn dash(scenario: &mut Scenario, height_m: f64) {
    path(scenario, HelicopterPath::Dash { reach_m: 32.0, speed_mps: 12.0 }, height_m);
    scenario.helicopter.limit_mps2 = 8.0;
}

/// Covers every marker of every target.
fn hide(scenario: &mut Scenario, from_s: f64, to_s: f64) {
    for (target, config) in scenario.rig.target.iter().enumerate() {
        let all =
            (0..config.marker.len()).map(|marker| HiddenMarker { target, marker, from_s, to_s, share: 1.0 });
        scenario.camera.hidden.extend(all);
    }
}

fn gone(scenario: &mut Scenario, for_s: f64) {
    let mut from_s = GONE_S.1;
    while from_s < GONE_UNTIL_S {
        hide(scenario, from_s, from_s + for_s);
        from_s += GONE_S.0;
    }
}

fn mud(scenario: &mut Scenario, percent: f64) {
    let marker = scenario.rig.target[0].marker.len() - 1;
    let to_s = f64::INFINITY;
    let muddy = HiddenMarker { target: 0, marker, from_s: 0.0, to_s, share: percent * PERCENT };
    scenario.camera.hidden.push(muddy);
}

fn leave_distortion_out(scenario: &mut Scenario) {
    let configured = &mut scenario.rig.camera.intrinsics.distortion;
    scenario.misfit.distortion = Some(std::mem::take(configured));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_is_a_scenario_and_every_name_is_one_thing() {
        let mut names: Vec<_> = DEVIATIONS.iter().map(|d| d.name).collect();
        names.extend(COMPOSED.iter().map(|c| c.name));
        names.extend(Scenario::names().iter().map(|(name, _)| *name));
        for name in &names {
            let scenario =
                Scenario::named(name).unwrap_or_else(|| panic!("{name}: what shows it is missing"));
            assert_eq!(scenario.name, *name);
        }
        let count = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), count, "a name is used twice");
    }

    #[test]
    fn figures_beyond_the_limits_are_refused() {
        let mut scenario = Scenario::named("follow").expect("known");
        for d in DEVIATIONS {
            assert!(scenario.deviate(d.name, Some(d.limits.1 + 1.0)).is_err(), "{}", d.name);
            assert!(scenario.deviate(d.name, Some(f64::NAN)).is_err(), "{}", d.name);
        }
        assert_eq!(
            scenario.deviate("wings", None),
            Err(super::super::DeviationError::Unknown("wings".into()))
        );
        let before = Scenario::named("follow").expect("known");
        assert!(scenario == before, "a refused figure changed the flight");
    }
}
