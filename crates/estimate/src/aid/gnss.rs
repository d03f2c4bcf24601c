//! An epoch of the receiver: what it measures, as position and velocity in NED.

use nalgebra::Vector3;

use windhover_base::geo::Geodetic;
use windhover_base::msg::{Disposition, FixKind, FusionSource, GnssEpoch};

use super::gps_position::GpsPosition;
use super::gps_velocity::GpsVelocity;
use crate::core::Core;
use crate::models::Models;

/// Farthest position from the datum that is plausible, m: the tangent plane is an approximation.
const FARTHEST_M: f64 = 2.0e5;
/// Fastest plausible flight of a helicopter, m/s.
const FASTEST_MPS: f64 = 150.0;

/// Position of an epoch; `None` where it has none, or of no fix.
pub(crate) fn position(epoch: &GnssEpoch, models: &Models) -> Option<GpsPosition> {
    let has_height = epoch.fix != FixKind::TwoD && epoch.alt_msl_m.is_some();
    let height_m = epoch.alt_msl_m.unwrap_or(0.0) + epoch.geoid_m.unwrap_or(0.0);
    let height_m = if has_height { height_m } else { models.frame.datum().height_m };
    let place = epoch.lat_deg.zip(epoch.lon_deg).filter(|_| epoch.fix != FixKind::None);
    let ned = |(lat_deg, lon_deg)| models.frame.ned(Geodetic { lat_deg, lon_deg, height_m });
    place.map(ned).map(|ned_m| GpsPosition { ned_m, has_height })
}

/// Velocity of an epoch, from speed and course where it has no components; `None` likewise.
pub(crate) fn velocity(epoch: &GnssEpoch) -> Option<GpsVelocity> {
    let from_course = || {
        let (speed, course) = (epoch.speed_mps?, epoch.course_deg?.to_radians());
        Some(Vector3::new(speed * course.cos(), speed * course.sin(), 0.0))
    };
    let ned_mps = epoch.vel_ned_mps.or_else(from_course).filter(|_| epoch.fix != FixKind::None);
    let has_down = epoch.vel_ned_mps.is_some() && epoch.vel_has_down;
    ned_mps.map(|ned_mps| GpsVelocity { ned_mps, has_down, sigma_mps: epoch.velocity_sigma_mps })
}

impl GpsPosition {
    /// Whether the value is plausible.
    pub(crate) fn is_credible(&self) -> bool {
        self.ned_m.norm() < FARTHEST_M
    }
}

impl GpsVelocity {
    /// Whether the value is plausible.
    pub(crate) fn is_credible(&self) -> bool {
        self.ned_mps.norm() < FASTEST_MPS
    }
}

/// Fuses one epoch: velocity, then position.
pub(crate) fn fuse(core: &mut Core, epoch: &GnssEpoch) {
    match velocity(epoch) {
        Some(velocity) if velocity.is_credible() => {
            core.watch_tilt(velocity.ned_mps.xy());
            velocity.fuse(core);
        }
        Some(_) => core.refuse(FusionSource::GpsVelocity, Disposition::Invalid),
        None => {}
    }
    match position(epoch, &core.models) {
        Some(position) if position.is_credible() => {
            core.sense_fix(epoch.fix, epoch.position_sigma_m);
            position.fuse(core);
        }
        Some(_) => core.refuse(FusionSource::GpsPosition, Disposition::Invalid),
        None => {}
    }
}
