//! A camera that vibrates: frames, and the rows of a frame, are displaced each by itself.

use super::filter::{Score, estimates, score};
use super::time::flown;

/// Means over flights of the errors of heading and speed, and of the normalised square of three.
pub(super) fn means(scenario: &str, seeds: std::ops::Range<u64>) -> [f64; 3] {
    let scores: Vec<_> = seeds
        .map(|seed| {
            let (world, out) = flown(scenario, 25.0, seed);
            assert!(score(&estimates(&out), &world, 6.0).coverage >= 0.99, "{scenario}, seed {seed}");
            score(&estimates(&out), &world, 6.0)
        })
        .collect();
    let mean = |of: fn(&Score) -> f64| scores.iter().map(of).sum::<f64>() / scores.len() as f64;
    [mean(|s| s.heading), mean(|s| s.speed), mean(|s| s.nees)]
}

#[test]
fn a_camera_that_vibrates_shows_the_vehicle_nearly_as_well() {
    let still = means("follow", 1..4);
    let shaken = means("follow+vibration=0.1", 1..4);
    println!("{still:?} {shaken:?}");
    assert!(shaken[0] < 1.3 * still[0] && shaken[1] < 1.5 * still[1] && shaken[2] < 4.2, "{shaken:?}");
}

#[test]
fn rows_of_a_camera_that_vibrates_are_displaced_each_by_itself() {
    let still = means("follow", 1..4);
    for scenario in ["follow+readout=15+vibration=0.1", "follow+told-readout=25+vibration=0.1"] {
        let shaken = means(scenario, 1..4);
        println!("{scenario}: {still:?} {shaken:?}");
        // Without states of their own for the rows speed is thirty times as far off.
        assert!(shaken[1] < 8.0 * still[1] && shaken[2] < 6.0, "{scenario}: {still:?} {shaken:?}");
    }
}
