//! Refinement of simulated flights against their truth.

mod bad_input;
mod consistency;
mod flown;
mod misfits;

use flown::{Score, fly};

/// From 6 s on, in a flight of 14 s with eight ground features.
#[test]
fn a_flight_is_known_better_afterwards() {
    let flown = fly("follow", 14.0, 3, |_| {});
    let filter = Score::of(&flown.filtered(), &flown.world);
    let refined = flown.refined();
    let score = Score::of(refined.targets.iter().map(|(_, e)| e), &flown.world);
    assert_eq!(score.frames, filter.frames);
    for (i, most) in [(0, 1.0), (1, 0.4), (2, 0.4)] {
        let ratio = score.rms(i) / filter.rms(i);
        assert!(ratio < most, "component {i}: {ratio} of the filter's error");
    }
    assert!(score.nees / score.frames < 6.0, "NEES {}", score.nees / score.frames);
    for constant in refined.constants.iter().filter(|c| c.prior_sigma > 0.0) {
        assert!(constant.sigma <= 1.001 * constant.prior_sigma, "{constant:?}");
    }
    // Nothing is wrong with this flight.
    let outliers: usize = refined.tallies.iter().map(|tally| tally.outliers).sum();
    assert!(outliers < 15, "{outliers} outliers");
    assert_eq!(refined.features.1, 0);
}

/// Gross errors are listed, and have no effect.
#[test]
fn outliers_are_named_and_do_not_pull() {
    let flown = fly("follow", 12.0, 4, |scenario| scenario.camera.marker_outlier = 0.05);
    let refined = flown.refined();
    let score = Score::of(refined.targets.iter().map(|(_, e)| e), &flown.world);
    let filter = Score::of(&flown.filtered(), &flown.world);
    assert!(score.rms(1) < 0.5 * filter.rms(1), "{} of {}", score.rms(1), filter.rms(1));
    let named =
        refined.outliers.iter().filter(|outlier| outlier.marker.is_some() && outlier.ratio > 10.0).count();
    assert!((5..60).contains(&named), "{named} markers are named");
}

/// Mount and compass are determined where they differ from the configuration.
#[test]
fn a_crooked_mount_is_found() {
    let flown = fly("follow", 20.0, 5, |scenario| scenario.camera.mount_error_deg = [0.0, 1.5, 0.0]);
    let refined = flown.refined();
    let pitch = refined
        .constants
        .iter()
        .find(|constant| constant.kind == windhover_refine::ConstantKind::Mount(1))
        .expect("it is estimated");
    assert!(pitch.is_determined(), "{pitch:?}");
    let error = (pitch.value - 1.5f64.to_radians()) / pitch.sigma;
    assert!(error.abs() < 3.0, "{pitch:?}");
}

/// Twelve flights of three kinds, `cargo test -p windhover-refine --test refine -- --ignored --nocapture proof_`: the table of
/// docs/refine.md.
#[test]
#[ignore = "minutes"]
fn proof_of_errors_and_sigmas() {
    for (name, features) in [("follow", 8), ("hover20", 8), ("circle20", 8), ("follow", 0)] {
        let (mut filter, mut refined) = (Score::default(), Score::default());
        for seed in 1..=4 {
            let flown = fly(name, 30.0, seed, |scenario| scenario.camera.features = features);
            filter.add(&Score::of(&flown.filtered(), &flown.world));
            let result = flown.refined();
            refined.add(&Score::of(result.targets.iter().map(|(_, e)| e), &flown.world));
        }
        for (what, s) in [("filter", &filter), ("refined", &refined)] {
            println!("{name}, {features} features, {what}: {s}");
        }
        assert!(refined.rms(1) < 0.4 * filter.rms(1) && refined.rms(2) < 0.4 * filter.rms(2), "{name}");
        assert!((1.2..=4.5).contains(&(refined.nees / refined.frames)), "{name}");
    }
}
