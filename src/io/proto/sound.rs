//! Plausibility of messages: values from a file or a peer are checked before use.

use super::windhover::{Datum, Ownship, TargetState};

fn is_on_earth(lat_deg: f64, lon_deg: f64) -> bool {
    lat_deg.abs() <= 90.0 && lon_deg.abs() <= 180.0
}

fn are_finite(figures: &[f64]) -> bool {
    figures.iter().all(|figure| figure.is_finite())
}

impl TargetState {
    /// Whether a known state is a place on the Earth and a motion, with a valid covariance or none.
    pub fn is_sound(&self) -> bool {
        let motion = [self.north_m, self.east_m, self.heading_rad, self.speed_mps, self.yaw_rate_radps];
        let figures = is_on_earth(self.lat_deg, self.lon_deg) && are_finite(&motion);
        !self.known || (figures && are_finite(&self.covariance))
    }
}

impl Ownship {
    /// Whether it is a place on the Earth, a velocity and an attitude.
    pub fn is_sound(&self) -> bool {
        let height = [self.height_m, self.north_m, self.east_m, self.down_m];
        let motion = [self.vn_mps, self.ve_mps, self.vd_mps, self.qw, self.qx, self.qy, self.qz];
        is_on_earth(self.lat_deg, self.lon_deg) && are_finite(&height) && are_finite(&motion)
    }
}

impl Datum {
    /// Whether it is a place on the Earth.
    pub fn is_sound(&self) -> bool {
        is_on_earth(self.lat_deg, self.lon_deg) && self.height_m.is_finite()
    }
}
