//! The truth: where everything is at any time of the flight.

use super::helicopter::HelicopterMotion;
use super::instant::{OwnshipTruth, VehicleTruth};
use super::scenario::Scenario;
use super::vehicle::VehicleMotion;
use windhover_base::geo::LocalFrame;
use windhover_base::time::{MonoTime, Span, UtcTime};

/// Motion starts this long before the flight, so that every loop has settled, seconds.
const SETTLE_S: f64 = 8.0;
/// And goes on this long after it, seconds.
const AFTER_S: f64 = 1.0;

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
