//! Measurements of an autopilot, on host time: attitude, rates and forces, its receiver's fixes, its own position.
//!
//! ArduPilot's and PX4's messages in the units of `common.xml`. One system is used: that of `system_id`, or the first
//! with an autopilot's HEARTBEAT. Messages of other systems are ignored.

use mavlink::dialects::development::*;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use windhover_base::geo::{Tilt, euler_321};
use windhover_base::msg::{AttitudeSample, AutopilotPosition, FixKind, GnssEpoch, InertialSample};
use windhover_base::time::{MonoTime, RemoteClock, Span, UtcTime};

use super::frames::{MavlinkFrame, MavlinkFrames};
use crate::counts::{DecodeCounts, Refusal};

/// MAV_COMP_ID_AUTOPILOT1.
const AUTOPILOT: u8 = 1;
/// Standard gravity, m/s²: accelerations of SCALED_IMU are in thousandths of it.
const GRAVITY: f64 = 9.806_65;
/// A better message of the same kind was received within this time: the other one is ignored.
const LATELY: Span = Span::from_ns(1_000_000_000);
/// Our time requests are marked in the nanosecond digits below the resolution of clocks.
const MARK_NS: i64 = 618;
/// A larger `time_usec` is UTC, a smaller one is time since start: 2001 in microseconds since 1970.
const UNIX_USEC: u64 = 1_000_000_000_000_000;
/// 2020-01-01: an autopilot that reports an earlier time does not know it.
const EARLIEST_UNIX_USEC: u64 = 1_577_836_800_000_000;

/// A decoded message, and its time of validity.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ReceivedAutopilot {
    /// Time of validity, host time; fixes were valid their receiver's latency earlier.
    pub t: MonoTime,
    /// The content.
    pub measurement: AutopilotMeasurement,
}

/// The content of an autopilot's message.
#[derive(Clone, Copy, PartialEq, Debug)]
#[expect(clippy::large_enum_variant, reason = "a value at a time, passed on")]
pub enum AutopilotMeasurement {
    /// Attitude, its heading true.
    Attitude(AttitudeSample),
    /// Rates and forces in the body's axes.
    Inertial(InertialSample),
    /// A fix of its receiver.
    Gnss(GnssEpoch),
    /// Its own position.
    Position(AutopilotPosition),
}

/// Whether a frame is an autopilot's HEARTBEAT.
pub fn is_autopilot(frame: &MavlinkFrame) -> bool {
    matches!(&frame.message, MavMessage::HEARTBEAT(beat)
        if frame.component == AUTOPILOT
            && !matches!(beat.mavtype, MavType::MAV_TYPE_GCS | MavType::MAV_TYPE_GROUND_ROVER)
            && beat.autopilot != MavAutopilot::MAV_AUTOPILOT_INVALID)
}

/// The time in a time request to an autopilot: `now`, marked as ours.
///
/// ```
/// use windhover_base::time::MonoTime;
/// use windhover_decode::{timesync_asked, timesync_question};
///
/// let now = MonoTime::from_ns(5_000_123_456);
/// let ts1 = timesync_question(now);
/// assert!(timesync_asked(ts1).is_some_and(|t| (t - now).ms().abs() < 0.001));
/// // A request of another system.
/// assert_eq!(timesync_asked(5_000_123_000), None);
/// ```
pub fn question(now: MonoTime) -> i64 {
    now.ns().div_euclid(1_000) * 1_000 + MARK_NS
}

/// When we sent this time request; `None` for one that is not ours.
pub fn asked(ts1: i64) -> Option<MonoTime> {
    (ts1.rem_euclid(1_000) == MARK_NS).then(|| MonoTime::from_ns(ts1))
}

/// MAVLink bytes to an autopilot's measurements.
///
/// ```
/// use mavlink::dialects::development::{ATTITUDE_QUATERNION_DATA, MavMessage};
/// use mavlink::{MavHeader, MavFrame, MavlinkVersion, write_v2_msg};
/// use windhover_base::time::MonoTime;
/// use windhover_decode::{AutopilotDecoder, AutopilotMeasurement};
///
/// // Level, heading north, from the autopilot of system 1.
/// let message = MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA { q1: 1.0, ..Default::default() });
/// let header = MavHeader { system_id: 1, component_id: 1, sequence: 0 };
/// let mut bytes = Vec::new();
/// write_v2_msg(&mut bytes, header, &message).expect("memory can be written");
///
/// let (mut decoder, mut received) = (AutopilotDecoder::new(Some(1)), Vec::new());
/// decoder.push(&bytes, MonoTime::from_ns(1_000_000_000), &mut received);
/// let attitude = received.iter().find_map(|received| match received.measurement {
///     AutopilotMeasurement::Attitude(sample) => Some(sample),
///     _ => None,
/// });
/// assert_eq!(attitude.and_then(|sample| sample.heading), Some(0.0));
/// ```
#[derive(Clone, Debug, Default)]
pub struct AutopilotDecoder {
    frames: MavlinkFrames,
    received: Vec<MavlinkFrame>,
    follows: Option<u8>,
    clock: RemoteClock,
    quaternion: Option<MonoTime>,
    forces: Option<MonoTime>,
    fix_usec: u64,
    /// UTC minus time since start, microseconds.
    utc_less_boot: Option<i64>,
}

impl AutopilotDecoder {
    /// For this system; for the first autopilot that is received where `None`.
    pub fn new(system_id: Option<u8>) -> Self {
        Self { follows: system_id, ..Self::default() }
    }

    /// Takes bytes that were received at `t`.
    pub fn push(&mut self, bytes: &[u8], t: MonoTime, out: &mut Vec<ReceivedAutopilot>) {
        let mut received = std::mem::take(&mut self.received);
        self.frames.push(bytes, &mut received);
        for frame in received.drain(..) {
            let used = self.frame(&frame, t, out);
            let counts = self.frames.counts_mut();
            match used {
                Ok(true) => counts.used += 1,
                Ok(false) => counts.ignored += 1,
                Err(why) => counts.refuse(why),
            }
        }
        self.received = received;
    }

    /// Counts of the decoded bytes.
    pub fn counts(&self) -> &DecodeCounts {
        self.frames.counts()
    }

    /// Its clock.
    pub fn clock(&self) -> &RemoteClock {
        &self.clock
    }

    /// The system that is used.
    pub fn system(&self) -> Option<u8> {
        self.follows
    }

    /// Decodes a frame; returns whether it was used.
    fn frame(
        &mut self,
        frame: &MavlinkFrame,
        t: MonoTime,
        out: &mut Vec<ReceivedAutopilot>,
    ) -> Result<bool, Refusal> {
        if self.follows.is_none() && is_autopilot(frame) {
            self.follows = Some(frame.system);
        }
        if self.follows != Some(frame.system) || frame.component != AUTOPILOT {
            return Ok(false);
        }
        let ms = |time_boot_ms: u32| Span::from_ns(i64::from(time_boot_ms) * 1_000_000);
        match &frame.message {
            MavMessage::HEARTBEAT(_) => Ok(true),
            MavMessage::TIMESYNC(sync) => Ok(self.timesync(sync, t)),
            MavMessage::SYSTEM_TIME(time) => {
                self.at(ms(time.time_boot_ms), t)?;
                let boot_usec = i64::from(time.time_boot_ms) * 1_000;
                let known = time.time_unix_usec >= EARLIEST_UNIX_USEC;
                let unix_usec = i64::try_from(time.time_unix_usec).map_err(|_| Refusal::OutOfRange)?;
                self.utc_less_boot = known.then_some(unix_usec - boot_usec);
                Ok(known)
            }
            MavMessage::ATTITUDE_QUATERNION(q) => {
                let t = self.at(ms(q.time_boot_ms), t)?;
                let [w, x, y, z] = [q.q1, q.q2, q.q3, q.q4].map(f64::from);
                let q4 = Quaternion::new(w, x, y, z);
                let rates = [q.rollspeed, q.pitchspeed, q.yawspeed];
                if !(0.9..1.1).contains(&q4.norm()) {
                    return self.attitude(t, [f64::NAN; 3], rates, out);
                }
                self.quaternion = Some(t);
                let (heading, pitch, roll) =
                    euler_321(&UnitQuaternion::from_quaternion(q4).to_rotation_matrix());
                self.attitude(t, [heading, pitch, roll], rates, out)
            }
            MavMessage::ATTITUDE(a) => {
                let t = self.at(ms(a.time_boot_ms), t)?;
                if self.quaternion.is_some_and(|last| t - last < LATELY) {
                    return Ok(false);
                }
                let angles = [a.yaw, a.pitch, a.roll].map(f64::from);
                self.attitude(t, angles, [a.rollspeed, a.pitchspeed, a.yawspeed], out)
            }
            MavMessage::SCALED_IMU(imu) => {
                let t = self.at(ms(imu.time_boot_ms), t)?;
                let rate = Vector3::new(imu.xgyro, imu.ygyro, imu.zgyro).map(|x| f64::from(x) * 1e-3);
                let force = Vector3::new(imu.xacc, imu.yacc, imu.zacc).map(|x| f64::from(x) * 1e-3 * GRAVITY);
                self.inertial(t, rate, Some(force), out)
            }
            MavMessage::HIGHRES_IMU(imu) if imu.id == 0 => {
                let t = self.at(self.since_boot(imu.time_usec)?, t)?;
                let rate = Vector3::new(imu.xgyro, imu.ygyro, imu.zgyro).map(f64::from);
                let force = Vector3::new(imu.xacc, imu.yacc, imu.zacc).map(f64::from);
                self.inertial(t, rate, Some(force), out)
            }
            MavMessage::GPS_RAW_INT(fix) => self.fix(fix, t, out),
            MavMessage::GLOBAL_POSITION_INT(place) => self.position(place, t, out),
            _ => Ok(false),
        }
    }

    /// Host time of a time since its start that was received at `t`.
    fn at(&mut self, boot: Span, t: MonoTime) -> Result<MonoTime, Refusal> {
        let believed = self.clock.observe(boot, t);
        self.clock.host(boot).filter(|_| believed).ok_or(Refusal::OutOfRange)
    }

    /// Time since its start, from a stamp that may be UTC.
    fn since_boot(&self, time_usec: u64) -> Result<Span, Refusal> {
        let usec = i64::try_from(time_usec).map_err(|_| Refusal::OutOfRange)?;
        let boot_usec = match time_usec < UNIX_USEC {
            true => usec,
            false => usec - self.utc_less_boot.ok_or(Refusal::NoTime)?,
        };
        Ok(Span::from_ns(boot_usec.saturating_mul(1_000)))
    }

    /// An answer to one of our time requests.
    fn timesync(&mut self, sync: &TIMESYNC_DATA, t: MonoTime) -> bool {
        let sent = asked(sync.ts1).filter(|_| sync.tc1 != 0);
        if let Some(sent) = sent {
            self.clock.exchanged(sent, Span::from_ns(sync.tc1), t);
        }
        sent.is_some()
    }

    /// Heading, pitch and roll, and the rates of turn; what is not finite or no angle is left out alone.
    fn attitude(
        &mut self,
        t: MonoTime,
        angles: [f64; 3],
        rates: [f32; 3],
        out: &mut Vec<ReceivedAutopilot>,
    ) -> Result<bool, Refusal> {
        let [heading, pitch, roll] = angles.map(|angle| Some(angle).filter(|angle| angle.abs() < 7.0));
        let tilt = pitch.zip(roll).map(|(pitch, roll)| Tilt { pitch, roll });
        let rates_wanted = self.forces.is_none_or(|last| t - last >= LATELY);
        let rates = Vector3::from(rates).map(f64::from);
        let rates_there = rates_wanted && is_finite(&rates);
        if heading.is_none() && tilt.is_none() && !rates_there {
            return Err(Refusal::OutOfRange);
        }
        self.left_out(heading.is_none(), "heading of the attitude");
        self.left_out(tilt.is_none(), "pitch and roll of the attitude");
        if heading.is_some() || tilt.is_some() {
            let sample = AttitudeSample { heading, heading_is_true: true, tilt };
            out.push(ReceivedAutopilot { t, measurement: AutopilotMeasurement::Attitude(sample) });
        }
        if rates_wanted {
            self.inertial(t, rates, None, out)?;
        }
        Ok(true)
    }

    fn left_out(&mut self, is: bool, name: &'static str) {
        if is {
            self.frames.counts_mut().leave_out(name);
        }
    }

    fn inertial(
        &mut self,
        t: MonoTime,
        rate: Vector3<f64>,
        force: Option<Vector3<f64>>,
        out: &mut Vec<ReceivedAutopilot>,
    ) -> Result<bool, Refusal> {
        let (rate_rps, force_mps2) = (Some(rate).filter(is_finite), force.filter(is_finite));
        self.left_out(rate_rps.is_none(), "rates of turn");
        self.left_out(force.is_some() && force_mps2.is_none(), "specific forces");
        if force_mps2.is_some() {
            self.forces = Some(t);
        }
        let sample = InertialSample { rate_rps, force_mps2 };
        if rate_rps.is_some() || force_mps2.is_some() {
            out.push(ReceivedAutopilot { t, measurement: AutopilotMeasurement::Inertial(sample) });
        }
        Ok(true)
    }

    fn fix(
        &mut self,
        fix: &GPS_RAW_INT_DATA,
        t: MonoTime,
        out: &mut Vec<ReceivedAutopilot>,
    ) -> Result<bool, Refusal> {
        // The same fix again: the message has its own rate.
        if fix.time_usec == self.fix_usec {
            return Ok(false);
        }
        let boot = self.since_boot(fix.time_usec)?;
        let (lat_deg, lon_deg) = (f64::from(fix.lat) * 1e-7, f64::from(fix.lon) * 1e-7);
        let is_place = lat_deg.abs() <= 90.0 && lon_deg.abs() <= 180.0;
        self.left_out(!is_place, "position of the fix");
        self.fix_usec = fix.time_usec;
        // A fix's own clock gives its time, never its arrival here.
        let t = self.clock.host(boot).unwrap_or(t);
        // Without its place it is no fix.
        let kind = if is_place { fix_kind(fix.fix_type) } else { FixKind::None };
        let metres = |mm: u32| (mm > 0 && mm < u32::MAX).then(|| f64::from(mm) * 1e-3);
        let (across, up) = (metres(fix.h_acc), metres(fix.v_acc));
        let (speed, course) = (known(fix.vel).map(|v| v * 1e-2), known(fix.cog).map(|c| c * 1e-2));
        let velocity = speed.zip(course).map(|(v, course_deg)| {
            let (s, c) = course_deg.to_radians().sin_cos();
            Vector3::new(v * c, v * s, 0.0)
        });
        let there = kind.has_position();
        let alt_m = f64::from(fix.alt) * 1e-3;
        let ellipsoid_m = f64::from(fix.alt_ellipsoid) * 1e-3;
        let epoch = GnssEpoch {
            utc: self.utc_less_boot.and_then(|ahead| {
                Some(UtcTime::from_unix_ns((boot.ns() / 1_000).checked_add(ahead)?.checked_mul(1_000)?))
            }),
            fix: kind,
            lat_deg: there.then_some(lat_deg),
            lon_deg: there.then_some(lon_deg),
            alt_msl_m: kind.has_height().then_some(alt_m),
            geoid_m: (kind.has_height() && fix.alt_ellipsoid != 0).then_some(ellipsoid_m - alt_m),
            speed_mps: speed.filter(|_| there),
            course_deg: course.filter(|_| there),
            vel_ned_mps: velocity.filter(|_| there),
            hpe_m: across,
            vpe_m: up,
            position_sigma_m: across
                .zip(up)
                .map(|(across, up)| Vector3::new(across, across, up))
                .filter(|_| there),
            velocity_sigma_mps: metres(fix.vel_acc).map(Vector3::repeat).filter(|_| there),
            sats: (fix.satellites_visible != u8::MAX).then(|| fix.satellites_visible.into()),
            hdop: known(fix.eph).map(|dop| dop * 1e-2),
            ..GnssEpoch::default()
        };
        out.push(ReceivedAutopilot { t, measurement: AutopilotMeasurement::Gnss(epoch) });
        Ok(true)
    }

    fn position(
        &mut self,
        place: &GLOBAL_POSITION_INT_DATA,
        t: MonoTime,
        out: &mut Vec<ReceivedAutopilot>,
    ) -> Result<bool, Refusal> {
        let boot = Span::from_ns(i64::from(place.time_boot_ms) * 1_000_000);
        let t = self.at(boot, t)?;
        let (lat_deg, lon_deg) = (f64::from(place.lat) * 1e-7, f64::from(place.lon) * 1e-7);
        // Before it has a position it reports 0, 0.
        if (place.lat, place.lon) == (0, 0) {
            return Ok(false);
        }
        if lat_deg.abs() > 90.0 || lon_deg.abs() > 180.0 {
            return Err(Refusal::OutOfRange);
        }
        let vel_ned_mps = Vector3::new(place.vx, place.vy, place.vz).map(|v| f64::from(v) * 1e-2);
        let alt_msl_m = f64::from(place.alt) * 1e-3;
        let said = AutopilotPosition { boot, lat_deg, lon_deg, alt_msl_m, vel_ned_mps };
        out.push(ReceivedAutopilot { t, measurement: AutopilotMeasurement::Position(said) });
        Ok(true)
    }
}

fn is_finite(vector: &Vector3<f64>) -> bool {
    vector.iter().all(|axis| axis.is_finite())
}

/// A number that is not the value for "unknown".
fn known(figure: u16) -> Option<f64> {
    (figure != u16::MAX).then(|| f64::from(figure))
}

fn fix_kind(kind: GpsFixType) -> FixKind {
    match kind {
        GpsFixType::GPS_FIX_TYPE_NO_GPS | GpsFixType::GPS_FIX_TYPE_NO_FIX => FixKind::None,
        GpsFixType::GPS_FIX_TYPE_2D_FIX => FixKind::TwoD,
        GpsFixType::GPS_FIX_TYPE_RTK_FLOAT => FixKind::RtkFloat,
        GpsFixType::GPS_FIX_TYPE_RTK_FIXED => FixKind::RtkFixed,
        _ => FixKind::ThreeD,
    }
}
