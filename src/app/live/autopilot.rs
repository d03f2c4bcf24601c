//! The helicopter's autopilot in simulation: what it sends over MAVLink, and what it receives.

use mavlink::dialects::development::*;
use nalgebra::{UnitQuaternion, Vector3};

use crate::io::mavlink::packet::{self, Sender};
use windhover_base::geo::LocalFrame;
use windhover_base::time::{MonoTime, Span};
use windhover_decode::{MavlinkFrame, MavlinkFrames};
use windhover_simulate::{FollowTarget, World};

/// System id of the helicopter's autopilot.
pub(super) const AUTOPILOT_SYSTEM: u8 = 1;
/// Component id.
const COMPONENT: u8 = 1;
/// How long before the flight it was started.
const STARTED_BEFORE: Span = Span::from_ns(100_000_000_000);
/// Standard gravity, m/s².
const GRAVITY: f64 = 9.806_65;

/// An autopilot on board of a simulated flight.
#[derive(Clone, Debug)]
pub struct SimulatedAutopilot {
    /// System id.
    system: u8,
    /// Error of its receiver, north, east, down, metres.
    receiver_m: Vector3<f64>,
    /// From this time of the flight on its clock counts from there again.
    reboots: Option<Span>,
    sequence: u8,
    steps: u64,
}

impl SimulatedAutopilot {
    /// An autopilot of this system whose receiver has this error.
    pub fn new(system: u8, receiver_m: Vector3<f64>) -> Self {
        Self { system, receiver_m, reboots: None, sequence: 0, steps: 0 }
    }

    /// The same, which restarts at this time of the flight, seconds.
    #[must_use]
    pub fn rebooting(self, at_s: Option<f64>) -> Self {
        Self { reboots: at_s.map(Span::from_s), ..self }
    }

    /// The helicopter's position in its estimate, north, east, down of the world's origin, metres; velocity, m/s.
    pub fn position(&self, world: &World, t: MonoTime) -> (Vector3<f64>, Vector3<f64>) {
        let own = world.ownship(t);
        (own.position_ned_m + self.receiver_m, own.velocity_ned_mps)
    }

    /// Time since its start.
    fn boot(&self, world: &World, t: MonoTime) -> Span {
        let flown = t - world.time(0.0);
        match self.reboots {
            Some(reboots) if flown >= reboots => flown - reboots,
            _ => flown + STARTED_BEFORE,
        }
    }

    /// What it sends in a step of [`World::STEP`] that ends at `t`: attitude at 25 Hz, rates and forces at 50 Hz, its
    /// position at 10 Hz, its receiver's fixes at 5 Hz.
    pub fn says(&mut self, world: &World, t: MonoTime, out: &mut Vec<u8>) {
        let step = self.steps;
        self.steps += 1;
        let due = |every_ms: u64| step.is_multiple_of(every_ms / 5);
        let boot = self.boot(world, t);
        let time_boot_ms = (boot.ns() / 1_000_000) as u32;
        let own = world.ownship(t);
        let rates = own.body_rate_radps;
        if due(1_000) {
            self.put(&heartbeat(), out);
        }
        if due(40) {
            let q = UnitQuaternion::from_rotation_matrix(&own.ned_from_body);
            let message = ATTITUDE_QUATERNION_DATA {
                time_boot_ms,
                q1: q.w as f32,
                q2: q.i as f32,
                q3: q.j as f32,
                q4: q.k as f32,
                rollspeed: rates.x as f32,
                pitchspeed: rates.y as f32,
                yawspeed: rates.z as f32,
                ..ATTITUDE_QUATERNION_DATA::DEFAULT
            };
            self.put(&MavMessage::ATTITUDE_QUATERNION(message), out);
        }
        if due(20) {
            let felt = own.acceleration_ned_mps2 - Vector3::z() * GRAVITY;
            let force = (own.ned_from_body.inverse() * felt).map(|x| (x / GRAVITY * 1e3).round() as i16);
            let rate = rates.map(|x| (x * 1e3).round() as i16);
            let message = SCALED_IMU_DATA {
                time_boot_ms,
                xacc: force.x,
                yacc: force.y,
                zacc: force.z,
                xgyro: rate.x,
                ygyro: rate.y,
                zgyro: rate.z,
                ..SCALED_IMU_DATA::DEFAULT
            };
            self.put(&MavMessage::SCALED_IMU(message), out);
        }
        if due(100) {
            self.put(&self.global_position(world, t), out);
        }
        if due(200) {
            self.put(&self.fix(world, t), out);
        }
    }

    fn global_position(&self, world: &World, t: MonoTime) -> MavMessage {
        let (position, velocity) = self.position(world, t);
        let place = world.frame().geodetic(&position);
        let v = velocity.map(|x| (x * 100.0).round() as i16);
        MavMessage::GLOBAL_POSITION_INT(GLOBAL_POSITION_INT_DATA {
            time_boot_ms: (self.boot(world, t).ns() / 1_000_000) as u32,
            lat: (place.lat_deg * 1e7).round() as i32,
            lon: (place.lon_deg * 1e7).round() as i32,
            alt: ((place.height_m - world.scenario().geoid_m) * 1e3).round() as i32,
            vx: v.x,
            vy: v.y,
            vz: v.z,
            ..GLOBAL_POSITION_INT_DATA::DEFAULT
        })
    }

    /// The fix that was valid the configured latency ago: `time_usec` is its arrival.
    fn fix(&self, world: &World, t: MonoTime) -> MavMessage {
        let then = t - Span::from_ms(world.rig().gps.latency_ms);
        let (position, velocity) = self.position(world, then);
        let place = world.frame().geodetic(&position);
        let course = velocity.y.atan2(velocity.x).to_degrees().rem_euclid(360.0);
        MavMessage::GPS_RAW_INT(GPS_RAW_INT_DATA {
            time_usec: (self.boot(world, t).ns() / 1_000) as u64,
            fix_type: GpsFixType::GPS_FIX_TYPE_3D_FIX,
            lat: (place.lat_deg * 1e7).round() as i32,
            lon: (place.lon_deg * 1e7).round() as i32,
            alt: ((place.height_m - world.scenario().geoid_m) * 1e3).round() as i32,
            alt_ellipsoid: (place.height_m * 1e3).round() as i32,
            eph: 90,
            epv: 120,
            vel: (velocity.x.hypot(velocity.y) * 100.0).round() as u16,
            cog: ((course * 100.0).round() as u32 % 36_000) as u16,
            satellites_visible: 14,
            h_acc: 1_500,
            v_acc: 2_500,
            ..GPS_RAW_INT_DATA::DEFAULT
        })
    }

    /// Answers a time synchronisation request.
    pub fn hears(&mut self, world: &World, frame: &MavlinkFrame, t: MonoTime, out: &mut Vec<u8>) {
        if let MavMessage::TIMESYNC(sync) = &frame.message
            && sync.tc1 == 0
        {
            let tc1 = self.boot(world, t).ns();
            self.put(
                &MavMessage::TIMESYNC(TIMESYNC_DATA { tc1, ts1: sync.ts1, ..TIMESYNC_DATA::DEFAULT }),
                out,
            );
        }
    }

    fn put(&mut self, message: &MavMessage, out: &mut Vec<u8>) {
        let sender = Sender { system: self.system, component: COMPONENT };
        out.extend(packet::encode(self.sequence, sender, message, None));
        self.sequence = self.sequence.wrapping_add(1);
    }
}

fn heartbeat() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_HELICOPTER,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
        ..HEARTBEAT_DATA::DEFAULT
    })
}

/// The vehicle's state in a frame of this system, in north, east, down of `frame` whose origin is `origin_msl_m` above
/// mean sea level.
pub fn follow_target(
    bytes: &[u8],
    system: u8,
    frame: &LocalFrame,
    origin_msl_m: f64,
) -> Option<FollowTarget> {
    let mut frames = Vec::new();
    MavlinkFrames::default().push(bytes, &mut frames);
    frames.iter().filter(|sent| sent.system == system).find_map(|sent| {
        let MavMessage::FOLLOW_TARGET(target) = &sent.message else { return None };
        let place = windhover_base::geo::Geodetic {
            lat_deg: f64::from(target.lat) * 1e-7,
            lon_deg: f64::from(target.lon) * 1e-7,
            height_m: frame.datum().height_m,
        };
        let level = frame.ned(place);
        let vector = |v: [f32; 3]| Vector3::from(v).map(f64::from);
        Some(FollowTarget {
            stamp: Span::from_ns(i64::try_from(target.timestamp).ok()?.checked_mul(1_000_000)?),
            position_m: Vector3::new(level.x, level.y, origin_msl_m - f64::from(target.alt)),
            velocity_mps: vector(target.vel),
            acceleration_mps2: vector(target.acc),
        })
    })
}
