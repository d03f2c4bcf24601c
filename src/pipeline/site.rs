//! Where the flight is: the NED origin, the ground, the declination, settled by the first fixes.

use std::sync::Arc;

use super::settings::PipelineSettings;
use windhover_base::geo::{self, Geodetic, Ground, LocalFrame, Terrain, Tile};
use windhover_base::msg::{GnssEpoch, WarmSite};
use windhover_base::settings::{Datum, Declination, GroundConfig, GroundSource};
use windhover_estimate::Site;

/// Fixes whose median height is the ground where the ground is where the aircraft took off.
const TAKEOFF_FIXES: usize = 5;
/// Fixes to wait for a date before the World Magnetic Model is given up.
const DATE_PATIENCE: usize = 50;

/// Collects first fixes until the site is settled.
pub(super) struct SiteFinder {
    first: Option<Geodetic>,
    heights_m: Vec<f64>,
    seen: usize,
    ground: GroundConfig,
    datum: Option<Datum>,
    declination_deg: Option<f64>,
    declination: Option<Declination>,
    terrain: Option<Arc<Tile>>,
    warm: Option<WarmSite>,
}

/// A settled site, and what an operator should know of its declination.
pub(super) struct SettledSite {
    pub(super) site: Site,
    /// The same as plain numbers, for a warm start.
    pub(super) warm: WarmSite,
    /// Whether it is an earlier run's.
    pub(super) continued: bool,
    pub(super) declination_notice: Option<String>,
    pub(super) ground_notice: Option<String>,
}

impl SiteFinder {
    pub(super) fn new(settings: &PipelineSettings, terrain: Option<Arc<Tile>>) -> Self {
        let compass = &settings.rig.compass;
        Self {
            first: None,
            heights_m: Vec::with_capacity(TAKEOFF_FIXES),
            seen: 0,
            ground: settings.ground.clone(),
            datum: settings.datum,
            declination_deg: compass.declination_deg,
            declination: compass.declination,
            terrain,
            warm: None,
        }
    }

    /// Settles on an earlier run's site at the first fix.
    pub(super) fn resume(&mut self, warm: WarmSite) {
        self.warm = Some(warm);
    }

    /// Takes a fix; the site when it is settled.
    pub(super) fn offer(&mut self, epoch: &GnssEpoch) -> Option<SettledSite> {
        let at = position(epoch)?;
        let first = *self.first.get_or_insert(at);
        if let Some(warm) = self.warm.take().filter(|warm| self.agrees(warm, &at)) {
            return Some(SettledSite { continued: true, ..self.settled(warm, None) });
        }
        self.seen += 1;
        let geoid_m = epoch.geoid_m.unwrap_or(0.0);
        let elevation_msl_m = self
            .tile_at(first)
            .map(|t| t.height_msl_m(first.lat_deg, first.lon_deg))
            .or(self.ground.elevation_msl_m);
        let ground_height_m = match (elevation_msl_m, self.ground.source) {
            (Some(elevation_msl_m), _) => elevation_msl_m + geoid_m,
            (None, Some(GroundSource::Takeoff)) => {
                self.heights_m.push(at.height_m);
                if self.heights_m.len() < TAKEOFF_FIXES {
                    return None;
                }
                median(&mut self.heights_m)
            }
            (None, None) => first.height_m,
        };
        let (declination_rad, declination_notice) = self.declination(epoch, at)?;
        let datum = self
            .datum
            .map_or([first.lat_deg, first.lon_deg, ground_height_m], |d| [d.lat_deg, d.lon_deg, d.height_m]);
        let warm = WarmSite { datum, ground_height_m, geoid_m, declination_rad };
        Some(self.settled(warm, declination_notice))
    }

    fn tile_at(&self, at: Geodetic) -> Option<Arc<Tile>> {
        self.terrain.clone().filter(|tile| tile.covers(at.lat_deg, at.lon_deg))
    }

    fn settled(&self, warm: WarmSite, declination_notice: Option<String>) -> SettledSite {
        let [lat_deg, lon_deg, height_m] = warm.datum;
        let datum = Geodetic { lat_deg, lon_deg, height_m };
        let frame = LocalFrame::new(datum);
        let first = self.first.unwrap_or(datum);
        let tile = self.tile_at(first);
        let ground_notice = (tile.is_none() && self.ground.terrain.is_some()).then(|| {
            "no terrain tile covers the first fix (it could not be read, or is of another place): level ground at that fix's height instead".to_owned()
        });
        let ground = match tile {
            Some(tile) => Ground::Terrain(Arc::new(Terrain::new(tile, &frame, warm.geoid_m))),
            // Far from the datum its tangent plane stands above the curve of the Earth.
            None => {
                Ground::Flat { down_m: frame.ned(Geodetic { height_m: warm.ground_height_m, ..first }).z }
            }
        };
        let site = Site { frame, ground, declination_rad: warm.declination_rad };
        SettledSite { site, warm, continued: false, declination_notice, ground_notice }
    }

    /// Declination in radians and what to say of it; `None` while waiting for a date.
    fn declination(&self, epoch: &GnssEpoch, at: Geodetic) -> Option<(f64, Option<String>)> {
        if let Some(figure) = self.declination_deg {
            return Some((figure.to_radians(), None));
        }
        let Some(Declination::Wmm) = self.declination else {
            return Some((0.0, None));
        };
        let Some(utc) = epoch.utc else {
            let waited = self.seen >= DATE_PATIENCE;
            let words = "the receiver tells no date, so no declination from the World Magnetic Model: \
                         headings are magnetic; set compass.declination_deg";
            return waited.then(|| (0.0, Some(words.to_owned())));
        };
        Some(match geo::declination(at, utc) {
            Ok(angle) => {
                let words =
                    format!("declination {:.2} deg from the World Magnetic Model", angle.to_degrees());
                (angle, Some(words))
            }
            Err(error) => (0.0, Some(error.to_string())),
        })
    }

    /// Whether an earlier run's site is here and is what the configuration asks for.
    fn agrees(&self, warm: &WarmSite, at: &Geodetic) -> bool {
        let [lat_deg, lon_deg, height_m] = warm.datum;
        let near = (lat_deg - at.lat_deg).abs() < SAME_FLIGHT_DEG
            && (lon_deg - at.lon_deg).abs() < SAME_FLIGHT_DEG / at.lat_deg.to_radians().cos().max(0.01);
        // Stored numbers may have lost their last digit.
        let equal = |a: f64, b: f64| (a - b).abs() <= 1e-9 * a.abs().max(1.0);
        let as_configured =
            self.datum.is_none_or(|d| {
                equal(d.lat_deg, lat_deg) && equal(d.lon_deg, lon_deg) && equal(d.height_m, height_m)
            }) && self.ground.elevation_msl_m.is_none_or(|e| equal(e + warm.geoid_m, warm.ground_height_m))
                && self.declination_deg.is_none_or(|d| equal(d.to_radians(), warm.declination_rad));
        near && as_configured && height_m.is_finite() && warm.ground_height_m.is_finite()
    }
}

/// Farthest from an earlier run's datum that a flight is still the same one, degrees (some 10 km).
const SAME_FLIGHT_DEG: f64 = 0.1;

/// A three-dimensional position above the ellipsoid.
fn position(epoch: &GnssEpoch) -> Option<Geodetic> {
    if !epoch.fix.has_height() {
        return None;
    }
    let height_m = epoch.alt_msl_m? + epoch.geoid_m.unwrap_or(0.0);
    Some(Geodetic { lat_deg: epoch.lat_deg?, lon_deg: epoch.lon_deg?, height_m })
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use windhover_base::msg::FixKind;

    #[test]
    fn level_ground_lies_under_the_first_fix_however_far_the_datum_is() {
        // Given a datum 10 km away, where the tangent plane stands 8 m above the ground.
        let text = include_str!("../../config/windhover.toml");
        let mut config = Config::parse(text).expect("the shipped configuration");
        config.datum =
            Some(windhover_base::settings::Datum { lat_deg: 30.0, lon_deg: -85.5, height_m: 20.0 });
        config.ground =
            windhover_base::settings::GroundConfig { elevation_msl_m: Some(33.0), ..config.ground };
        let epoch = GnssEpoch {
            fix: FixKind::ThreeD,
            lat_deg: Some(30.07),
            lon_deg: Some(-85.57),
            alt_msl_m: Some(43.0),
            geoid_m: Some(-27.0),
            ..GnssEpoch::default()
        };
        // When the site is settled by the first fix.
        let settled = SiteFinder::new(&(&config).into(), None).offer(&epoch).expect("a declination is given");
        // Then the ground under it is at its elevation.
        let (frame, at) = (settled.site.frame, Geodetic { lat_deg: 30.07, lon_deg: -85.57, height_m: 6.0 });
        let ned = frame.ned(at);
        assert!((settled.site.ground.down_m(ned.x, ned.y) - ned.z).abs() < 1e-6);
        assert!(ned.z > 20.0, "the plane of the datum would be {:.1} m off", ned.z - 14.0);
    }
}
