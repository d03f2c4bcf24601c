//! The site of the flight: NED origin, ground, declination, settled by the first fixes that agree.

use std::sync::Arc;

use super::settings::PipelineSettings;
use windhover_base::geo::{self, Geodetic, Ground, LocalFrame, Terrain, Tile};
use windhover_base::msg::{GnssEpoch, WarmSite};
use windhover_base::settings::{Datum, Declination, GroundConfig, GroundSource};
use windhover_estimate::Site;

/// Fixes in a row that agree before one of them is the datum.
const AGREE_FIRST: usize = 3;
/// Fixes in a row that must agree before a datum moves on which others had agreed.
const AGREE_MOVE: usize = 5;
/// Greatest distance of agreeing fixes from the first of them, horizontally and vertically, metres: enough for a fast
/// helicopter with a slow receiver.
const AGREE_M: (f64, f64) = (500.0, 200.0);
/// Farther than this from the datum, the flight is elsewhere, metres.
const ELSEWHERE_M: f64 = 50_000.0;
/// A position nearer than this to latitude 0, longitude 0 is no position, degrees: receivers without a fix give it.
const NULL_ISLAND_DEG: f64 = 0.001;
/// Number of unusable fixes in a row before a report is due, and between reports.
const UNUSED_WORD: (usize, usize) = (25, 250);
/// Number of fixes whose median height is the ground, where the ground is configured as the place of take-off.
const TAKEOFF_FIXES: usize = 5;
/// Number of fixes to wait for a date before the World Magnetic Model is given up.
const DATE_PATIENCE: usize = 50;

/// Collects first fixes until the site is settled.
pub(super) struct SiteFinder {
    /// The first of the fixes in a row that agree, and how many there are.
    first: Option<Geodetic>,
    agreeing: usize,
    heights_m: Vec<f64>,
    seen: usize,
    unused: Unused,
    ground: GroundConfig,
    datum: Option<Datum>,
    declination_deg: Option<f64>,
    declination: Option<Declination>,
    terrain: Option<Arc<Tile>>,
    warm: Option<WarmSite>,
}

/// Unusable fixes in a row, and the reason for the last.
#[derive(Default)]
struct Unused {
    count: usize,
    reported: usize,
    why: Option<&'static str>,
}

impl Unused {
    /// Counts one more, with this reason.
    fn note(&mut self, why: &'static str) {
        if self.why != Some(why) {
            *self = Self { why: Some(why), ..Self::default() };
        }
        self.count += 1;
    }

    /// The report that is due at this time, once.
    fn word(&mut self) -> Option<&'static str> {
        let (first, then) = UNUSED_WORD;
        let due = self.count != self.reported
            && self.count.checked_sub(first).is_some_and(|more| more.is_multiple_of(then));
        if due {
            self.reported = self.count;
        }
        self.why.filter(|_| due)
    }
}

/// A settled site, and what an operator should know of its declination.
pub(super) struct SettledSite {
    pub(super) site: Site,
    /// The same as plain numbers, for a warm start.
    pub(super) warm: WarmSite,
    /// Whether the site is that of an earlier run.
    pub(super) continued: bool,
    pub(super) declination_notice: Option<String>,
    pub(super) ground_notice: Option<String>,
}

/// The site of a recorded flight: its datum as it was reported, ground and declination by the fixes that settled it.
pub fn site_of<'a>(
    settings: &PipelineSettings,
    terrain: Option<Arc<Tile>>,
    datum: Geodetic,
    epochs: impl IntoIterator<Item = &'a GnssEpoch>,
) -> Option<Site> {
    let Geodetic { lat_deg, lon_deg, height_m } = datum;
    let settings = PipelineSettings { datum: Some(Datum { lat_deg, lon_deg, height_m }), ..settings.clone() };
    let mut finder = SiteFinder::new(&settings, terrain);
    let here = |epoch: &&GnssEpoch| {
        position(epoch).and_then(Result::ok).is_some_and(|at| distance_m(datum, at).0 < ELSEWHERE_M)
    };
    epochs.into_iter().filter(here).find_map(|epoch| finder.offer(epoch)).map(|settled| settled.site)
}

impl SiteFinder {
    pub(super) fn new(settings: &PipelineSettings, terrain: Option<Arc<Tile>>) -> Self {
        let compass = &settings.rig.compass;
        Self {
            first: None,
            agreeing: 0,
            heights_m: Vec::with_capacity(TAKEOFF_FIXES),
            seen: 0,
            unused: Unused::default(),
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

    /// Takes a fix; returns the site once it is settled.
    pub(super) fn offer(&mut self, epoch: &GnssEpoch) -> Option<SettledSite> {
        let at = match position(epoch)? {
            Ok(at) => at,
            Err(why) => {
                self.unused.note(why);
                return None;
            }
        };
        let first = self.first_agreeing(at);
        if let Some(warm) = self.warm.take().filter(|warm| self.agrees(warm, &at)) {
            return Some(SettledSite { continued: true, ..self.settled(warm, None) });
        }
        self.settle(epoch, at, first, AGREE_FIRST)
    }

    /// Takes a fix of a settled flight; returns a new site where several fixes agree that the flight is elsewhere. The
    /// datum moves only if it is not configured, and only while nothing has been tracked.
    pub(super) fn offer_again(
        &mut self,
        epoch: &GnssEpoch,
        datum: Geodetic,
        tracked: bool,
    ) -> Option<SettledSite> {
        let at = position(epoch)?.ok()?;
        if distance_m(datum, at).0 < ELSEWHERE_M {
            self.first = None;
            self.unused = Unused::default();
            return None;
        }
        let first = self.first_agreeing(at);
        if tracked || self.datum.is_some() {
            self.unused.note(if tracked { FAR_TRACKED } else { FAR_CONFIGURED });
            return None;
        }
        self.settle(epoch, at, first, AGREE_MOVE)
    }

    /// Number of agreeing fixes in a row so far.
    pub(super) fn agreeing(&self) -> usize {
        self.agreeing
    }

    /// The reason why fixes in a row were unusable, when a report is due.
    pub(super) fn unused_word(&mut self) -> Option<&'static str> {
        self.unused.word()
    }

    /// The first of the fixes in a row that agree with this one.
    fn first_agreeing(&mut self, at: Geodetic) -> Geodetic {
        let agrees = |first: Geodetic| {
            let (across, up) = distance_m(first, at);
            across <= AGREE_M.0 && up <= AGREE_M.1
        };
        if let Some(first) = self.first.filter(|first| agrees(*first)) {
            self.agreeing += 1;
            return first;
        }
        if self.first.is_some() {
            self.unused.note(SCATTERED);
        }
        self.first = Some(at);
        self.agreeing = 1;
        self.heights_m.clear();
        at
    }

    fn settle(
        &mut self,
        epoch: &GnssEpoch,
        at: Geodetic,
        first: Geodetic,
        agree: usize,
    ) -> Option<SettledSite> {
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
        if self.agreeing < agree {
            return None;
        }
        self.unused = Unused::default();
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
            // Far from the datum its tangent plane lies above the curved surface of the Earth.
            None => {
                Ground::Flat { down_m: frame.ned(Geodetic { height_m: warm.ground_height_m, ..first }).z }
            }
        };
        let site = Site { frame, ground, declination_rad: warm.declination_rad };
        SettledSite { site, warm, continued: false, declination_notice, ground_notice }
    }

    /// Declination in radians and its report; `None` while waiting for a date.
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

    /// Whether an earlier run's site is at this place and agrees with the configuration.
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

/// Greatest distance from an earlier run's datum within which a flight is still the same one, degrees (some 10 km).
const SAME_FLIGHT_DEG: f64 = 0.1;

/// Reports of positions that are not used.
const NO_HEIGHT: &str = "its fixes are two-dimensional by its own word (GSA or PGRMF): without a height there is no \
                         datum, and nothing is estimated until a fix has one";
const NO_ALTITUDE: &str = "its sentences tell no altitude (is GGA or GNS on?): without a height there is no datum, and \
                           nothing is estimated";
const NULL_ISLAND: &str = "it says latitude 0, longitude 0, which is no position";
const SCATTERED: &str = "its fixes lie too far apart to tell where the flight is";
const FAR_TRACKED: &str = "its positions are more than 50 km from the datum, which stays because a target was tracked \
                           from it: restart to fly here";
const FAR_CONFIGURED: &str = "its positions are more than 50 km from the datum of the configuration";

/// A three-dimensional position above the ellipsoid, or the reason why the fix gives none; `None` without a fix.
fn position(epoch: &GnssEpoch) -> Option<Result<Geodetic, &'static str>> {
    let (lat_deg, lon_deg) = epoch.lat_deg.zip(epoch.lon_deg).filter(|_| epoch.fix.has_position())?;
    Some(match epoch.alt_msl_m {
        _ if lat_deg.abs().max(lon_deg.abs()) < NULL_ISLAND_DEG => Err(NULL_ISLAND),
        None => Err(NO_ALTITUDE),
        Some(_) if !epoch.fix.has_height() => Err(NO_HEIGHT),
        Some(alt_msl_m) => {
            Ok(Geodetic { lat_deg, lon_deg, height_m: alt_msl_m + epoch.geoid_m.unwrap_or(0.0) })
        }
    })
}

/// Distance between two places, horizontally and vertically, metres.
fn distance_m(from: Geodetic, to: Geodetic) -> (f64, f64) {
    let ned = LocalFrame::new(from).ned(Geodetic { height_m: from.height_m, ..to });
    // At a distance of some kilometres the second place is off the tangent plane of the first.
    (ned.norm(), (to.height_m - from.height_m).abs())
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

    fn finder(change: impl FnOnce(&mut Config)) -> SiteFinder {
        let text = include_str!("../../config/windhover.toml");
        let mut config = Config::parse(text).expect("the shipped configuration");
        config.datum = None;
        config.ground = GroundConfig { elevation_msl_m: Some(33.0), ..config.ground };
        change(&mut config);
        SiteFinder::new(&(&config).into(), None)
    }

    fn fix(lat_deg: f64, lon_deg: f64) -> GnssEpoch {
        GnssEpoch {
            fix: FixKind::ThreeD,
            lat_deg: Some(lat_deg),
            lon_deg: Some(lon_deg),
            alt_msl_m: Some(43.0),
            geoid_m: Some(-27.0),
            ..GnssEpoch::default()
        }
    }

    /// The datum that these fixes settle on, and after how many.
    fn datum_of(finder: &mut SiteFinder, fixes: &[GnssEpoch]) -> Option<(usize, f64, f64)> {
        fixes.iter().enumerate().find_map(|(index, epoch)| {
            let datum = finder.offer(epoch)?.site.frame.datum();
            Some((index + 1, datum.lat_deg, datum.lon_deg))
        })
    }

    #[test]
    fn level_ground_lies_under_the_first_fix_however_far_the_datum_is() {
        // Given a datum 10 km away, where the tangent plane is 8 m above the ground.
        let mut finder = finder(|config| {
            config.datum = Some(Datum { lat_deg: 30.0, lon_deg: -85.5, height_m: 20.0 });
        });
        // When the site is settled by the first fixes.
        let settled = (0..AGREE_FIRST).find_map(|_| finder.offer(&fix(30.07, -85.57)));
        let settled = settled.expect("a declination is given");
        // Then the ground under it is at its elevation.
        let (frame, at) = (settled.site.frame, Geodetic { lat_deg: 30.07, lon_deg: -85.57, height_m: 6.0 });
        let ned = frame.ned(at);
        assert!((settled.site.ground.down_m(ned.x, ned.y) - ned.z).abs() < 1e-6);
        assert!(ned.z > 20.0, "the plane of the datum would be {:.1} m off", ned.z - 14.0);
    }

    #[test]
    fn the_datum_is_the_first_of_several_fixes_that_agree() {
        let good = fix(38.7, -9.2);
        for bad in [fix(0.0, 0.0), fix(1e-5, -2e-4), fix(-33.0, 151.0), fix(38.7, 9.2)] {
            for wild in 1..AGREE_FIRST {
                let fixes = [vec![bad; wild], vec![good; 10]].concat();
                let (after, lat_deg, lon_deg) = datum_of(&mut finder(|_| {}), &fixes).expect("a datum");
                assert_eq!((after, lat_deg, lon_deg), (wild + AGREE_FIRST, 38.7, -9.2));
            }
        }
        let island = vec![fix(0.0, 0.0); 100];
        let mut lost = finder(|_| {});
        assert_eq!(datum_of(&mut lost, &island), None);
        // Places on the equator and on the prime meridian are accepted.
        assert!(datum_of(&mut finder(|_| {}), &[fix(0.0, -9.2); 5]).is_some());
        assert!(datum_of(&mut finder(|_| {}), &[fix(51.5, 0.0); 5]).is_some());
    }

    #[test]
    fn the_datum_moves_while_nothing_is_tracked() {
        let (wrong, right) = (fix(-33.0, 151.0), fix(38.7, -9.2));
        let again = |finder: &mut SiteFinder, tracked| {
            let datum = datum_of(finder, &[wrong; 3]).map(|(_, lat_deg, lon_deg)| (lat_deg, lon_deg));
            let (lat_deg, lon_deg) = datum.expect("three fixes agree");
            let datum = Geodetic { lat_deg, lon_deg, height_m: 6.0 };
            let settled = (1..=30).find_map(|n| Some((n, finder.offer_again(&right, datum, tracked)?)));
            settled.map(|(n, settled)| (n, settled.site.frame.datum().lat_deg))
        };
        assert_eq!(again(&mut finder(|_| {}), false), Some((AGREE_MOVE, 38.7)));
        let mut tracking = finder(|_| {});
        assert_eq!(again(&mut tracking, true), None);
        assert_eq!(tracking.unused.why, Some(FAR_TRACKED));
        let configured = Datum { lat_deg: -33.0, lon_deg: 151.0, height_m: 20.0 };
        let mut fixed = finder(|config| config.datum = Some(configured));
        assert_eq!(again(&mut fixed, false), None);
        assert_eq!(fixed.unused.why, Some(FAR_CONFIGURED));
        // One fix elsewhere moves nothing, and neither do several that do not agree.
        let mut finder = finder(|_| {});
        datum_of(&mut finder, &[right; 3]).expect("a datum");
        let datum = Geodetic { lat_deg: 38.7, lon_deg: -9.2, height_m: 6.0 };
        for n in 0..40 {
            let there = if n % 5 == 4 { right } else { wrong };
            assert!(finder.offer_again(&there, datum, false).is_none());
        }
    }

    #[test]
    fn the_reason_for_a_missing_datum_is_reported() {
        for (epoch, why) in [
            (GnssEpoch { fix: FixKind::TwoD, ..fix(38.7, -9.2) }, NO_HEIGHT),
            (GnssEpoch { fix: FixKind::TwoD, alt_msl_m: None, ..fix(38.7, -9.2) }, NO_ALTITUDE),
            (fix(0.0, 0.0), NULL_ISLAND),
        ] {
            let mut finder = finder(|_| {});
            let offer = |_| {
                assert!(finder.offer(&epoch).is_none());
                finder.unused_word()
            };
            let words: Vec<_> = (0..300).filter_map(offer).collect();
            assert_eq!(words, [why, why], "after 25 fixes, and 250 later");
        }
    }
}
