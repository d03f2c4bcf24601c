//! The truth at an instant, of the helicopter and of a vehicle.

use nalgebra::{Rotation3, Vector2, Vector3};

use windhover_base::geo::ned_from_body_321;

/// Grid of the integrated motions, seconds.
pub(super) const STEP_S: f64 = 0.005;

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
///
/// ```
/// use windhover_simulate::{Scenario, World};
/// use nalgebra::Vector3;
///
/// let world = World::new(Scenario::named("hover10").expect("a named scenario"), 7);
/// let vehicle = world.vehicle(0, world.time(1.0));
/// // Its reference point, a metre ahead of the rear axle.
/// let ahead = vehicle.reference(1.0);
/// let origin = vehicle.ned_of(&Vector3::zeros());
/// assert!(((ahead - origin.xy()).norm() - 1.0).abs() < 1e-9);
/// ```
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
    /// Pitch of its body on its springs, radians, nose up positive.
    pub pitch_rad: f64,
    /// Roll likewise, right side down positive.
    pub roll_rad: f64,
    /// How much higher than at rest its body is, metres.
    pub lift_m: f64,
}

impl VehicleTruth {
    /// Whether its body deviates from its pose at rest.
    pub fn sways(&self) -> bool {
        self.pitch_rad != 0.0 || self.roll_rad != 0.0 || self.lift_m != 0.0
    }

    /// Where the origin of its body is, north, east, down, metres.
    pub fn origin(&self) -> Vector3<f64> {
        Vector3::new(self.north_m, self.east_m, -self.lift_m)
    }

    /// Attitude of its body.
    pub fn ned_from_vehicle(&self) -> Rotation3<f64> {
        ned_from_body_321(self.heading_rad, self.pitch_rad, self.roll_rad)
    }

    /// A point of the vehicle's body (forward, right, down, metres) in NED.
    pub fn ned_of(&self, point: &Vector3<f64>) -> Vector3<f64> {
        if self.sways() { self.origin() + self.ned_from_vehicle() * point } else { self.level_ned_of(point) }
    }

    fn level_ned_of(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let (s, c) = self.heading_rad.sin_cos();
        Vector3::new(
            self.north_m + c * point.x - s * point.y,
            self.east_m + s * point.x + c * point.y,
            point.z,
        )
    }

    /// North and east of the point `ahead_m` metres ahead of the rear axle.
    pub fn reference(&self, ahead_m: f64) -> Vector2<f64> {
        self.level_ned_of(&Vector3::new(ahead_m, 0.0, 0.0)).xy()
    }
}
