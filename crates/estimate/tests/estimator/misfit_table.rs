//! What every deviation of the simulator costs, as a table.

use windhover_base::geo::Ground;
use windhover_base::msg::EstimatorOutput;
use windhover_simulate::{GroundMisfit, Scenario, SpeedPlan};

use super::filter::{Score, fly};
use super::misfit::{configured, misfits, over_flights, scored, sharp};

type Deviation = (&'static str, fn(&mut Scenario));

fn deviations() -> Vec<Deviation> {
    vec![
        ("nominal", |_| {}),
        ("people2", |s| s.misfit.company.people = 2),
        ("people6", |s| s.misfit.company.people = 6),
        ("convoy", |s| s.misfit.company.convoy = 1),
        ("doubles", |s| s.misfit.company.doubles = 1),
        ("size2", |s| s.misfit.markers.size = 0.02),
        ("size5", |s| s.misfit.markers.size = 0.05),
        ("one_size5", |s| s.misfit.markers.one_size = 0.05),
        ("one_off", |s| s.misfit.markers.one_offset_m = [0.05, 0.0]),
        ("one_turn", |s| s.misfit.markers.one_turn_deg = 5.0),
        ("turn", |s| s.misfit.markers.turn_deg = 5.0),
        ("higher20cm", |s| s.misfit.markers.higher_m = 0.2),
        ("ground10", |s| s.misfit.ground = GroundMisfit::Lower(10.0)),
        ("slip8", |s| s.misfit.driving.slip_deg = 8.0),
        ("sway3", |s| {
            s.misfit.driving.sway_deg = 3.0;
            s.misfit.driving.bounce_m = 0.05;
        }),
        ("spin", |s| s.misfit.driving.spin_radps = 1.0),
        ("accel", |s| {
            s.misfit.driving.drive_rate = Some(6.0);
            s.vehicles[0].speed =
                SpeedPlan::StopAndGo { speed_mps: 4.0, go_s: 3.0, stop_s: 3.0, reverse_mps: 0.0 };
        }),
        ("accel.plan", |s| {
            s.vehicles[0].speed =
                SpeedPlan::StopAndGo { speed_mps: 4.0, go_s: 3.0, stop_s: 3.0, reverse_mps: 0.0 };
        }),
        ("antenna1m", |s| s.misfit.antenna_m = [1.0, 0.0, 0.0]),
        ("nodist", |s| s.misfit.distortion = Some([0.0; 5])),
    ]
}

/// What the filter reports of a flight, each thing once, with its first figure.
fn reported_once(out: &[EstimatorOutput]) -> Vec<(String, f64)> {
    let mut once: Vec<(String, f64)> = Vec::new();
    for (cause, figure) in misfits(out) {
        let cause = format!("{cause:?}");
        if once.iter().all(|(known, _)| *known != cause) {
            once.push((cause, figure));
        }
    }
    once
}

/// What deviations cost, and what is reported of them: `cargo test --release -p windhover-estimate --test estimator -- --ignored
/// --nocapture table_of_misfits`.
#[test]
#[ignore = "sixty flights take a minute"]
fn table_of_misfits() {
    let mut twin: Option<Score> = None;
    for (what, change) in deviations() {
        let words = std::cell::RefCell::new(Vec::new());
        let s = over_flights(40..43, |seed| {
            let flight = fly("follow", 25.0, seed, |scenario| {
                sharp(scenario);
                change(scenario);
            });
            let down_m = flight.world.scenario().configured_ground_down_m().unwrap_or(0.0);
            let out = configured(&flight, |_| {}, Ground::Flat { down_m });
            words.replace(reported_once(&out));
            scored(&flight, &out, 6.0)
        });
        let t = twin.get_or_insert(s);
        let (heading, speed, yaw_rate) = (s.heading / t.heading, s.speed / t.speed, s.yaw_rate / t.yaw_rate);
        println!("{what:10} {heading:.2} {speed:.2} {yaw_rate:.2} {s:.4?} reported {:.3?}", words.borrow());
        assert!(s.coverage > 0.95, "{what}: {s:?}");
    }
}
