//! Measurements from logs of other programs, as MAVLink frames of an autopilot: all of them enter the pipeline in one
//! way, that of `[autopilot]`.

use std::collections::BTreeSet;

use mavlink::dialects::development::*;
use nalgebra::{UnitQuaternion, Vector3};

use crate::io::mavlink::packet::{Sender, encode};
use windhover_base::time::{MonoTime, NS_PER_S, Span};

/// A fix of a receiver. Values that are not given are `None`.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Fix {
    /// As MAVLink's `GPS_FIX_TYPE` counts: 1 none, 2 two-dimensional, 3 three-dimensional, 5 RTK float, 6 RTK fixed.
    pub kind: u8,
    /// Latitude.
    pub lat_deg: f64,
    /// Longitude.
    pub lon_deg: f64,
    /// Above the sea; above the ellipsoid where only that is given.
    pub alt_m: f64,
    /// Above the ellipsoid.
    pub ellipsoid_m: Option<f64>,
    /// Over ground.
    pub speed_mps: Option<f64>,
    /// Over ground, clockwise from north.
    pub course_deg: Option<f64>,
    /// One sigma of the horizontal position.
    pub hpe_m: Option<f64>,
    /// One sigma of the height.
    pub vpe_m: Option<f64>,
    /// Horizontal dilution of precision.
    pub hdop: Option<f64>,
    /// Satellites used.
    pub sats: Option<u8>,
}

impl Fix {
    /// A fix of this kind at this place, without further values.
    pub fn at(kind: u8, lat_deg: f64, lon_deg: f64, alt_m: f64) -> Self {
        let (ellipsoid_m, speed_mps, course_deg) = (None, None, None);
        let (hpe_m, vpe_m, hdop, sats) = (None, None, None, None);
        Self { kind, lat_deg, lon_deg, alt_m, ellipsoid_m, speed_mps, course_deg, hpe_m, vpe_m, hdop, sats }
    }

    fn can_be(&self) -> bool {
        self.lat_deg.abs() <= 90.0 && self.lon_deg.abs() <= 180.0 && self.alt_m.abs() < 1e6
    }
}

/// A measurement.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Measured {
    /// A fix.
    Fix(Fix),
    /// `ned_from_body`, heading true.
    Attitude(UnitQuaternion<f64>),
    /// Rates, rad/s, and specific forces, m/s², in body axes (forward, right, down).
    Inertial(Vector3<f64>, Vector3<f64>),
}

/// The content of a log.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct ImportedLog {
    /// MAVLink bytes with their times, in order.
    pub packets: Vec<(MonoTime, Vec<u8>)>,
    /// The origin of the bytes, as text; empty where the log has the original bytes.
    pub made_of: String,
    /// Number of fixes, attitudes and inertial samples; zero where the log has the original bytes.
    pub counts: [usize; 3],
    /// The start of its video, where it is the log of one.
    pub video_start: Option<MonoTime>,
    /// What was left out, as text.
    pub warnings: Vec<String>,
}

/// Measurements before their conversion to frames.
#[derive(Clone, PartialEq, Debug, Default)]
pub(super) struct MeasuredLog {
    pub measured: Vec<(MonoTime, Measured)>,
    /// Whether the times are UTC.
    pub is_utc: bool,
    /// Names of what was used.
    pub used: BTreeSet<String>,
    pub warnings: Vec<String>,
}

impl MeasuredLog {
    pub(super) fn push(&mut self, t: MonoTime, what: Measured, of: &str) {
        if matches!(&what, Measured::Fix(fix) if !fix.can_be()) {
            return;
        }
        if !self.used.contains(of) {
            self.used.insert(of.to_owned());
        }
        self.measured.push((t, what));
    }

    /// Converts them to frames of an autopilot that started with the first measurement.
    pub(super) fn into_packets(mut self, format: &str) -> ImportedLog {
        self.measured.sort_by_key(|(t, _)| *t);
        let mut builder = FrameBuilder::default();
        let mut packets = Vec::with_capacity(self.measured.len() + 16);
        let mut counts = [0; 3];
        let began = self.measured.first().map_or(MonoTime::default(), |(t, _)| *t);
        let mut beat = began;
        for (t, what) in self.measured {
            if t >= beat {
                packets.push((t, builder.beat(t, t - began, self.is_utc)));
                beat = t + Span::from_ns(NS_PER_S);
            }
            counts[match what {
                Measured::Fix(_) => 0,
                Measured::Attitude(_) => 1,
                Measured::Inertial(..) => 2,
            }] += 1;
            packets.push((t, builder.frame(&message(&what, t - began))));
        }
        let used: Vec<&str> = self.used.iter().map(String::as_str).collect();
        let made_of = format!("{format}: {}", used.join(", "));
        ImportedLog { packets, made_of, counts, video_start: None, warnings: self.warnings }
    }
}

/// Makes numbered frames.
#[derive(Default)]
struct FrameBuilder {
    sequence: u8,
}

impl FrameBuilder {
    fn frame(&mut self, message: &MavMessage) -> Vec<u8> {
        const AUTOPILOT: Sender = Sender { system: 1, component: 1 };
        self.sequence = self.sequence.wrapping_add(1);
        encode(self.sequence, AUTOPILOT, message, None)
    }

    /// The messages that every autopilot sends once a second, with the date where it is known.
    fn beat(&mut self, t: MonoTime, boot: Span, is_utc: bool) -> Vec<u8> {
        let mut bytes = self.frame(&MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: 0,
            mavtype: MavType::MAV_TYPE_HELICOPTER,
            autopilot: MavAutopilot::MAV_AUTOPILOT_GENERIC,
            base_mode: MavModeFlag::empty(),
            system_status: MavState::MAV_STATE_ACTIVE,
            mavlink_version: 3,
        }));
        if is_utc
            && let Ok(time_unix_usec) = u64::try_from((t - Span::from_ns(boot.ns() % 1_000_000)).ns() / 1_000)
        {
            let time = SYSTEM_TIME_DATA { time_unix_usec, time_boot_ms: boot_ms(boot) };
            bytes.extend(self.frame(&MavMessage::SYSTEM_TIME(time)));
        }
        bytes
    }
}

fn boot_ms(boot: Span) -> u32 {
    u32::try_from(boot.ns() / 1_000_000).unwrap_or(u32::MAX)
}

fn message(what: &Measured, boot: Span) -> MavMessage {
    let time_usec = u64::try_from(boot.ns() / 1_000).unwrap_or(0);
    match what {
        Measured::Fix(fix) => MavMessage::GPS_RAW_INT(fix_message(fix, time_usec)),
        Measured::Attitude(q) => MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA {
            time_boot_ms: boot_ms(boot),
            q1: q.w as f32,
            q2: q.i as f32,
            q3: q.j as f32,
            q4: q.k as f32,
            // Rates come from the inertial samples, or not at all.
            rollspeed: f32::NAN,
            pitchspeed: f32::NAN,
            yawspeed: f32::NAN,
            ..ATTITUDE_QUATERNION_DATA::DEFAULT
        }),
        Measured::Inertial(rate, force) => MavMessage::HIGHRES_IMU(HIGHRES_IMU_DATA {
            time_usec,
            xacc: force.x as f32,
            yacc: force.y as f32,
            zacc: force.z as f32,
            xgyro: rate.x as f32,
            ygyro: rate.y as f32,
            zgyro: rate.z as f32,
            ..HIGHRES_IMU_DATA::DEFAULT
        }),
    }
}

fn fix_message(fix: &Fix, time_usec: u64) -> GPS_RAW_INT_DATA {
    // Hundredths where known; MAVLink's value for unknown is the largest number.
    let hundredths = |figure: Option<f64>| match figure.map(|x| (x * 1e2).round()) {
        Some(x) if (0.0..f64::from(u16::MAX)).contains(&x) => x as u16,
        _ => u16::MAX,
    };
    let millimetres = |figure: Option<f64>| match figure.map(|x| (x * 1e3).round()) {
        Some(x) if (1.0..f64::from(u32::MAX)).contains(&x) => x as u32,
        _ => 0,
    };
    GPS_RAW_INT_DATA {
        // Two fixes of one instant would be taken for one: zero is avoided.
        time_usec: time_usec.max(1),
        fix_type: match fix.kind {
            2 => GpsFixType::GPS_FIX_TYPE_2D_FIX,
            3 => GpsFixType::GPS_FIX_TYPE_3D_FIX,
            4 => GpsFixType::GPS_FIX_TYPE_DGPS,
            5 => GpsFixType::GPS_FIX_TYPE_RTK_FLOAT,
            6 => GpsFixType::GPS_FIX_TYPE_RTK_FIXED,
            _ => GpsFixType::GPS_FIX_TYPE_NO_FIX,
        },
        lat: (fix.lat_deg * 1e7).round() as i32,
        lon: (fix.lon_deg * 1e7).round() as i32,
        alt: (fix.alt_m * 1e3).round() as i32,
        alt_ellipsoid: (fix.ellipsoid_m.unwrap_or(0.0) * 1e3).round() as i32,
        eph: hundredths(fix.hdop),
        epv: u16::MAX,
        vel: hundredths(fix.speed_mps),
        cog: hundredths(fix.course_deg.map(|course| course.rem_euclid(360.0))),
        h_acc: millimetres(fix.hpe_m),
        v_acc: millimetres(fix.vpe_m),
        satellites_visible: fix.sats.unwrap_or(u8::MAX),
        ..GPS_RAW_INT_DATA::DEFAULT
    }
}
