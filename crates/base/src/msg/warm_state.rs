//! What was learnt in flight and outlives a restart of the program.

use serde::{Deserialize, Serialize};

/// Everything a restarted pipeline continues from: where the flight is, the receiver's clock against
/// the host's, the sensors' slow errors, how restless everything is. Plain numbers, to be stored.
///
/// Host times stay comparable over a restart as far as the computer's clock was not stepped between;
/// where it was, the clock fit finds out by itself and the errors count as old.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
pub struct WarmState {
    /// Where and over what ground.
    pub site: WarmSite,
    /// The receiver's recent arrivals, oldest first.
    pub arrivals: Vec<WarmArrival>,
    /// The filter's part; `None` while the filter knew nothing.
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

/// One arrival of an epoch, as the clock fit takes it.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
pub struct WarmArrival {
    /// Host time of its first byte, ns.
    pub t_ns: i64,
    /// That less the epoch's time of day, ns.
    pub offset_ns: i64,
}

/// States of the filter that belong to the sensors.
pub const WARM_STATES: usize = 9;

/// The sensors' slow errors and the fitted intensities.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
pub struct WarmFilter {
    /// Host time at which it held, ns.
    pub t_ns: i64,
    /// GPS bias north, east, down (m); compass heading bias (rad); share of the tilt the compass
    /// reads; its pitch and roll bias (rad); GPS delay against the configured latency (s); drag (1/s).
    pub mean: [f64; WARM_STATES],
    /// Their covariance.
    pub covariance: [[f64; WARM_STATES]; WARM_STATES],
    /// Fitted variances: roll and pitch rate walk, yaw rate walk, side force, thrust, tilt reading,
    /// heading reading.
    pub fitted: [f64; 6],
}

impl WarmFilter {
    /// Whether every figure is a number and every variance is one.
    pub fn is_sound(&self) -> bool {
        let finite = self.mean.iter().chain(self.covariance.iter().flatten()).all(|x| x.is_finite());
        let variances = (0..WARM_STATES).all(|i| self.covariance[i][i] >= 0.0);
        finite && variances && self.fitted.iter().all(|x| x.is_finite() && *x > 0.0)
    }
}
