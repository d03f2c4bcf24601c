//! Frames in time: stamps that jitter, rows that are exposed one after the other.

use std::sync::Arc;

use windhover_base::geo::{Ground, wrap_angle};
use windhover_base::msg::{MisfitCause, Stamped, TrackStatus};
use windhover_base::settings::EstimatorConfig;
use windhover_base::time::FrameClock;
use windhover_estimate::{Estimator, EstimatorOutput, Site};
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

/// Everything the filter says of a flight, with pixels as sharp as rendered ones.
pub(super) fn flown(described: &str, seconds: f64, seed: u64) -> (Arc<World>, Vec<EstimatorOutput>) {
    let mut scenario = Scenario::described(described).expect("known names, figures within limits");
    scenario.duration_s = seconds;
    (scenario.camera.marker_noise_px, scenario.camera.feature_noise_px) = (0.03, 0.1);
    let world = Arc::new(World::new(scenario, seed));
    let declination_rad = world.scenario().declination_deg.to_radians();
    let site = Site { frame: *world.frame(), ground: Ground::Flat { down_m: 0.0 }, declination_rad };
    let mut filter = Estimator::new(&world.scenario().rig, &EstimatorConfig::default(), &site);
    let (mut suite, mut out) = (SensorSuite::new(Arc::clone(&world)), Vec::new());
    let mut exposures = FrameClock::default();
    while let Some(sample) = suite.next() {
        match &sample {
            Sample::Gnss { stamped, .. } => filter.gnss(stamped, &mut out),
            Sample::Attitude { stamped, .. } => filter.attitude(stamped, &mut out),
            Sample::Frame { truth, seq } => {
                let value = suite.observations().clone();
                let (t_valid, t_recv) = (exposures.exposed(truth.t_stamp, truth.t_recv), truth.t_recv);
                filter.frame(&Stamped { t_valid, t_recv, seq: *seq, value }, &mut out);
            }
        }
    }
    (world, out)
}

/// Root mean squares of heading and speed errors from 6 s on, over two seeds.
pub(super) fn errors(described: &str) -> [f64; 2] {
    let (mut sums, mut n) = ([0.0; 2], 0.0);
    for seed in 1..3 {
        let (world, out) = flown(described, 20.0, seed);
        for output in out {
            let EstimatorOutput::Estimate(e) = output else { continue };
            if world.seconds(e.t_valid) < 6.0 || e.status != TrackStatus::Tracking {
                continue;
            }
            let (state, truth) = (e.state.expect("tracked"), world.vehicle(0, e.t_valid));
            sums[0] += wrap_angle(state.heading_rad - truth.heading_rad).powi(2);
            sums[1] += (state.speed_mps - truth.speed_mps).powi(2);
            n += 1.0;
        }
    }
    sums.map(|sum: f64| (sum / n).sqrt())
}

/// By how much the camera is reported to be late, s, the last time it was.
fn reported_late_s(out: &[EstimatorOutput]) -> Option<f64> {
    let mut late = out.iter().filter_map(|output| match output {
        EstimatorOutput::Misfit(misfit) if misfit.cause == MisfitCause::Late => Some(misfit.figure),
        _ => None,
    });
    late.next_back()
}

#[test]
fn a_camera_that_is_late_is_found_out_and_its_frames_put_where_they_belong() {
    for (seed, late_ms) in [(1, 40.0), (2, 40.0), (3, 25.0)] {
        let (world, out) = flown(&format!("follow+camera-late={late_ms}"), 24.0, seed);
        let reported_ms = 1e3 * reported_late_s(&out).expect("it is reported");
        assert!((reported_ms - late_ms).abs() < 5.0, "seed {seed}: {reported_ms} ms reported for {late_ms}");
        let estimates = out.iter().filter_map(|output| match output {
            EstimatorOutput::Estimate(e) if world.seconds(e.t_valid) > 20.0 => Some(e),
            _ => None,
        });
        let errors: Vec<f64> = estimates
            .map(|e| {
                let state = e.state.expect("tracked");
                wrap_angle(state.heading_rad - world.vehicle(0, e.t_valid).heading_rad)
            })
            .collect();
        let heading = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        assert!(heading < 0.006, "seed {seed}: heading {heading} rad");
    }
}

#[test]
fn another_clock_that_is_late_is_not_taken_for_the_cameras() {
    for described in [
        "follow",
        "follow+compass-late=60",
        "follow+gps-late=150",
        // Both early, by different times.
        "follow+compass-late=-20+gps-late=-100",
        "hover20",
        "follow+stamp-jitter=3",
    ] {
        let (_, out) = flown(described, 24.0, 2);
        assert_eq!(reported_late_s(&out), None, "{described}");
    }
}

#[test]
fn a_rolling_shutter_costs_little_configured_or_not() {
    let whole = errors("follow");
    for described in ["follow+told-readout=25", "follow+readout=25"] {
        let rolling = errors(described);
        for (k, what) in ["heading", "speed"].into_iter().enumerate() {
            assert!(
                rolling[k] < 1.3 * whole[k],
                "{described}: {what} {} for {} where all rows are exposed together",
                rolling[k],
                whole[k]
            );
        }
    }
}

#[test]
fn the_time_from_first_row_to_last_is_found_out_where_it_is_not_as_configured() {
    let found = |described: &str| {
        let (_, out) = flown(described, 12.0, 3);
        out.iter().rev().find_map(|output| match output {
            EstimatorOutput::Misfit(misfit) if misfit.cause == MisfitCause::Readout => Some(misfit.figure),
            _ => None,
        })
    };
    let readout_s = found("follow+readout=25").expect("it is reported");
    assert!((readout_s - 0.025).abs() < 0.002, "{readout_s}");
    for fits in ["follow", "follow+told-readout=25", "hover20", "follow+camera-late=20"] {
        assert_eq!(found(fits), None, "{fits}");
    }
}

#[test]
fn stamps_that_jitter_cost_little() {
    let steady = errors("follow");
    for (jitter_ms, most) in [(1.0, 1.6), (3.0, 1.9), (10.0, 3.0)] {
        let jittering = errors(&format!("follow+stamp-jitter={jitter_ms}"));
        assert!(jittering[1] < most * steady[1], "{jitter_ms} ms: speed {} for {}", jittering[1], steady[1]);
    }
}
