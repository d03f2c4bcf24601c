//! How a ground vehicle moves: a driver, a drive and a steering gear with lag, on level ground.

use super::instant::{STEP_S, VehicleTruth};
use super::misfit::Driving;
use super::ode::Table;
use super::random::{Purpose, SmoothNoise, Stream};
use super::rough::Rough;
use super::scenario::{Route, SpeedPlan, VehiclePlan};
use windhover_base::geo::wrap_angle;
use windhover_base::settings::{TargetConfig, TargetModel};

/// Natural frequency with which speed follows its command, rad/s: a step of 2.5 m/s then peaks at
/// 1.4 m/s².
const DRIVE_RATE: f64 = 1.5;
/// Time constant of the steering gear, seconds.
const STEERING_S: f64 = 0.25;
/// Largest steering angle, radians.
const STEERING_LIMIT: f64 = 0.61;
/// Largest yaw rate of a vehicle that turns on the spot, rad/s.
const TURN_LIMIT: f64 = 1.5;
/// A vehicle that turns on the spot does so every so often, after having driven so long, seconds.
const SPIN_S: (f64, f64) = (10.0, 5.0);
/// How far ahead on its route a driver looks, seconds of travel, and at least this many metres.
const LOOK_AHEAD: (f64, f64) = (0.8, 1.0);
/// How quickly a driver finds the route's nearest point again, 1/s.
const ABREAST_PER_S: f64 = 2.0;

// State: north, east, heading, speed, acceleration, steering (angle, or yaw rate of a unicycle), θ on the route.
const STATES: usize = 7;

/// A vehicle's motion over the flight.
#[derive(Clone, Debug)]
pub(super) struct VehicleMotion {
    model: TargetModel,
    wheelbase_m: f64,
    table: Option<Table<STATES>>,
    parked: (f64, f64, f64),
    rough: Rough,
}

struct Driver {
    plan: VehiclePlan,
    model: TargetModel,
    wheelbase_m: f64,
    speed: SmoothNoise,
    wheel: SmoothNoise,
    driving: Driving,
    rough: Rough,
}

impl VehicleMotion {
    pub(super) fn new(
        plan: &VehiclePlan,
        target: &TargetConfig,
        driving: &Driving,
        index: usize,
        seed: u64,
        span_s: (f64, f64),
    ) -> Self {
        let mut stream = Stream::new(seed, Purpose::Vehicle as u64 + index as u64);
        let rough = Rough::new(driving, index, seed);
        let random_heading = stream.uniform(-180.0, 180.0);
        let (north_m, east_m, heading_deg) = plan.start;
        let heading = heading_deg.unwrap_or(random_heading).to_radians();
        let wheelbase_m = target.wheelbase_m.unwrap_or(1.0);
        let stands = matches!(plan.speed, SpeedPlan::Parked) || target.model == TargetModel::Static;
        if stands {
            let parked = (north_m, east_m, wrap_angle(heading));
            return Self { model: target.model, wheelbase_m, table: None, parked, rough };
        }
        let curvature = match plan.route {
            Route::Free { curvature_per_m } => curvature_per_m,
            _ => 0.0,
        };
        let wander_mps = match plan.speed {
            SpeedPlan::Cruise { wander_mps, .. } => wander_mps,
            _ => 0.0,
        };
        let driver = Driver {
            plan: *plan,
            model: target.model,
            wheelbase_m,
            speed: SmoothNoise::new(wander_mps, 4.0, 20.0, &mut stream),
            wheel: SmoothNoise::new(curvature, 4.0, 18.0, &mut stream),
            driving: *driving,
            rough: rough.clone(),
        };
        let theta = stream.uniform(0.0, std::f64::consts::TAU);
        let start = driver.start_state((north_m, east_m, heading), theta, span_s.0);
        let table = Table::integrate(|t, y| driver.derivative(t, y), start, span_s, STEP_S);
        Self { model: target.model, wheelbase_m, table: Some(table), parked: (0.0, 0.0, 0.0), rough }
    }

    pub(super) fn at(&self, t_s: f64) -> VehicleTruth {
        let Some(table) = &self.table else {
            let (north_m, east_m, heading_rad) = self.parked;
            let vehicle = VehicleTruth { north_m, east_m, heading_rad, ..VehicleTruth::default() };
            return self.rough.swayed(t_s, vehicle);
        };
        let [north_m, east_m, heading, speed_mps, _, steering, _] = table.at(t_s);
        let yaw_rate_radps = yaw_rate(self.model, self.wheelbase_m, speed_mps, steering);
        let vehicle = VehicleTruth {
            north_m,
            east_m,
            heading_rad: wrap_angle(heading),
            speed_mps,
            yaw_rate_radps,
            ..VehicleTruth::default()
        };
        self.rough.swayed(t_s, vehicle)
    }
}

fn yaw_rate(model: TargetModel, wheelbase_m: f64, speed: f64, steering: f64) -> f64 {
    match model {
        TargetModel::Ackermann => speed * steering.tan() / wheelbase_m,
        TargetModel::Unicycle => steering,
        TargetModel::Static => 0.0,
    }
}

/// `x` held smoothly within ±`limit`.
fn soft_limit(x: f64, limit: f64) -> f64 {
    limit * (x / limit).tanh()
}

impl Driver {
    fn start_state(&self, (north, east, heading): (f64, f64, f64), theta: f64, t: f64) -> [f64; STATES] {
        let speed = self.wanted_speed(t);
        match self.plan.route {
            Route::Free { .. } => [north, east, heading, speed, 0.0, 0.0, theta],
            _ => {
                let (p, d) = self.route(theta);
                [p.0, p.1, d.1.atan2(d.0), speed, 0.0, 0.0, theta]
            }
        }
    }

    /// The route's point and its derivative at parameter θ.
    fn route(&self, theta: f64) -> ((f64, f64), (f64, f64)) {
        let (s, c) = theta.sin_cos();
        match self.plan.route {
            Route::Free { .. } => ((0.0, 0.0), (1.0, 0.0)),
            Route::Circle { north_m, east_m, radius_m } => {
                let r = radius_m.abs();
                ((north_m + r * c, east_m + radius_m * s), (-r * s, radius_m * c))
            }
            Route::Eight { a_m, b_m } => {
                ((a_m * s, b_m * (2.0 * theta).sin()), (a_m * c, 2.0 * b_m * (2.0 * theta).cos()))
            }
        }
    }

    /// Whether it stands and turns on the spot, or stops to do so.
    fn spins(&self, t: f64) -> bool {
        self.driving.spin_radps != 0.0 && t.rem_euclid(SPIN_S.0) >= SPIN_S.1
    }

    fn wanted_speed(&self, t: f64) -> f64 {
        match self.plan.speed {
            SpeedPlan::Parked => 0.0,
            _ if self.spins(t) => 0.0,
            SpeedPlan::FromRest { rest_s, speed_mps } => speed_mps * f64::from(u8::from(t >= rest_s)),
            SpeedPlan::Cruise { mean_mps, .. } => mean_mps + self.speed.at(t),
            SpeedPlan::StopAndGo { speed_mps, go_s, stop_s, reverse_mps } => {
                let legs = if reverse_mps > 0.0 { 2.0 } else { 1.0 };
                let at = t.rem_euclid(legs * (go_s + stop_s));
                match at {
                    _ if at < stop_s => 0.0,
                    _ if at < stop_s + go_s => speed_mps,
                    _ if at < 2.0 * stop_s + go_s => 0.0,
                    _ => -reverse_mps,
                }
            }
        }
    }

    /// Curvature the driver asks for, 1/m, and how far the nose is from where it should point.
    fn wanted_curvature(&self, t: f64, y: &[f64; STATES]) -> (f64, f64) {
        let [north, east, heading, speed, _, _, theta] = *y;
        if let Route::Free { .. } = self.plan.route {
            return (self.wheel.at(t), 0.0);
        }
        let ahead_m = (LOOK_AHEAD.0 * speed.abs()).max(LOOK_AHEAD.1);
        let (_, d) = self.route(theta);
        let (aim, _) = self.route(theta + ahead_m / d.0.hypot(d.1));
        let (dn, de) = (aim.0 - north, aim.1 - east);
        let bearing = wrap_angle(de.atan2(dn) - heading);
        // Pure pursuit: the arc through the aim point has curvature 2 sin(bearing)/distance.
        (2.0 * bearing.sin() / dn.hypot(de).max(0.3), bearing)
    }

    fn derivative(&self, t: f64, y: &[f64; STATES]) -> [f64; STATES] {
        let [_, _, heading, speed, acceleration, steering, _] = *y;
        let (curvature, bearing) = self.wanted_curvature(t, y);
        let mut wanted_mps = self.wanted_speed(t);
        let wanted_steering = match self.model {
            TargetModel::Ackermann => soft_limit((self.wheelbase_m * curvature).atan(), STEERING_LIMIT),
            _ if self.spins(t) => self.driving.spin_radps,
            _ => {
                // A vehicle that turns on the spot turns first and drives then.
                wanted_mps *= bearing.cos().max(0.0).powi(2);
                soft_limit(curvature * speed.abs().max(0.3), TURN_LIMIT)
            }
        };
        let rate = self.driving.drive_rate.unwrap_or(DRIVE_RATE);
        let jerk = rate * (rate * (wanted_mps - speed) - 2.0 * acceleration);
        let (north, east) = self.rough.course(t, heading, speed);
        [
            north,
            east,
            yaw_rate(self.model, self.wheelbase_m, speed, steering),
            acceleration,
            jerk,
            (wanted_steering - steering) / STEERING_S,
            self.progress(y),
        ]
    }

    /// θ': the route's parameter stays abreast of the vehicle.
    fn progress(&self, y: &[f64; STATES]) -> f64 {
        let [north, east, heading, speed, _, _, theta] = *y;
        if let Route::Free { .. } = self.plan.route {
            return 0.0;
        }
        let (p, d) = self.route(theta);
        let length = d.0.hypot(d.1).max(0.1);
        let along_m = ((north - p.0) * d.0 + (east - p.1) * d.1) / length;
        let along_mps = speed * (heading.cos() * d.0 + heading.sin() * d.1) / length;
        (along_mps + ABREAST_PER_S * along_m) / length
    }
}
