//! Motion of the helicopter: thrust along −z of the body, gravity and drag, so that attitude and acceleration agree; a
//! controller that holds or follows; wind.
//!
//! `a = g e_D + f + c_d (w − v)`, `f = −|f| z_body`: the thrust acceleration `f` follows the controller's command as a
//! damped oscillator (the attitude loop), so attitude is consistent with its rate.

use std::sync::{Arc, PoisonError, RwLock};

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::instant::{OwnshipTruth, STEP_S};
use super::ode::{Table, rk4};
use super::random::{Purpose, SmoothNoise, Stream};
use super::scenario::{Helicopter, HelicopterPath, Wind};
use super::vehicle::VehicleMotion;
use windhover_base::geo::{euler_321, ned_from_body_321, wrap_angle};

/// Standard gravity, m/s².
pub(super) const GRAVITY: f64 = 9.806_65;
/// Damping of the attitude loop.
const DAMPING: f64 = 0.8;

// State: position, velocity, thrust acceleration and its rate, each north, east, down.
const STATES: usize = 12;

/// The helicopter's motion over the flight.
#[derive(Clone, Debug)]
pub(super) struct HelicopterMotion {
    trace: Trace,
    air: Air,
    drag_per_s: f64,
    heading: (f64, SmoothNoise),
    /// Rotates the body into the frame whose z axis is the rotor's, where they differ.
    rotor_from_body: Option<Rotation3<f64>>,
}

/// The motion: all of it, or as far as it was flown.
#[derive(Clone, Debug)]
enum Trace {
    Whole(Table<STATES>),
    Flown(Arc<RwLock<Table<STATES>>>),
}

#[derive(Clone, Debug)]
struct Air {
    mean: Vector3<f64>,
    gusts: [SmoothNoise; 3],
}

struct Pilot<'a> {
    plan: &'a Helicopter,
    vehicles: &'a [VehicleMotion],
    air: Air,
    agitation: [SmoothNoise; 3],
    offset: Vector3<f64>,
    phase: f64,
}

impl Air {
    fn new(wind: &Wind, seed: u64) -> Self {
        let mut stream = Stream::of(seed, Purpose::Wind);
        let random = stream.uniform(-180.0, 180.0);
        let toward = wind.toward_deg.unwrap_or(random).to_radians();
        let mean = Vector3::new(toward.cos(), toward.sin(), 0.0) * wind.mean_mps;
        let gust = wind.gust_mps;
        let gusts = [gust, gust, 0.4 * gust].map(|rms| SmoothNoise::new(rms, 1.5, 15.0, &mut stream));
        Self { mean, gusts }
    }

    fn at(&self, t: f64) -> Vector3<f64> {
        self.mean + Vector3::from_fn(|i, _| self.gusts[i].at(t))
    }
}

impl HelicopterMotion {
    pub(super) fn new(
        plan: &Helicopter,
        wind: &Wind,
        vehicles: &[VehicleMotion],
        seed: u64,
        span_s: (f64, f64),
    ) -> Self {
        let mut stream = Stream::of(seed, Purpose::Flight);
        let random_heading = stream.uniform(-180.0, 180.0);
        let heading = plan.heading_deg.unwrap_or(random_heading).to_radians();
        let wander = SmoothNoise::new(plan.heading_wander_deg.to_radians(), 5.0, 30.0, &mut stream);
        let pilot = Pilot {
            plan,
            vehicles,
            air: Air::new(wind, seed),
            agitation: [1.0, 1.0, 0.6]
                .map(|share| SmoothNoise::new(share * plan.agitation_mps2, 1.0, 6.0, &mut stream)),
            offset: Vector3::new(stream.uniform(-0.7, 0.7), stream.uniform(-0.7, 0.7), 0.0),
            phase: stream.uniform(0.0, std::f64::consts::TAU),
        };
        let start = pilot.start_state(span_s.0);
        let table = Table::integrate(|t, y| pilot.derivative(t, y), start, span_s, STEP_S);
        Self {
            trace: Trace::Whole(table),
            air: pilot.air.clone(),
            drag_per_s: plan.drag_per_s,
            heading: (heading, wander),
            rotor_from_body: (plan.trim_deg != 0.0).then(|| trim(plan.trim_deg, seed)),
        }
    }

    /// A helicopter under external control: it hovers in the wind at `start` until [`Self::fly`] advances it.
    pub(super) fn flown(plan: &Helicopter, wind: &Wind, start: Vector3<f64>, seed: u64) -> Self {
        let mut stream = Stream::of(seed, Purpose::Flight);
        let random_heading = stream.uniform(-180.0, 180.0);
        let heading = plan.heading_deg.unwrap_or(random_heading).to_radians();
        let wander = SmoothNoise::new(plan.heading_wander_deg.to_radians(), 5.0, 30.0, &mut stream);
        let air = Air::new(wind, seed);
        let thrust = -Vector3::z() * GRAVITY - air.mean * plan.drag_per_s;
        let y = [start.x, start.y, start.z, 0.0, 0.0, 0.0, thrust.x, thrust.y, thrust.z, 0.0, 0.0, 0.0];
        let table = Table::begin(0.0, STEP_S, y, [0.0; STATES]);
        Self {
            trace: Trace::Flown(Arc::new(RwLock::new(table))),
            air,
            drag_per_s: plan.drag_per_s,
            heading: (heading, wander),
            rotor_from_body: (plan.trim_deg != 0.0).then(|| trim(plan.trim_deg, seed)),
        }
    }

    /// Advances a flown helicopter by a step of the grid with this demanded acceleration, north, east, down, m/s²; the
    /// controller knows the effect of the mean wind. The attitude follows with `attitude_rate`.
    pub(super) fn fly(&self, wanted: &Vector3<f64>, attitude_rate: f64) {
        let Trace::Flown(table) = &self.trace else { return };
        let mut table = table.write().unwrap_or_else(PoisonError::into_inner);
        let (t, y) = table.last();
        let derivative = |t: f64, y: &[f64; STATES]| -> [f64; STATES] {
            let part = |k: usize| Vector3::new(y[k], y[k + 1], y[k + 2]);
            let (v, thrust, rate) = (part(3), part(6), part(9));
            let a = thrust + Vector3::z() * GRAVITY + (self.air.at(t) - v) * self.drag_per_s;
            let command = wanted - Vector3::z() * GRAVITY + (v - self.air.mean) * self.drag_per_s;
            let omega = attitude_rate;
            let jerk = (command - thrust) * (omega * omega) - rate * (2.0 * DAMPING * omega);
            [v.x, v.y, v.z, a.x, a.y, a.z, rate.x, rate.y, rate.z, jerk.x, jerk.y, jerk.z]
        };
        let next = rk4(derivative, t, &y, STEP_S);
        table.push(next, derivative(t + STEP_S, &next));
    }

    /// Sets a flown helicopter, a step later, to this position and velocity, with the upward force that carries its
    /// weight: these come from another simulator.
    pub(super) fn put(&self, place: &Vector3<f64>, velocity: &Vector3<f64>, acceleration: &Vector3<f64>) {
        let Trace::Flown(table) = &self.trace else { return };
        let mut table = table.write().unwrap_or_else(PoisonError::into_inner);
        let f = acceleration - Vector3::z() * GRAVITY;
        let (p, v, a) = (place, velocity, acceleration);
        let y = [p.x, p.y, p.z, v.x, v.y, v.z, f.x, f.y, f.z, 0.0, 0.0, 0.0];
        table.push(y, [v.x, v.y, v.z, a.x, a.y, a.z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }

    pub(super) fn at(&self, t_s: f64) -> OwnshipTruth {
        let y = match &self.trace {
            Trace::Whole(table) => table.at(t_s),
            Trace::Flown(table) => table.read().unwrap_or_else(PoisonError::into_inner).at(t_s),
        };
        let part = |k: usize| Vector3::new(y[k], y[k + 1], y[k + 2]);
        let (position, velocity, thrust, thrust_rate) = (part(0), part(3), part(6), part(9));
        let heading = self.heading.0 + self.heading.1.at(t_s);
        let ned_from_body = self.attitude(&thrust, heading);
        let acceleration = thrust + Vector3::z() * GRAVITY + (self.air.at(t_s) - velocity) * self.drag_per_s;
        // The body's rate by a central difference of the attitude over 2 ms.
        let h = 1e-3;
        let later = self.attitude(&(thrust + thrust_rate * h), heading + self.heading.1.rate(t_s) * h);
        let earlier = self.attitude(&(thrust - thrust_rate * h), heading - self.heading.1.rate(t_s) * h);
        let body_rate_radps = (earlier.inverse() * later).scaled_axis() / (2.0 * h);
        OwnshipTruth {
            position_ned_m: position,
            velocity_ned_mps: velocity,
            acceleration_ned_mps2: acceleration,
            ned_from_body,
            body_rate_radps,
            heading_rad: match self.rotor_from_body {
                Some(_) => euler_321(&ned_from_body).0,
                None => wrap_angle(heading),
            },
        }
    }

    fn attitude(&self, thrust: &Vector3<f64>, heading: f64) -> Rotation3<f64> {
        let ned_from_rotor = attitude(thrust, heading);
        self.rotor_from_body.map_or(ned_from_rotor, |rotor_from_body| ned_from_rotor * rotor_from_body)
    }
}

/// A rotation by `angle_deg` about a random axis perpendicular to the rotor's.
fn trim(angle_deg: f64, seed: u64) -> Rotation3<f64> {
    let (s, c) = Stream::of(seed, Purpose::Trim).uniform(0.0, std::f64::consts::TAU).sin_cos();
    Rotation3::new(Vector3::new(c, s, 0.0) * angle_deg.to_radians())
}

/// The attitude whose −z axis is along the thrust and whose x axis has this azimuth.
fn attitude(thrust: &Vector3<f64>, heading: f64) -> Rotation3<f64> {
    let z_body = -thrust.normalize();
    let (s, c) = heading.sin_cos();
    // z_body in the frame turned by the heading is Ry(pitch) Rx(roll) e_z = (sθ cφ, −sφ, cθ cφ).
    let w = Matrix3::new(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0) * z_body;
    ned_from_body_321(heading, w.x.atan2(w.z), (-w.y).clamp(-1.0, 1.0).asin())
}

/// Position, velocity and acceleration of a swing `reach sin(rate t + phase)` north and another east.
fn swing(axes: [(f64, f64, f64); 2], down: f64, t: f64) -> (Vector3<f64>, Vector3<f64>, Vector3<f64>) {
    let along = |order: i32| {
        let [north, east] = axes.map(|(reach, rate, phase)| {
            let angle = rate * t + phase + f64::from(order) * std::f64::consts::FRAC_PI_2;
            reach * rate.powi(order) * angle.sin()
        });
        Vector3::new(north, east, 0.0)
    };
    (along(0) + Vector3::z() * down, along(1), along(2))
}

impl Pilot<'_> {
    /// Desired position and velocity.
    fn reference(&self, t: f64) -> (Vector3<f64>, Vector3<f64>, Vector3<f64>) {
        let down = -self.plan.height_m;
        let (p, v, a) = match self.plan.path {
            HelicopterPath::Hover { north_m, east_m } => {
                (Vector3::new(north_m, east_m, down), Vector3::zeros(), Vector3::zeros())
            }
            HelicopterPath::Follow { target } => match self.vehicles.get(target) {
                Some(vehicle) => {
                    let at = vehicle.at(t);
                    let (s, c) = at.heading_rad.sin_cos();
                    let v = Vector3::new(c, s, 0.0) * at.speed_mps;
                    (Vector3::new(at.north_m, at.east_m, down), v, Vector3::zeros())
                }
                None => (Vector3::new(0.0, 0.0, down), Vector3::zeros(), Vector3::zeros()),
            },
            HelicopterPath::Circle { radius_m, speed_mps } => {
                let rate = speed_mps / radius_m;
                let (s, c) = (self.phase + rate * t).sin_cos();
                let p = Vector3::new(radius_m * c, radius_m * s, down);
                (p, Vector3::new(-s, c, 0.0) * speed_mps, Vector3::new(-c, -s, 0.0) * (speed_mps * rate))
            }
            HelicopterPath::Weave { reach_m, period_s } => {
                let rate = std::f64::consts::TAU / period_s;
                swing([(reach_m, rate, self.phase), (reach_m, 1.37 * rate, 0.0)], down, t)
            }
            HelicopterPath::Dash { reach_m, speed_mps } => {
                swing([(reach_m, speed_mps / reach_m, self.phase), (0.0, 0.0, 0.0)], down, t)
            }
        };
        (p + self.offset, v, a)
    }

    fn start_state(&self, t: f64) -> [f64; STATES] {
        let (p, v, _) = self.reference(t);
        let thrust = self.command(t, &p, &v);
        [p.x, p.y, p.z, v.x, v.y, v.z, thrust.x, thrust.y, thrust.z, 0.0, 0.0, 0.0]
    }

    /// Demanded thrust acceleration: feedback on position and velocity, with the mean wind's drag known.
    fn command(&self, t: f64, p: &Vector3<f64>, v: &Vector3<f64>) -> Vector3<f64> {
        let (p_ref, v_ref, a_ref) = self.reference(t);
        let restless = Vector3::from_fn(|i, _| self.agitation[i].at(t));
        let mut wanted = a_ref
            + (p_ref - p) * self.plan.position_gain
            + (v_ref - v) * self.plan.velocity_gain
            + restless
            + (v_ref - self.air.mean) * self.plan.drag_per_s;
        let limit = self.plan.limit_mps2;
        let level = wanted.x.hypot(wanted.y);
        if level > 1e-9 {
            let held = limit * (level / limit).tanh() / level;
            wanted.x *= held;
            wanted.y *= held;
        }
        wanted.z = limit * (wanted.z / limit).tanh();
        wanted - Vector3::z() * GRAVITY
    }

    fn derivative(&self, t: f64, y: &[f64; STATES]) -> [f64; STATES] {
        let part = |k: usize| Vector3::new(y[k], y[k + 1], y[k + 2]);
        let (p, v, thrust, rate) = (part(0), part(3), part(6), part(9));
        let a = thrust + Vector3::z() * GRAVITY + (self.air.at(t) - v) * self.plan.drag_per_s;
        let omega = self.plan.attitude_rate;
        let jerk = (self.command(t, &p, &v) - thrust) * (omega * omega) - rate * (2.0 * DAMPING * omega);
        [v.x, v.y, v.z, a.x, a.y, a.z, rate.x, rate.y, rate.z, jerk.x, jerk.y, jerk.z]
    }
}
