//! The state that was learnt in flight and survives a restart of the program.

use serde::{Deserialize, Serialize};

/// Everything from which a restarted pipeline continues: the place of the flight, the receiver's clock relative to the
/// host's, the sensors' slow errors, the intensities of all motions. Plain numbers, to be stored.
///
/// Host times stay comparable over a restart if the computer's clock was not stepped in between. If it was, the clock
/// fit detects that, and the errors count as old.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
pub struct WarmState {
    /// Place and ground of the flight.
    pub site: WarmSite,
    /// The receiver's recent arrivals, oldest first.
    pub arrivals: Vec<WarmArrival>,
    /// The filter's part; `None` before the filter has a state.
    pub filter: Option<WarmFilter>,
}

/// A settled site.
#[derive(Clone, Copy, PartialEq, Debug, Serialize, Deserialize)]
pub struct WarmSite {
    /// Datum: latitude and longitude, degrees, height above the ellipsoid, metres.
    pub datum: [f64; 3],
    /// Height of level ground above the ellipsoid, metres.
    pub ground_height_m: f64,
    /// Geoid over ellipsoid, metres.
    pub geoid_m: f64,
    /// Magnetic declination, radians, east positive.
    pub declination_rad: f64,
}

/// The arrival of one epoch, for the clock fit.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
pub struct WarmArrival {
    /// Host time of its first byte, ns.
    pub t_ns: i64,
    /// That minus the epoch's time of day, ns.
    pub offset_ns: i64,
}

/// States of the filter that belong to the sensors.
pub const WARM_STATES: usize = 9;

/// The sensors' slow errors and the fitted intensities.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
pub struct WarmFilter {
    /// Host time at which it was valid, ns.
    pub t_ns: i64,
    /// GPS bias north, east, down (m); compass heading bias (rad); share of the tilt that the compass reads; its pitch
    /// and roll bias (rad); GPS delay relative to the configured latency (s); drag (1/s).
    pub mean: [f64; WARM_STATES],
    /// Their covariance.
    pub covariance: [[f64; WARM_STATES]; WARM_STATES],
    /// Fitted variances: roll and pitch rate walk, yaw rate walk, side force, thrust, tilt reading,
    /// heading reading.
    pub fitted: [f64; 6],
}

impl WarmFilter {
    /// Whether every value is finite and every variance is positive.
    pub fn is_sound(&self) -> bool {
        let finite = self.mean.iter().chain(self.covariance.iter().flatten()).all(|x| x.is_finite());
        let variances = (0..WARM_STATES).all(|i| self.covariance[i][i] >= 0.0);
        finite && variances && self.fitted.iter().all(|x| x.is_finite() && *x > 0.0)
    }
}
