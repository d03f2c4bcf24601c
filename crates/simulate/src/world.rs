//! The truth: where everything is at any time of the flight.

use nalgebra::{Rotation3, Vector2, Vector3};

use super::helicopter::HelicopterMotion;
use super::scenario::Scenario;
use super::vehicle::VehicleMotion;
use windhover_base::geo::LocalFrame;
use windhover_base::time::{MonoTime, Span, UtcTime};

/// Grid of the integrated motions, seconds.
pub(super) const STEP_S: f64 = 0.005;
/// Motion starts this long before the flight, so that every loop has settled, seconds.
const SETTLE_S: f64 = 8.0;
/// And goes on this long after it, seconds.
const AFTER_S: f64 = 1.0;

/// The helicopter at an instant: its body frame's origin.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct OwnshipTruth {
    /// North, east, down of the scenario's origin, metres.
    pub position_ned_m: Vector3<f64>,
    /// Velocity, m/s.
    pub velocity_ned_mps: Vector3<f64>,
    /// Acceleration, m/s².
    pub acceleration_ned_mps2: Vector3<f64>,
    /// Attitude.
    pub ned_from_body: Rotation3<f64>,
    /// Angular rate in the body frame, rad/s.
    pub body_rate_radps: Vector3<f64>,
    /// Azimuth of the nose, radians.
    pub heading_rad: f64,
}

/// A vehicle at an instant: the ground under the middle of its rear axle.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct VehicleTruth {
    /// Metres north of the origin.
    pub north_m: f64,
    /// Metres east of the origin.
    pub east_m: f64,
    /// True heading, radians in (−π, π].
    pub heading_rad: f64,
    /// Signed speed, m/s.
    pub speed_mps: f64,
    /// Yaw rate, rad/s, clockwise from above positive.
    pub yaw_rate_radps: f64,
}

impl VehicleTruth {
    /// A point of the vehicle frame (forward, right, down, metres) in NED.
    pub fn ned_of(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let (s, c) = self.heading_rad.sin_cos();
        Vector3::new(
            self.north_m + c * point.x - s * point.y,
            self.east_m + s * point.x + c * point.y,
            point.z,
        )
    }

    /// North and east of the point `ahead_m` metres ahead of the rear axle.
    pub fn reference(&self, ahead_m: f64) -> Vector2<f64> {
        self.ned_of(&Vector3::new(ahead_m, 0.0, 0.0)).xy()
    }
}

/// The motion of everything in a scenario. Deterministic in scenario and seed.
#[derive(Clone, Debug)]
pub struct World {
    scenario: Scenario,
    seed: u64,
    frame: LocalFrame,
    vehicles: Vec<VehicleMotion>,
    helicopter: HelicopterMotion,
}

impl World {
    /// Integrates the motions of a scenario.
    pub fn new(scenario: Scenario, seed: u64) -> Self {
        let span_s = (-SETTLE_S, scenario.duration_s + AFTER_S);
        let plans = scenario.vehicles.iter().zip(&scenario.rig.target).enumerate();
        let vehicles: Vec<_> = plans
            .map(|(index, (plan, target))| VehicleMotion::new(plan, target, index, seed, span_s))
            .collect();
        let helicopter = HelicopterMotion::new(&scenario.helicopter, &scenario.wind, &vehicles, seed, span_s);
        Self { frame: LocalFrame::new(scenario.origin), scenario, seed, vehicles, helicopter }
    }

    /// What it was made of.
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// The seed it was made with.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// The NED frame all positions are in.
    pub fn frame(&self) -> &LocalFrame {
        &self.frame
    }

    /// How many vehicles there are.
    pub fn vehicles(&self) -> usize {
        self.vehicles.len()
    }

    /// Host time `t_s` seconds into the flight.
    pub fn time(&self, t_s: f64) -> MonoTime {
        self.scenario.start + Span::from_s(t_s)
    }

    /// Seconds into the flight at host time `t`.
    pub fn seconds(&self, t: MonoTime) -> f64 {
        (t - self.scenario.start).s()
    }

    /// UTC, nanoseconds since 1970, `t_s` seconds into the flight by the host's clock.
    pub fn utc(&self, t_s: f64) -> UtcTime {
        let clock = &self.scenario.clock;
        let elapsed_s = t_s / (1.0 + clock.drift_ppm * 1e-6);
        UtcTime::from_unix_ns(
            self.scenario.start.ns() - Span::from_ms(clock.offset_ms).ns() + Span::from_s(elapsed_s).ns(),
        )
    }

    /// Seconds into the flight by the host's clock at a UTC.
    pub fn seconds_at_utc(&self, utc: UtcTime) -> f64 {
        let clock = &self.scenario.clock;
        let at_start = self.scenario.start.ns() - Span::from_ms(clock.offset_ms).ns();
        Span::from_ns(utc.unix_ns() - at_start).s() * (1.0 + clock.drift_ppm * 1e-6)
    }

    /// The helicopter at host time `t`.
    pub fn ownship(&self, t: MonoTime) -> OwnshipTruth {
        self.helicopter.at(self.seconds(t))
    }

    /// Vehicle `target` at host time `t`.
    ///
    /// # Panics
    /// Where there is no such vehicle.
    pub fn vehicle(&self, target: usize, t: MonoTime) -> VehicleTruth {
        self.vehicles[target].at(self.seconds(t))
    }
}
