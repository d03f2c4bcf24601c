//! Tags that are not as configured: found by each other, and nothing else is taken for the cause. They show height, too.

use windhover_base::geo::Ground;
use windhover_base::msg::{EstimatorOutput, MisfitCause};
use windhover_base::settings::Rig;

use super::filter::{Flight, fly};
use super::misfit::{assert_as_good, configured, level, misfits, scored, sharp};

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
        let flight = fly("follow", 12.0, seed, sharp);
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

#[test]
fn tags_place_the_height_where_the_ground_is_configured_elsewhere() {
    let flight = fly("follow", 20.0, 6, sharp);
    let bare = scored(&flight, &flight.outputs(), 6.0);
    for down_m in [-10.0, -16.0, 10.0, -5.0] {
        let out = configured(&flight, |_| {}, Ground::Flat { down_m });
        assert_as_good(&format!("ground {down_m} m down"), &scored(&flight, &out, 6.0), &bare, 1.3);
        let heights = misfits(&out).into_iter().filter(|(cause, _)| *cause == MisfitCause::Height);
        // The receiver's bias is of the difference too.
        let rise = heights.map(|(_, rise_m)| rise_m).next().expect("it is reported");
        assert!((rise + down_m).abs() < 8.0, "{rise} m of {down_m}");
    }
    assert!(misfits(&configured(&flight, |_| {}, level())).is_empty());
}

#[test]
fn tags_that_are_not_as_configured_are_found_out() {
    let flight = fly("follow", 30.0, 7, sharp);
    let bare = scored(&flight, &flight.outputs(), 20.0);
    type Change = fn(&mut Rig);
    type Reported = fn(&MisfitCause, f64) -> bool;
    let changes: [(&str, Change, Reported); 5] = [
        (
            "one tag larger",
            |rig| rig.target[0].marker[1].size_m = Some(0.48 / 1.05),
            |cause, figure| matches!(cause, MisfitCause::MarkerSize(_)) && (figure - 1.05).abs() < 0.005,
        ),
        (
            "one tag 5 cm off",
            |rig| rig.target[0].marker[1].position_m[1] += 0.05,
            |cause, figure| matches!(cause, MisfitCause::MarkerPlace(_)) && (figure - 0.05).abs() < 0.01,
        ),
        (
            "one tag turned",
            |rig| rig.target[0].marker[1].yaw_deg += 5.0,
            |cause, figure| {
                matches!(cause, MisfitCause::MarkerTurn(_)) && (figure.to_degrees() + 5.0).abs() < 0.3
            },
        ),
        (
            "both tags larger",
            |rig| rig.target[0].marker.iter_mut().for_each(|m| m.size_m = Some(0.48 / 1.05)),
            |cause, _| matches!(cause, MisfitCause::MarkerPlace(_) | MisfitCause::MarkerSize(_)),
        ),
        (
            "both tags turned",
            |rig| rig.target[0].marker.iter_mut().for_each(|m| m.yaw_deg += 5.0),
            |cause, _| matches!(cause, MisfitCause::MarkerPlace(_)),
        ),
    ];
    for (what, change, expected) in changes {
        let out = configured(&flight, change, level());
        let score = scored(&flight, &out, 20.0);
        println!("{what}: {score:?} twin {bare:?} reported {:?}", misfits(&out).first());
        assert!(score.coverage >= 0.99 && score.nees < 6.0, "{what}: {score:?}, twin {bare:?}");
        assert!(score.speed <= 2.0 * bare.speed, "{what}: {score:?}, twin {bare:?}");
        let last = misfits(&out).into_iter().rev().take(3).collect::<Vec<_>>();
        assert!(last.iter().any(|(cause, figure)| expected(cause, *figure)), "{what}: {last:?}");
    }
}
