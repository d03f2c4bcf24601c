//! The truth: the state of everything at any time of the flight.

use nalgebra::Rotation3;

use super::company::{Appearance, Companion};
use super::helicopter::HelicopterMotion;
use super::instant::{OwnshipTruth, VehicleTruth};
use super::random::{Purpose, SmoothNoise, Stream};
use super::scenario::Scenario;
use super::vehicle::VehicleMotion;
use windhover_base::geo::{LocalFrame, ned_from_body_321};
use windhover_base::settings::{Rig, TargetConfig};
use windhover_base::time::{MonoTime, Span, UtcTime};

/// Motion starts this long before the flight, so that every loop has settled, seconds.
const SETTLE_S: f64 = 8.0;
/// And goes on this long after it, seconds.
const AFTER_S: f64 = 1.0;
/// Periods of a camera's vibration, seconds.
const VIBRATION_S: (f64, f64) = (0.02, 0.06);

/// The motion of everything in a scenario. Deterministic in scenario and seed.
///
/// ```
/// use windhover_simulate::{Scenario, World};
///
/// let world = World::new(Scenario::named("follow").expect("a named scenario"), 7);
/// let (before, after) = (world.vehicle(0, world.time(9.9)), world.vehicle(0, world.time(10.1)));
/// // Position and speed are of one motion.
/// let moved = (after.north_m - before.north_m).hypot(after.east_m - before.east_m);
/// assert!((moved / 0.2 - world.vehicle(0, world.time(10.0)).speed_mps.abs()).abs() < 0.05);
/// ```
#[derive(Clone, Debug)]
pub struct World {
    scenario: Scenario,
    rig: Rig,
    seed: u64,
    frame: LocalFrame,
    vehicles: Vec<VehicleMotion>,
    companions: Vec<Companion>,
    helicopter: HelicopterMotion,
    /// Turns of the camera about its axes, radians.
    vibration: Option<[SmoothNoise; 3]>,
}

impl World {
    /// Integrates the motions of a scenario.
    pub fn new(scenario: Scenario, seed: u64) -> Self {
        let span_s = (-SETTLE_S, scenario.duration_s + AFTER_S);
        let rig = scenario.misfit.flown(&scenario.rig);
        let driving = &scenario.misfit.driving;
        let plans = scenario.vehicles.iter().zip(&rig.target).enumerate();
        let vehicles: Vec<_> = plans
            .map(|(index, (plan, target))| VehicleMotion::new(plan, target, driving, index, seed, span_s))
            .collect();
        let companions = Companion::all(&scenario.misfit.company, seed);
        let helicopter = HelicopterMotion::new(&scenario.helicopter, &scenario.wind, &vehicles, seed, span_s);
        let vibration = vibration(scenario.camera.vibration_deg, seed);
        let frame = LocalFrame::new(scenario.origin);
        Self { scenario, rig, seed, frame, vehicles, companions, helicopter, vibration }
    }

    /// The same with a helicopter under external control ([`Self::fly`]): it begins above the first vehicle.
    pub fn flown(scenario: Scenario, seed: u64) -> Self {
        let mut world = Self::new(scenario, seed);
        let plan = &world.scenario.helicopter;
        let below = world.vehicles.first().map(|vehicle| vehicle.at(0.0).origin()).unwrap_or_default();
        let start = nalgebra::Vector3::new(below.x, below.y, -plan.height_m);
        world.helicopter = HelicopterMotion::flown(plan, &world.scenario.wind, start, seed);
        world
    }

    /// Advances a flown helicopter by [`Self::STEP`] with this demanded acceleration (north, east, down, m/s²).
    pub fn fly(&self, wanted_ned_mps2: &nalgebra::Vector3<f64>) {
        self.helicopter.fly(wanted_ned_mps2, self.scenario.helicopter.attitude_rate);
    }

    /// Sets a flown helicopter, a [`Self::STEP`] later, to this position, velocity and acceleration, north, east, down.
    pub fn put(
        &self,
        place_m: &nalgebra::Vector3<f64>,
        mps: &nalgebra::Vector3<f64>,
        mps2: &nalgebra::Vector3<f64>,
    ) {
        self.helicopter.put(place_m, mps, mps2);
    }

    /// A step of a flown helicopter.
    pub const STEP: Span = Span::from_ns(5_000_000);

    /// Its scenario.
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// The true instruments and targets.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// Its seed.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// The NED frame of all positions.
    pub fn frame(&self) -> &LocalFrame {
        &self.frame
    }

    /// Number of vehicles.
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
    /// Where there is no vehicle of this number.
    pub fn vehicle(&self, target: usize, t: MonoTime) -> VehicleTruth {
        self.vehicles[target].at(self.seconds(t))
    }

    /// Number of vehicles and other moving things.
    pub(super) fn movers(&self) -> usize {
        self.vehicles.len() + self.companions.len()
    }

    /// The vehicle, or beyond the vehicles the companion, of this number at host time `t`.
    pub(super) fn mover(&self, index: usize, t: MonoTime) -> VehicleTruth {
        match index.checked_sub(self.vehicles.len()) {
            None => self.vehicle(index, t),
            Some(companion) => self.companions[companion].at(&self.vehicles[0], self.seconds(t)),
        }
    }

    /// The target it is or, of a companion, what it looks like.
    pub(super) fn looks(&self, index: usize) -> (&TargetConfig, Option<Appearance>) {
        match index.checked_sub(self.vehicles.len()) {
            None => (&self.rig.target[index], None),
            Some(companion) => (&self.rig.target[0], Some(self.companions[companion].looks)),
        }
    }

    /// A camera's attitude with what its vibration adds at host time `t`.
    pub(super) fn shaken(&self, t: MonoTime, body_from_camera: Rotation3<f64>) -> Rotation3<f64> {
        let Some(axes) = &self.vibration else { return body_from_camera };
        let [yaw, pitch, roll] = axes.each_ref().map(|axis| axis.at(self.seconds(t)));
        ned_from_body_321(yaw, pitch, roll) * body_from_camera
    }
}

fn vibration(rms_deg: f64, seed: u64) -> Option<[SmoothNoise; 3]> {
    let mut stream = Stream::of(seed, Purpose::Vibration);
    let mut axis = || SmoothNoise::new(rms_deg.to_radians(), VIBRATION_S.0, VIBRATION_S.1, &mut stream);
    (rms_deg != 0.0).then(|| [axis(), axis(), axis()])
}
