//! Own motion where no marker is in view: whether the scale of tilt is right, whether the stated variance covers the
//! error, and whether a wrong configuration of the tilt sensor is detected.

use nalgebra::Vector3;
use windhover_base::geo::euler_321;
use windhover_base::msg::{
    EstimatorOutput, FeltTilt, FrameObservations, FusionSource, InertialSample, Misfit, MisfitCause, Ownship,
    Stamped,
};
use windhover_base::settings::{EstimatorConfig, ImuConfig, TiltKind};
use windhover_estimate::Estimator;
use windhover_simulate::{HelicopterPath, Scenario, World};

use super::filter::{Flight, Input, fly};
use super::misfit::{Mover, with_movers};

/// A minute around a circle in wind with gusts, 2.4 m/s² of acceleration; the compass reads a share of the tilt.
fn circling(seed: u64, kind: TiltKind, share: f64) -> Flight {
    fly("follow", 60.0, seed, |scenario: &mut Scenario| {
        scenario.helicopter.path = HelicopterPath::Circle { radius_m: 15.0, speed_mps: 6.0 };
        (scenario.wind.mean_mps, scenario.wind.gust_mps) = (4.0, 1.0);
        scenario.compass.tilt_gain = share;
        scenario.rig.compass.tilt = kind;
    })
}

/// Estimates of the filter without sightings in its frames.
fn blind(flight: &Flight) -> Vec<EstimatorOutput> {
    let (mut filter, mut out) = (flight.filter(), Vec::new());
    for input in &flight.inputs {
        without_sight(input).give(&mut filter, &mut out);
    }
    out
}

fn without_sight(input: &Input) -> Input {
    let mut input = input.clone();
    if let Input::Frame(frame) = &mut input {
        frame.value = FrameObservations { frame: frame.value.frame, ..FrameObservations::default() };
    }
    input
}

/// Slope of estimated tilt over the true one, and mean square of tilt error over the stated variance, for each axis,
/// from a time on.
fn tilt_of(flight: &Flight, out: &[EstimatorOutput], from_s: f64) -> (f64, f64) {
    let (mut both, mut truth2, mut squares, mut n) = (0.0, 0.0, 0.0, 0.0);
    for own in ownships(out).filter(|own| flight.world.seconds(own.t_valid) > from_s) {
        let truth = flight.world.ownship(own.t_valid);
        let estimated = own.ned_from_body.to_rotation_matrix();
        let ((_, a, b), (_, c, d)) = (euler_321(&estimated), euler_321(&truth.ned_from_body));
        both += a * c + b * d;
        truth2 += c * c + d * d;
        let error = (truth.ned_from_body * estimated.inverse()).scaled_axis();
        let var = own.covariance.diagonal();
        squares += error.x.powi(2) / var[6] + error.y.powi(2) / var[7];
        n += 2.0;
    }
    (both / truth2, squares / n)
}

fn ownships(out: &[EstimatorOutput]) -> impl Iterator<Item = &Ownship> {
    out.iter().filter_map(|o| if let EstimatorOutput::Ownship(own) = o { Some(own) } else { None })
}

fn misfits(out: &[EstimatorOutput]) -> impl Iterator<Item = &Misfit> {
    out.iter().filter_map(|o| if let EstimatorOutput::Misfit(misfit) = o { Some(misfit) } else { None })
}

#[test]
fn the_scale_of_tilt_holds_and_its_error_is_covered() {
    for (kind, share) in [(TiltKind::Inertial, 1.0), (TiltKind::Auto, 1.0), (TiltKind::Auto, 0.15)] {
        let flight = circling(2, kind, share);
        let out = blind(&flight);
        let (slope, square) = tilt_of(&flight, &out, 30.0);
        let allowed = if share == 1.0 { 0.95..1.05 } else { 0.75..1.3 };
        assert!(
            allowed.contains(&slope) && square < 2.0,
            "{kind:?}, {share}: slope {slope}, square {square}"
        );
        assert_eq!(misfits(&out).count(), 0, "{kind:?}, {share}: {:?}", misfits(&out).next());
    }
}

#[test]
fn a_wrong_setting_of_the_tilt_sensor_is_detected_reported_and_not_used() {
    for (kind, share) in [(TiltKind::Inertial, 0.15), (TiltKind::Gravity, 1.0)] {
        let flight = circling(3, kind, share);
        let out = blind(&flight);
        let reported = misfits(&out).find(|m| matches!(m.cause, MisfitCause::TiltKind(_)));
        let reported = reported.unwrap_or_else(|| panic!("{kind:?}, {share}: nothing is reported"));
        let MisfitCause::TiltKind(felt) = reported.cause else { unreachable!("it was looked for") };
        let right = match felt {
            FeltTilt::Attitude => share == 1.0,
            FeltTilt::Share(found) => (found - share).abs() < 0.05,
            FeltTilt::Force => false,
        };
        assert!(right && reported.source == FusionSource::CompassTilt, "{kind:?}: {reported:?}");
        assert!(flight.world.seconds(reported.t) < 60.0, "{reported:?}");
        let found = out.iter().filter(|o| matches!(o, EstimatorOutput::TiltFelt { .. })).count();
        assert_eq!(found, 1, "{kind:?}: it is decided once");
        let (slope, square) = tilt_of(&flight, &out, 45.0);
        assert!((0.7..1.35).contains(&slope) && square < 2.5, "{kind:?}: slope {slope}, square {square}");
    }
}

#[test]
fn rates_and_forces_that_vibrate_do_not_hurt() {
    // Given gyros and accelerometers at 100 Hz with biases, and with vibration that is far from white.
    let flight = circling(4, TiltKind::Inertial, 1.0);
    let mut rig = flight.world.scenario().rig.clone();
    rig.imu = Some(ImuConfig::default());
    let mut filter = Estimator::new(&rig, &EstimatorConfig::default(), &flight.site);
    let (mut out, mut imu_s) = (Vec::new(), 0.0);
    for input in &flight.inputs {
        while imu_s < flight.world.seconds(input.t_recv()) {
            let t = flight.world.time(imu_s);
            let truth = flight.world.ownship(t);
            let shaken = 2.0 * (150.0 * imu_s).sin() + (6.0 * imu_s).sin();
            let force = truth.acceleration_ned_mps2 - Vector3::z() * 9.806_65;
            let value = InertialSample {
                rate_rps: Some(truth.body_rate_radps + Vector3::new(0.01, -0.015, 0.01)),
                force_mps2: Some(truth.ned_from_body.inverse() * force + Vector3::repeat(0.5 * shaken)),
            };
            filter.inertial(&Stamped { t_valid: t, t_recv: t, seq: 0, value }, &mut out);
            imu_s += 0.01;
        }
        without_sight(input).give(&mut filter, &mut out);
    }
    // Then they are fused, and tilt is as good and as honest as without.
    let fused = out.iter().filter(
        |o| matches!(o, EstimatorOutput::Fusion(f) if f.source == FusionSource::ImuForce && f.test_ratio < 1.0),
    );
    assert!(fused.count() > 400);
    let (slope, square) = tilt_of(&flight, &out, 15.0);
    assert!((0.95..1.05).contains(&slope) && square < 2.0, "slope {slope}, square {square}");
}

/// Over a parked vehicle whose tags are not read half of the ground features are on its roof.
#[test]
fn features_on_a_parked_vehicle_do_not_bend_own_motion() {
    let (mut tilt, mut heading, mut heading_blind) = (0.0, 0.0, 0.0);
    let seeds = 3u32..7;
    for (seed, kind) in
        seeds.clone().map(u64::from).flat_map(|seed| [(seed, TiltKind::Inertial), (seed, TiltKind::Auto)])
    {
        let hovering = fly("hover10", 30.0, seed, |scenario: &mut Scenario| {
            scenario.rig.compass.tilt = kind;
            scenario.camera.feature_noise_px = 0.1;
        });
        let roof = |world: &World, _: f64| {
            let vehicle = world.vehicle(0, world.time(0.0));
            vec![Mover { at: [vehicle.north_m, vehicle.east_m], height_m: 0.55, spread_m: 0.4, features: 4 }]
        };
        let mut flight = with_movers(hovering, roof, true);
        let without = blind(&flight);
        for input in &mut flight.inputs {
            if let Input::Frame(frame) = input {
                frame.value.markers.clear();
            }
        }
        let out = flight.outputs();
        tilt += tilt_of(&flight, &out, 8.0).1 / (2.0 * seeds.len() as f64);
        heading += heading_of(&flight, &out, 8.0) / (2.0 * seeds.len() as f64);
        heading_blind += heading_of(&flight, &without, 8.0) / (2.0 * seeds.len() as f64);
    }
    println!("squares of tilt {tilt}, of heading {heading}, blind {heading_blind}");
    assert!(tilt < 2.0, "square of tilt {tilt}");
    assert!(
        heading < f64::max(2.0, 1.2 * heading_blind),
        "square of heading {heading}, blind {heading_blind}"
    );
}

/// Mean square of the heading's error over the stated variance, from a time on.
fn heading_of(flight: &Flight, out: &[EstimatorOutput], from_s: f64) -> f64 {
    let late = ownships(out).filter(|own| flight.world.seconds(own.t_valid) > from_s);
    let squares: Vec<f64> = late
        .map(|own| {
            let truth = flight.world.ownship(own.t_valid);
            let error =
                (truth.ned_from_body * own.ned_from_body.to_rotation_matrix().inverse()).scaled_axis();
            error.z.powi(2) / own.covariance[(8, 8)]
        })
        .collect();
    squares.iter().sum::<f64>() / squares.len() as f64
}
