//! Arguments: markers whose positions are known.

use std::str::FromStr;

use windhover_base::geo::Geodetic;

/// Surveyed markers.
#[derive(clap::Args, Debug)]
pub(super) struct SurveyedArgs {
    /// A marker whose position is known: ID:LAT,LON,HEIGHT (degrees, metres above the ellipsoid)
    #[arg(long, value_name = "ID:LAT,LON,HEIGHT")]
    surveyed: Vec<Surveyed>,
    /// One-sigma of surveyed positions, metres
    #[arg(long, value_name = "METRES", default_value_t = 0.02)]
    survey_sigma_m: f64,
}

impl SurveyedArgs {
    /// Number of each tag, its position and one sigma in metres.
    pub(super) fn tags(&self) -> Vec<(u32, Geodetic, f64)> {
        self.surveyed.iter().map(|s| (s.id, s.at, self.survey_sigma_m)).collect()
    }
}

/// A surveyed marker.
#[derive(Clone, Copy, Debug)]
struct Surveyed {
    id: u32,
    at: Geodetic,
}

impl FromStr for Surveyed {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let (id, place) = text.split_once(':').ok_or("write it as ID:LAT,LON,HEIGHT")?;
        let id = id.parse().map_err(|_| format!("{id:?} is not the number of a tag"))?;
        let figures: Vec<f64> = place
            .split(',')
            .map(|f| f.trim().parse().map_err(|_| format!("{f:?} is not a number")))
            .collect::<Result<_, _>>()?;
        match figures[..] {
            [lat_deg, lon_deg, height_m] => Ok(Self { id, at: Geodetic { lat_deg, lon_deg, height_m } }),
            _ => Err("write it as ID:LAT,LON,HEIGHT".into()),
        }
    }
}
