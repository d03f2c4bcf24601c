//! Whether the sigmas of refined flights are those of their errors.

use crate::flown::{Score, fly};

/// Kinds of flights, and the flights of each kind.
const KINDS: [&str; 4] = ["follow", "hover20", "circle20", "stop-and-go"];
const FLIGHTS: u64 = 6;

fn of_kind(name: &str, seconds: f64, seeds: std::ops::RangeInclusive<u64>) -> [Score; 2] {
    let mut both = [Score::default(); 2];
    for seed in seeds {
        let flown = fly(name, seconds, seed, |_| {});
        both[0].add(&Score::of(&flown.filtered(), &flown.world));
        let refined = flown.refined();
        both[1].add(&Score::of(refined.targets.iter().map(|(_, e)| e), &flown.world));
    }
    both
}

/// Three short flights: what a model of motion that is rougher than driving would make of the sigmas is noticed.
#[test]
fn sigmas_are_those_of_errors() {
    let [filter, refined] = of_kind("follow", 12.0, 1..=3);
    for i in [1, 2] {
        let normalised = refined.normalised[i] / refined.frames;
        assert!(
            (0.5..=1.7).contains(&normalised),
            "component {i}: {normalised}\n{refined}\nfilter: {filter}"
        );
        assert!(refined.rms(i) <= 1.3 * refined.bound(i), "component {i}: {refined}");
    }
}

/// 24 flights of 30 s: `cargo test -p windhover-refine --test refine -- --ignored --nocapture proof_`.
#[test]
#[ignore = "minutes"]
fn proof_sigmas_are_those_of_errors() {
    let mut all = [Score::default(); 2];
    for name in KINDS {
        let of_kind = of_kind(name, 30.0, 1..=FLIGHTS);
        for ((what, score), all) in ["filter", "refined"].into_iter().zip(&of_kind).zip(&mut all) {
            println!("{name}, {what}: {score}");
            all.add(score);
        }
    }
    println!("all, filter: {}\nall, refined: {}", all[0], all[1]);
    for i in 0..3 {
        let normalised = all[1].normalised[i] / all[1].frames;
        assert!((0.8..=1.2).contains(&normalised), "component {i}: {normalised}");
    }
    // In 24 flights the error of heading is 24 draws of the compass's bias: its root mean square scatters by a seventh.
    for (i, of_bound, of_filter) in [(0, 1.35, 1.0), (1, 1.1, 0.4), (2, 1.1, 0.4)] {
        let (rms, bound, filter) = (all[1].rms(i), all[1].bound(i), all[0].rms(i));
        println!(
            "component {i}: {:.2} of the bound, {:.2} of the filter's, whose own {:.2} is the bound",
            rms / bound,
            rms / filter,
            bound / filter
        );
        assert!(rms <= of_bound * bound && rms <= of_filter * filter, "component {i}: {rms}, bound {bound}");
    }
}
