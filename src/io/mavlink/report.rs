//! The content of one vehicle's messages in one round, in the units of the filter.

use nalgebra::{UnitQuaternion, Vector3};

use windhover_base::msg::TargetState;
use windhover_base::time::Span;

use super::motion;

/// One vehicle in one round of messages.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct VehicleReport {
    /// Moment of sending, since the autopilot's start where its clock is known, else since the program's.
    pub now: Span,
    /// The state at the moment of sending.
    pub state: TargetState,
    /// Latitude and longitude at that time, degrees: relative to the autopilot's own position where that is known.
    pub place_deg: (f64, f64),
    /// Altitude of the ground under it above mean sea level, metres; likewise.
    pub alt_msl_m: f64,
    /// One-sigma of that position, metres: relative to the helicopter where it derives from the autopilot's own
    /// position.
    pub sigma_m: f64,
    /// Rate of its speed, m/s².
    pub rate_mps2: f64,
    /// Reported point, metres ahead of the rear axle.
    pub reference_m: f64,
    /// Whether it is in sight; otherwise predicted.
    pub seen: bool,
    /// Its number among the targets, from 0.
    pub number: u8,
    /// Its detection from the helicopter; `None` where the helicopter's own state at that time is not known.
    pub sighting: Option<Sighting>,
    /// Edge of its largest marker, metres.
    pub size_m: f64,
    /// Box of its markers in the latest frame, as shares of the picture: left, top, right, bottom.
    pub in_picture: Option<[f32; 4]>,
}

/// A vehicle relative to the helicopter, at the time of a frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Sighting {
    /// Exposure of the frame, on the clock of [`VehicleReport::now`].
    pub at: Span,
    /// From the body frame's origin to the vehicle's reported point, north, east, down, metres.
    pub offset_ned_m: Vector3<f64>,
    /// Attitude of the helicopter.
    pub ned_from_body: UnitQuaternion<f64>,
    /// The vehicle's heading at that time, radians.
    pub heading_rad: f64,
    /// One-sigma of the offset, horizontally and down, metres.
    pub sigma_m: (f64, f64),
}

impl VehicleReport {
    /// Velocity of the reported point, north, east, down, m/s.
    pub fn velocity(&self) -> Vector3<f64> {
        motion::velocity(&self.state, self.reference_m)
    }

    /// Acceleration of the reported point, north, east, down, m/s².
    pub fn acceleration(&self) -> Vector3<f64> {
        motion::acceleration(&self.state, self.rate_mps2, self.reference_m)
    }

    /// One-sigma of heading (rad), speed (m/s), yaw rate (rad/s); zero where not known.
    pub fn sigmas(&self) -> [f64; 3] {
        let p = self.state.covariance;
        [2, 3, 4].map(|i| p.map_or(0.0, |p| p[(i, i)].max(0.0).sqrt()))
    }

    /// Whether every value is finite.
    pub fn is_finite(&self) -> bool {
        let s = &self.state;
        let (lat, lon) = self.place_deg;
        let figures =
            [lat, lon, self.alt_msl_m, s.heading_rad, s.speed_mps, s.yaw_rate_radps, self.rate_mps2];
        figures.iter().all(|figure| figure.is_finite())
    }
}

/// Quaternion (w, x, y, z) as MAVLink orders it.
pub fn wxyz(q: &UnitQuaternion<f64>) -> [f32; 4] {
    [q.w, q.i, q.j, q.k].map(|x| x as f32)
}

/// The attitude of a level body with this heading.
pub fn level(heading_rad: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad)
}
