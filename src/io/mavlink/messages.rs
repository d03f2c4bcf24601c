//! The four messages that put a vehicle on a ground station's map and let a helicopter follow it.
//!
//! Fields stand in the order of their sizes, as the wire format wants; source: MAVLink's `common.xml`.

use windhover_base::msg::{TargetState, TrackStatus};
use windhover_base::time::MonoTime;

use super::packet::Kind;

/// HEARTBEAT.
pub const HEARTBEAT: Kind = Kind { id: 0, crc_extra: 50 };
/// ATTITUDE.
pub const ATTITUDE: Kind = Kind { id: 30, crc_extra: 39 };
/// GLOBAL_POSITION_INT.
pub const GLOBAL_POSITION_INT: Kind = Kind { id: 33, crc_extra: 104 };
/// FOLLOW_TARGET.
pub const FOLLOW_TARGET: Kind = Kind { id: 144, crc_extra: 127 };

/// MAV_TYPE_GROUND_ROVER.
const TYPE_GROUND_ROVER: u8 = 10;
/// MAV_AUTOPILOT_GENERIC.
const AUTOPILOT_GENERIC: u8 = 0;
/// MAV_STATE_ACTIVE.
const STATE_ACTIVE: u8 = 4;
/// MAV_STATE_STANDBY.
const STATE_STANDBY: u8 = 3;
/// MAV_STATE_CRITICAL: known, but not seen just now.
const STATE_CRITICAL: u8 = 5;
/// Version field of HEARTBEAT.
const VERSION: u8 = 3;
/// FOLLOW_TARGET tells position (bit 0), velocity (1), attitude and rates (3).
const CAPABILITIES: u8 = 0b1011;

/// A vehicle's state as MAVLink wants it.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct VehicleMessages {
    /// Since the program's start.
    pub time_boot_ms: u64,
    /// Position and motion.
    pub state: TargetState,
    /// Altitude of the ground it stands on above mean sea level, metres.
    pub alt_msl_m: f64,
    /// Reported point, metres ahead of the rear axle.
    pub reference_m: f64,
}

impl VehicleMessages {
    /// Velocity of the reported point, north and east, m/s: (ẋ, ẏ) = (v cosψ − aω sinψ, v sinψ + aω cosψ).
    fn velocity(&self) -> (f64, f64) {
        let (sin, cos) = self.state.heading_rad.sin_cos();
        let across = self.reference_m * self.state.yaw_rate_radps;
        (self.state.speed_mps * cos - across * sin, self.state.speed_mps * sin + across * cos)
    }

    /// Whether every figure is one that can be sent.
    pub fn is_finite(&self) -> bool {
        let s = &self.state;
        [s.lat_deg, s.lon_deg, s.heading_rad, s.speed_mps, s.yaw_rate_radps, self.alt_msl_m]
            .iter()
            .all(|figure| figure.is_finite())
    }

    /// GLOBAL_POSITION_INT.
    pub fn global_position_int(&self) -> Vec<u8> {
        let (north, east) = self.velocity();
        let centi = |mps: f64| (mps * 100.0).round().clamp(-32_768.0, 32_767.0) as i16;
        let heading = self.state.heading_rad.to_degrees().rem_euclid(360.0);
        let mut p = Vec::with_capacity(28);
        p.extend((self.time_boot_ms as u32).to_le_bytes());
        p.extend(degrees_e7(self.state.lat_deg).to_le_bytes());
        p.extend(degrees_e7(self.state.lon_deg).to_le_bytes());
        p.extend(((self.alt_msl_m * 1e3).round() as i32).to_le_bytes());
        p.extend(0_i32.to_le_bytes());
        p.extend(centi(north).to_le_bytes());
        p.extend(centi(east).to_le_bytes());
        p.extend(0_i16.to_le_bytes());
        p.extend((((heading * 100.0).round() as u32 % 36_000) as u16).to_le_bytes());
        p
    }

    /// ATTITUDE: level, as a ground vehicle is taken to be.
    pub fn attitude(&self) -> Vec<u8> {
        let mut p = Vec::with_capacity(28);
        p.extend((self.time_boot_ms as u32).to_le_bytes());
        let yaw = self.state.heading_rad as f32;
        for figure in [0.0, 0.0, yaw, 0.0, 0.0, self.state.yaw_rate_radps as f32] {
            p.extend(f32::to_le_bytes(figure));
        }
        p
    }

    /// FOLLOW_TARGET.
    pub fn follow_target(&self) -> Vec<u8> {
        let (north, east) = self.velocity();
        let (sin, cos) = (self.state.heading_rad / 2.0).sin_cos();
        let horizontal = self.state.covariance.map_or(0.0, |p| (p[(0, 0)].max(p[(1, 1)])).max(0.0).sqrt());
        let mut p = Vec::with_capacity(93);
        p.extend(self.time_boot_ms.to_le_bytes());
        p.extend(0_u64.to_le_bytes());
        p.extend(degrees_e7(self.state.lat_deg).to_le_bytes());
        p.extend(degrees_e7(self.state.lon_deg).to_le_bytes());
        let velocity = [north, east, 0.0];
        let acceleration = [0.0; 3];
        let attitude = [cos, 0.0, 0.0, sin];
        let rates = [0.0, 0.0, self.state.yaw_rate_radps];
        let sigmas = [horizontal, 0.0, 0.0];
        p.extend((self.alt_msl_m as f32).to_le_bytes());
        for figure in velocity.iter().chain(&acceleration).chain(&attitude).chain(&rates).chain(&sigmas) {
            p.extend((*figure as f32).to_le_bytes());
        }
        p.push(CAPABILITIES);
        p
    }
}

/// HEARTBEAT of a vehicle with this track.
pub fn heartbeat(status: TrackStatus) -> Vec<u8> {
    let state = match status {
        TrackStatus::Tracking => STATE_ACTIVE,
        TrackStatus::Coasting => STATE_CRITICAL,
        TrackStatus::Acquiring | TrackStatus::Lost => STATE_STANDBY,
    };
    vec![0, 0, 0, 0, TYPE_GROUND_ROVER, AUTOPILOT_GENERIC, 0, state, VERSION]
}

/// Milliseconds from `start` to `t`.
pub fn since_start_ms(start: MonoTime, t: MonoTime) -> u64 {
    u64::try_from((t - start).ns() / 1_000_000).unwrap_or(0)
}

fn degrees_e7(degrees: f64) -> i32 {
    (degrees * 1e7).round() as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vehicle() -> VehicleMessages {
        VehicleMessages {
            time_boot_ms: 1_500,
            state: TargetState {
                north_m: 1.0,
                east_m: 2.0,
                heading_rad: -std::f64::consts::FRAC_PI_2,
                speed_mps: 2.0,
                yaw_rate_radps: 0.5,
                lat_deg: 30.123_456_7,
                lon_deg: -85.765_432_1,
                height_m: 33.25,
                covariance: None,
                relative_sigma_m: None,
            },
            alt_msl_m: 33.25,
            reference_m: 0.4,
        }
    }

    #[test]
    fn payloads_have_the_lengths_of_the_dialect() {
        let v = vehicle();
        assert_eq!(heartbeat(TrackStatus::Tracking).len(), 9);
        assert_eq!(v.attitude().len(), 28);
        assert_eq!(v.global_position_int().len(), 28);
        assert_eq!(v.follow_target().len(), 93);
    }

    #[test]
    fn position_is_in_the_units_of_the_dialect() {
        let p = vehicle().global_position_int();
        let i32_at = |at: usize| i32::from_le_bytes([p[at], p[at + 1], p[at + 2], p[at + 3]]);
        let i16_at = |at: usize| i16::from_le_bytes([p[at], p[at + 1]]);
        assert_eq!((i32_at(4), i32_at(8), i32_at(12)), (301_234_567, -857_654_321, 33_250));
        // West at 2 m/s; the reported point ahead of the axle swings north as the vehicle turns right.
        assert_eq!((i16_at(20), i16_at(22), i16_at(24)), (20, -200, 0));
        assert_eq!(u16::from_le_bytes([p[26], p[27]]), 27_000);
    }

    fn frame(sequence: u8, kind: Kind, payload: &[u8]) -> String {
        use crate::io::mavlink::packet::{Sender, encode};
        let bytes = encode(sequence, Sender { system: 42, component: 1 }, kind, payload, false);
        bytes.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    #[test]
    fn frames_are_byte_for_byte_what_pymavlink_makes() {
        // pymavlink 2.4.50 with MAVLINK20=1, from the same figures.
        let v = vehicle();
        assert_eq!(
            frame(1, ATTITUDE, &v.attitude()),
            "fd1c0000012a011e0000dc0500000000000000000000db0fc9bf00000000000000000000003fed5f"
        );
        assert_eq!(
            frame(2, GLOBAL_POSITION_INT, &v.global_position_int()),
            "fd1c0000022a01210000dc0500008779f411cf3be1cce281000000000000140038ff000078694608"
        );
        // The northward velocity is cos(-90°) in binary, not quite zero; its bytes are left out here.
        let follow = frame(3, FOLLOW_TARGET, &v.follow_target());
        assert_eq!(
            follow[..20 + 2 * 28],
            "fd5d0000032a01900000dc0500000000000000000000000000008779f411cf3be1cc00000542"[..]
        );
        assert_eq!(follow[20 + 2 * 92..20 + 2 * 93], *"0b");
    }

    #[test]
    fn not_a_number_is_noticed() {
        let mut v = vehicle();
        assert!(v.is_finite());
        v.state.lat_deg = f64::NAN;
        assert!(!v.is_finite());
    }
}
