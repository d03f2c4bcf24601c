//! The helicopter's own state between frames: output at any instant, whatever the camera does.

use windhover_base::msg::{FrameObservations, Ownship, Stamped};
use windhover_base::time::{MonoTime, Span};
use windhover_estimate::EstimatorOutput;

use super::filter::{Flight, Input, fly};

const TENTH: i64 = 100_000_000;

/// What was received, without the camera's frames.
fn without_frames(flight: &Flight) -> Vec<Input> {
    flight.inputs.iter().filter(|input| !matches!(input, Input::Frame(_))).cloned().collect()
}

/// The filter's output at every tenth of a second between frames, and its other output.
fn outputs(flight: &Flight, inputs: &[Input], silence: Span) -> (Vec<Ownship>, Vec<EstimatorOutput>) {
    let (mut filter, mut own, mut out) = (flight.filter(), Vec::new(), Vec::new());
    let mut next = inputs[0].t_recv().ns() / TENTH + 1;
    let mut until = |t: MonoTime, filter: &mut windhover_estimate::Estimator| {
        while next * TENTH <= t.ns() {
            own.extend(filter.ownship(MonoTime::from_ns(next * TENTH)));
            next += 1;
        }
    };
    for one in inputs {
        until(one.t_recv(), &mut filter);
        one.give(&mut filter, &mut out);
    }
    let last = inputs[inputs.len() - 1].t_recv();
    until(last + silence, &mut filter);
    (own, out)
}

#[test]
fn it_goes_on_without_frames() {
    // Given a flight whose camera delivers nothing.
    let flight = fly("follow", 20.0, 3, |_| {});
    let (own, _) = outputs(&flight, &without_frames(&flight), Span::ZERO);
    // Then there is a state every tenth of a second, of no frame, with a covariance that is one.
    assert!(own.len() > 180, "{} states", own.len());
    assert!(own.windows(2).all(|w| w[1].t_valid - w[0].t_valid == Span::from_ns(TENTH)));
    for own in &own {
        assert_eq!(own.frame, None);
        assert!(own.covariance.cholesky().is_some(), "{own:?}");
        assert_eq!(own.covariance, own.covariance.transpose());
    }
    // And it is where the helicopter is.
    for own in own.iter().filter(|own| flight.world.seconds(own.t_valid) > 5.0) {
        let error = own.position_ned_m - flight.world.ownship(own.t_valid).position_ned_m;
        assert!(error.norm() < 4.0 * own.position_sigma_m().norm(), "{error:?} {own:?}");
    }
}

#[test]
fn asking_for_it_changes_nothing_else() {
    let flight = fly("follow", 6.0, 4, |_| {});
    let (own, with) = outputs(&flight, &flight.inputs, Span::ZERO);
    let (mut filter, mut without) = (flight.filter(), Vec::new());
    flight.inputs.iter().for_each(|input| input.give(&mut filter, &mut without));
    assert!(!own.is_empty());
    assert_eq!(format!("{with:?}"), format!("{without:?}"));
}

#[test]
fn at_a_frame_it_is_that_frames() {
    let flight = fly("follow", 4.0, 5, |_| {});
    let (mut filter, mut out) = (flight.filter(), Vec::new());
    flight.inputs.iter().for_each(|input| input.give(&mut filter, &mut out));
    let t = flight.inputs[flight.inputs.len() - 1].t_recv();
    let value = FrameObservations { frame: 77, ..FrameObservations::default() };
    filter.frame(&Stamped { t_valid: t, t_recv: t, seq: u64::MAX, value }, &mut out);
    let of_frame = out.iter().rev().find_map(|o| match o {
        EstimatorOutput::Ownship(own) => Some(*own),
        _ => None,
    });
    let of_frame = of_frame.expect("a frame gives the helicopter's state");
    assert_eq!(of_frame.frame, Some(77));
    assert_eq!(filter.ownship(t), Some(Ownship { frame: None, ..of_frame }));
}

#[test]
fn in_a_silence_it_grows_vague_and_ends() {
    let flight = fly("follow", 5.0, 6, |_| {});
    let inputs = without_frames(&flight);
    let (own, _) = outputs(&flight, &inputs, Span::from_s(30.0));
    let last = inputs[inputs.len() - 1].t_valid();
    let after: Vec<&Ownship> = own.iter().filter(|own| own.t_valid > last).collect();
    let (first, latest) = (after[0], after[after.len() - 1]);
    assert!(latest.position_sigma_m().norm() > 2.0 * first.position_sigma_m().norm(), "{first:?} {latest:?}");
    assert!(
        latest.attitude_sigma_rad().norm() > 2.0 * first.attitude_sigma_rad().norm(),
        "{first:?} {latest:?}"
    );
    let longest = latest.t_valid - last;
    assert!((9.5..=10.0).contains(&longest.s()), "{} s", longest.s());
}

#[test]
fn a_frame_that_is_not_taken_shows_what_is_known_of_its_time_and_nothing_later() {
    let flight = fly("follow", 12.0, 6, |_| {});
    let (mut filter, mut out) = (flight.filter(), Vec::new());
    flight.inputs.iter().for_each(|input| input.give(&mut filter, &mut out));
    let last = flight.inputs[flight.inputs.len() - 1].t_recv();
    // Stamped after its arrival by far more than clocks differ, and long before everything that is kept.
    for off in [Span::from_s(1000.0), Span::from_s(0.5), Span::from_s(-3600.0)] {
        let t_valid = last + off;
        let value = FrameObservations { frame: 77, ..FrameObservations::default() };
        out.clear();
        filter.frame(&Stamped { t_valid, t_recv: last, seq: u64::MAX, value }, &mut out);
        let estimates = out.iter().filter_map(|o| match o {
            EstimatorOutput::Estimate(e) => Some((e.frame, e.t_valid)),
            EstimatorOutput::Ownship(own) => Some((own.frame.unwrap_or(0), own.t_valid)),
            _ => None,
        });
        let estimates: Vec<(u32, MonoTime)> = estimates.collect();
        assert_eq!(estimates.len(), 2, "{off:?}: one target and the helicopter");
        for (frame, t) in estimates {
            assert!(frame == 77 && t <= last, "{off:?}: {t:?} after {last:?}");
            assert!(t == t_valid || off.s() > 0.0 || t > t_valid, "{off:?}: {t:?}");
        }
    }
}
