//! The declination of a recorded flight: from its configuration, or from the World Magnetic Model at its first fix with
//! a date.

use super::flight::Flight;
use windhover_base::geo::{DeclinationError, Geodetic, declination};
use windhover_base::settings::CompassConfig;
use windhover_base::time::UtcTime;

/// Radians, east positive; zero where the configuration gives neither a value nor a model.
pub fn of_flight(compass: &CompassConfig, flight: &Flight) -> Result<f64, DeclinationError> {
    if let Some(degrees) = compass.declination_deg {
        return Ok(degrees.to_radians());
    }
    if compass.declination.is_none() {
        return Ok(0.0);
    }
    let dated = flight.epochs.iter().find_map(|e| Some((e.utc_ns?, e.lat_deg?, e.lon_deg?, e.alt_msl_m?)));
    let Some((utc_ns, lat_deg, lon_deg, height_m)) = dated else {
        let date = UtcTime::from_unix_ns(0);
        return Err(DeclinationError { date, reason: "the flight has no fix with a date".into() });
    };
    declination(Geodetic { lat_deg, lon_deg, height_m }, UtcTime::from_unix_ns(utc_ns))
}
