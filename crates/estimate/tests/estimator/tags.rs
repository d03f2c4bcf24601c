//! Tags of another size than configured: found by each other at once, and nothing else is taken for the cause.

use windhover_base::geo::Ground;
use windhover_base::msg::{EstimatorOutput, MisfitCause};

use super::filter::{Flight, fly};

/// Time of each report of a misfit from the first estimate on, s, its cause and figure.
fn reports(flight: &Flight, marker: usize, larger: f64) -> Vec<(f64, MisfitCause, f64)> {
    let mut rig = flight.rig().clone();
    rig.target[0].marker[marker].size_m = rig.target[0].marker[marker].size_m.map(|m| m / larger);
    let mut first_s = None;
    let mut found = Vec::new();
    for output in flight.outputs_as(&rig, Ground::Flat { down_m: 0.0 }) {
        match output {
            EstimatorOutput::Estimate(estimate) if estimate.state.is_some() => {
                first_s.get_or_insert(flight.world.seconds(estimate.t_valid));
            }
            EstimatorOutput::Misfit(misfit) => {
                let t_s = flight.world.seconds(misfit.t);
                found.push((t_s - first_s.unwrap_or(t_s), misfit.cause, misfit.figure));
            }
            _ => {}
        }
    }
    found
}

#[test]
fn another_size_is_found_within_two_seconds_and_nothing_else_is() {
    for (seed, marker, larger) in [(1, 1, 1.05), (2, 0, 1.05), (3, 1, 0.96), (4, 0, 1.08)] {
        let flight = fly("follow", 12.0, seed, |scenario| {
            (scenario.camera.marker_noise_px, scenario.camera.feature_noise_px) = (0.1, 0.1);
        });
        let found = reports(&flight, marker, larger);
        println!("tag {marker} {larger}: {found:?}");
        let (at_s, cause, figure) = *found.first().expect("it is reported");
        let MisfitCause::MarkerSize(pair) = cause else { panic!("{cause:?} is reported first") };
        assert!(at_s < 2.0, "reported after {at_s} s");
        let beside = if pair.marker == marker { larger } else { 1.0 / larger };
        assert!((figure / beside - 1.0).abs() < 0.01, "{figure} of {beside}");
        assert!(found.iter().all(|(_, cause, _)| matches!(cause, MisfitCause::MarkerSize(_))), "{found:?}");
    }
}
