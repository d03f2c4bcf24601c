//! Own motion over wind, trim, paths, kinds of tilt sensors, and what the camera shows: normalised squares of tilt, heading and
//! velocity, one where the covariance is that of the errors.

use windhover_base::msg::EstimatorOutput;
use windhover_simulate::Scenario;

use super::filter::{Flight, Input, fly};

/// What the camera shows.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Shown {
    Tag,
    FeaturesOnly,
    Nothing,
}

const PATHS: [&str; 3] = ["hover10", "static-survey+weave=15", "static-survey+dash=30"];
const KINDS: [(&str, &str); 3] =
    [("attitude", ""), ("15 % of it", "+tilt-share=15"), ("force", "+feels-force=1")];
/// Wind with gusts of a quarter of it (m/s), and trim (degrees).
const WINDS: [f64; 3] = [0.0, 4.0, 8.0];
const TRIMS: [f64; 3] = [0.0, 3.0, 6.0];
const SEEDS: u64 = 4;
const SECONDS: f64 = 30.0;
/// Nothing is scored before, s.
const FROM_S: f64 = 6.0;

fn flight(described: &str, shown: Shown, seed: u64) -> Flight {
    let mut flight = fly("hover10", SECONDS, seed, |scenario| {
        *scenario = Scenario { duration_s: SECONDS, ..Scenario::described(described).expect("known names") };
        if shown == Shown::Nothing {
            scenario.camera.features = 0;
        }
    });
    for input in &mut flight.inputs {
        match input {
            Input::Frame(frame) if shown != Shown::Tag => frame.value.markers.clear(),
            _ => {}
        }
    }
    flight
}

/// Means of the normalised squares of tilt, heading and horizontal velocity, each a component.
fn squares(flight: &Flight) -> [f64; 3] {
    let (mut sums, mut n) = ([0.0; 3], 0.0);
    for output in flight.outputs() {
        let EstimatorOutput::Ownship(own) = output else { continue };
        if flight.world.seconds(own.t_valid) < FROM_S {
            continue;
        }
        let truth = flight.world.ownship(own.t_valid);
        let turned = (truth.ned_from_body * own.ned_from_body.inverse()).scaled_axis();
        let sigma = own.attitude_sigma_rad();
        let velocity = truth.velocity_ned_mps - own.velocity_ned_mps;
        let of_velocity = own.velocity_sigma_mps();
        let square = |error: f64, sigma: f64| (error / sigma).powi(2);
        sums[0] += 0.5 * (square(turned.x, sigma.x) + square(turned.y, sigma.y));
        sums[1] += square(turned.z, sigma.z);
        sums[2] += 0.5 * (square(velocity.x, of_velocity.x) + square(velocity.y, of_velocity.y));
        n += 1.0;
    }
    sums.map(|sum| sum / n)
}

/// The means over winds and trims lie within wide limits; they are printed with the least and the most.
#[test]
#[ignore = "a thousand flights take ten minutes"]
fn proof_of_own_motion_over_wind_trim_and_kinds() {
    println!(
        "| shown | path | the tilt sensor feels | tilt | heading | velocity |\n|---|---|---|---|---|---|"
    );
    for shown in [Shown::Tag, Shown::FeaturesOnly, Shown::Nothing] {
        for path in PATHS {
            for (kind, deviation) in KINDS {
                let cells = WINDS.into_iter().flat_map(|wind| TRIMS.map(|trim| (wind, trim)));
                let cells: Vec<[f64; 3]> = cells
                    .map(|(wind, trim)| {
                        let described =
                            format!("{path}{deviation}+wind={wind}+gusts={}+trim={trim}", wind / 4.0);
                        let all = (1..=SEEDS).map(|seed| squares(&flight(&described, shown, seed)));
                        all.fold([0.0; 3], |sum, one| std::array::from_fn(|i| sum[i] + one[i] / SEEDS as f64))
                    })
                    .collect();
                let mut row = format!("| {shown:?} | {path} | {kind}");
                for i in 0..3 {
                    let of = || cells.iter().map(|cell| cell[i]);
                    let mean = of().sum::<f64>() / cells.len() as f64;
                    let (least, most) = (of().fold(f64::MAX, f64::min), of().fold(0.0, f64::max));
                    row += &format!(" | {mean:.2} ({least:.2}–{most:.2})");
                    assert!(mean < 7.0, "{row}");
                }
                println!("{row} |");
            }
        }
    }
}
