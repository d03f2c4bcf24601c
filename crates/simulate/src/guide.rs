//! An invisible guide that leads the helicopter.

use windhover_base::settings::TargetModel;

use crate::{HelicopterPath, Route, Scenario, SpeedPlan, VehiclePlan};

impl Scenario {
    /// Adds a guide of this mean speed to a scenario of one vehicle; the helicopter follows it instead.
    /// It is the second target of the rig, with a marker like the first one's under the number 8.
    pub fn follow_guide(&mut self, mean_mps: f64, route: Route) {
        let mut guide = self.rig.target[0].clone();
        guide.name = "guide".into();
        guide.model = TargetModel::Unicycle;
        guide.marker[0].id = Some(8);
        self.rig.target.push(guide);
        self.vehicles.push(VehiclePlan {
            start: (0.0, 0.0, None),
            speed: SpeedPlan::Cruise { mean_mps, wander_mps: 0.3 },
            route,
        });
        self.helicopter.path = HelicopterPath::Follow { target: 1 };
    }
}
