//! Magnetic declination from the World Magnetic Model.

use world_magnetic_model::GeomagneticField;
use world_magnetic_model::time::Date;
use world_magnetic_model::uom::si::angle::{degree, radian};
use world_magnetic_model::uom::si::f32::{Angle, Length};
use world_magnetic_model::uom::si::length::meter;

use super::Geodetic;
use crate::time::UtcTime;

/// Why the World Magnetic Model gave no declination.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("no magnetic declination for {date}: {reason}; set compass.declination_deg instead")]
pub struct DeclinationError {
    /// The requested date.
    pub date: UtcTime,
    /// The model's error.
    pub reason: String,
}

/// Declination at a place and time, radians, east positive: `ψ_true = ψ_magnetic + declination`.
///
/// ```
/// use windhover_base::geo::{Geodetic, declination};
/// use windhover_base::time::UtcTime;
///
/// // Central Europe at the end of 2026: some degrees east.
/// let place = Geodetic { lat_deg: 47.0, lon_deg: 8.0, height_m: 400.0 };
/// let angle = declination(place, UtcTime::from_unix_ns(1_795_000_000_000_000_000)).expect("the model covers it");
/// assert!((2.0..5.0).contains(&angle.to_degrees()));
/// // The model has an end.
/// assert!(declination(place, UtcTime::from_unix_ns(4_000_000_000_000_000_000)).is_err());
/// ```
///
/// # Errors
/// Where the model does not cover the place or the date.
pub fn declination(at: Geodetic, date: UtcTime) -> Result<f64, DeclinationError> {
    let refused = |reason: String| DeclinationError { date, reason };
    let civil = date.civil();
    let day = day_of_year(civil.year, civil.month, civil.day);
    let model_date = Date::from_ordinal_date(civil.year, day).map_err(|e| refused(e.to_string()))?;
    let field = GeomagneticField::new(
        Length::new::<meter>(at.height_m as f32),
        Angle::new::<degree>(at.lat_deg as f32),
        Angle::new::<degree>(at.lon_deg as f32),
        model_date,
    )
    .map_err(|e| refused(format!("{e:?}")))?;
    Ok(f64::from(field.declination().get::<radian>()))
}

/// Day of the year, 1 for the first of January.
fn day_of_year(year: i32, month: u8, day: u8) -> u16 {
    let before: u16 = (1..month).map(|m| u16::from(crate::time::days_in_month(year, m))).sum();
    before + u16::from(day)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::Civil;

    #[test]
    fn declination_is_west_in_florida_in_2026() {
        let date = UtcTime::from_civil(Civil {
            year: 2026,
            month: 11,
            day: 18,
            hour: 0,
            minute: 0,
            second: 0,
            nanosecond: 0,
        })
        .expect("a date");
        let at = Geodetic { lat_deg: 30.07, lon_deg: -85.58, height_m: 10.0 };
        let degrees = declination(at, date).expect("inside the model's years").to_degrees();
        assert!((-5.0..-2.5).contains(&degrees), "{degrees}");
    }

    #[test]
    fn a_date_outside_the_model_says_so() {
        let at = Geodetic::default();
        let error = declination(at, UtcTime::from_unix_ns(0)).expect_err("1970 has no model");
        assert!(error.to_string().contains("declination_deg"), "{error}");
    }
}
