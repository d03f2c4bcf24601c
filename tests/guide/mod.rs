//! A guide that nobody sees, which leads the helicopter around an eight.

use windhover_base::settings::TargetModel;
use windhover_simulate::{HelicopterPath, Route, Scenario, SpeedPlan, VehiclePlan};

/// Adds a guide of this mean speed to a scenario of one vehicle; the helicopter follows it.
pub fn lead(scenario: &mut Scenario, mean_mps: f64, eight: Route) {
    let mut guide = scenario.rig.target[0].clone();
    guide.name = "guide".into();
    guide.model = TargetModel::Unicycle;
    guide.marker[0].id = Some(8);
    scenario.rig.target.push(guide);
    scenario.vehicles.push(VehiclePlan {
        start: (0.0, 0.0, None),
        speed: SpeedPlan::Cruise { mean_mps, wander_mps: 0.3 },
        route: eight,
    });
    scenario.helicopter.path = HelicopterPath::Follow { target: 1 };
}
