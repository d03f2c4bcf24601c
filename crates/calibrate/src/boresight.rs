//! Boresight: mounting and timing of camera and compass, from flights over markers at rest.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector, Vector3};

use super::boresight_filter::Filter;
use super::boresight_state::{PARAMETERS, Parameters};
use windhover_base::geo::{Geodetic, LocalFrame};
use windhover_base::msg::{AttitudeSample, GnssEpoch, MarkerDetection, MarkerId, Stamped};
use windhover_base::settings::{MarkerConfig, Rig, TargetConfig, TargetModel};
use windhover_base::time::{MonoTime, Span};

/// Passes over the flights: each linearises about the result of the previous one.
const PASSES: usize = 3;
/// A parameter counts as determined where its sigma is below this share of the prior's.
const DETERMINED: f64 = 0.5;
/// Lower limit of the sigma of the compass's lateness: attitude between samples is a model, s.
const LATENESS_FLOOR_S: f64 = 1e-3;
/// Shorter flights are refused, seconds.
const SHORTEST_S: f64 = 5.0;

/// Name, unit, one-sigma prior about the configuration's value, and the factor from the state's unit.
const NAMES: [(&str, &str, f64, f64); PARAMETERS] = [
    ("mount yaw", "°", 5.0, 57.295_779_513_082_32),
    ("mount pitch", "°", 5.0, 57.295_779_513_082_32),
    ("mount roll", "°", 5.0, 57.295_779_513_082_32),
    ("lever arm forward", "m", 0.2, 1.0),
    ("lever arm right", "m", 0.2, 1.0),
    ("lever arm down", "m", 0.2, 1.0),
    ("compass yaw", "°", 2.0, 57.295_779_513_082_32),
    ("compass pitch zero", "°", 0.5, 57.295_779_513_082_32),
    ("compass roll zero", "°", 0.5, 57.295_779_513_082_32),
    ("compass late by", "ms", 30.0, 1e3),
    ("gps late by", "ms", 40.0, 1e3),
];

/// One flight's raw measurements, each stamped with its time of validity.
#[derive(Clone, Debug, Default)]
pub struct Recording {
    /// GPS epochs.
    pub gnss: Vec<Stamped<GnssEpoch>>,
    /// Compass samples.
    pub attitude: Vec<Stamped<AttitudeSample>>,
    /// Markers seen in each frame, by its time of exposure.
    pub frames: Vec<(MonoTime, Vec<MarkerDetection>)>,
}

/// Why flights gave no boresight.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum BoresightError {
    /// No flight was given.
    #[error("no flight was given")]
    NoFlight,
    /// A flight lacks something.
    #[error("flight {number}: {reason}")]
    Unusable {
        /// Its number, from 1.
        number: usize,
        /// What it lacks.
        reason: &'static str,
    },
}

/// One estimated quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Finding {
    /// Its name.
    pub name: &'static str,
    /// Unit of the figures.
    pub unit: &'static str,
    /// Its value.
    pub value: f64,
    /// One-sigma.
    pub sigma: f64,
    /// One-sigma before the flights.
    pub prior: f64,
    /// Whether the flights determined it.
    pub determined: bool,
}

/// An estimated marker.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct MarkerFound {
    /// Its identity.
    pub marker: MarkerId,
    /// Flight, from 1.
    pub flight: usize,
    /// Its position.
    pub position: Geodetic,
    /// One-sigma north, east, down, metres.
    pub sigma_m: Vector3<f64>,
}

/// The result.
#[derive(Clone, PartialEq, Debug)]
pub struct Boresight {
    /// Mounting angles, lever arm, compass zeros, lateness.
    pub parameters: Vec<Finding>,
    /// Mount minus compass zero: the camera relative to the compass's level and north. This determines the positions of
    /// a vehicle, and is known even where its two parts are not.
    pub camera_to_compass: Vec<Finding>,
    /// Markers.
    pub markers: Vec<MarkerFound>,
    /// Root mean square of the pixel residuals, each axis.
    pub rms_px: f64,
    /// Pixel coordinates used.
    pub pixels: usize,
    /// Measurements that the gate refused.
    pub refused: usize,
}

/// A measurement in order of validity.
enum Item<'a> {
    Gnss(&'a GnssEpoch),
    Attitude(&'a AttitudeSample),
    Frame(&'a [MarkerDetection]),
}

/// Estimates the boresight by least squares over all raw measurements: GPS positions with a slowly varying bias, GPS
/// velocities, compass angles, pixels of markers. Values of the configuration are the initial values and weak priors.
/// `surveyed` are markers with known positions.
///
/// ```
/// use std::collections::BTreeMap;
/// use windhover_calibrate::boresight::{BoresightError, Recording, boresight};
/// use windhover_simulate::Scenario;
///
/// let rig = Scenario::named("hover10").expect("a named scenario").rig;
/// assert_eq!(boresight(&rig, 0.0, &[], &BTreeMap::new()), Err(BoresightError::NoFlight));
/// // A flight without measurements is named by its number.
/// let unusable = boresight(&rig, 0.0, &[Recording::default()], &BTreeMap::new());
/// assert!(matches!(unusable, Err(BoresightError::Unusable { number: 1, .. })));
/// ```
///
/// # Errors
/// There is no flight, or a flight has no fixes, readings or markers, or is too short. The error has the number of the
/// flight.
pub fn boresight(
    rig: &Rig,
    declination_rad: f64,
    flights: &[Recording],
    surveyed: &BTreeMap<MarkerId, (Geodetic, f64)>,
) -> Result<Boresight, BoresightError> {
    if flights.is_empty() {
        return Err(BoresightError::NoFlight);
    }
    let (start, prior) = prior_of(rig);
    let mut about = None;
    let mut last = None;
    for _ in 0..PASSES {
        let pass = run_pass(rig, declination_rad, flights, surveyed, (start, &prior), about)?;
        about = Some(pass.parameters);
        last = Some(pass);
    }
    last.map(|pass| pass.result(&prior)).ok_or(BoresightError::NoFlight)
}

fn prior_of(rig: &Rig) -> (Parameters, DVector<f64>) {
    let mount = &rig.camera.mount;
    let [forward, right, down] = mount.position_m;
    let start = [
        mount.yaw_deg.to_radians(),
        mount.pitch_deg.to_radians(),
        mount.roll_deg.to_radians(),
        forward,
        right,
        down,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    ];
    let mut sigma =
        DVector::from_iterator(PARAMETERS, NAMES.iter().map(|(_, _, prior, factor)| prior / factor));
    let configured = rig.compass.heading_bias_sigma_deg.max(0.1).to_radians();
    sigma[6] = configured;
    sigma[10] = (rig.gps.latency_sigma_ms * 1e-3).max(1e-3);
    (start, sigma)
}

/// The result of one pass over all flights.
struct Pass {
    parameters: Parameters,
    covariance: DMatrix<f64>,
    markers: Vec<MarkerFound>,
    fit: (f64, usize),
    refused: usize,
}

fn run_pass(
    rig: &Rig,
    declination: f64,
    flights: &[Recording],
    surveyed: &BTreeMap<MarkerId, (Geodetic, f64)>,
    (mut parameters, prior): (Parameters, &DVector<f64>),
    about: Option<Parameters>,
) -> Result<Pass, BoresightError> {
    let mut covariance = DMatrix::from_diagonal(&prior.map(|s| s * s));
    let (mut markers, mut fit, mut refused) = (Vec::new(), (0.0, 0), 0);
    for (k, flight) in flights.iter().enumerate() {
        let unusable = |reason| BoresightError::Unusable { number: k + 1, reason };
        let (frame, mut filter, from) =
            begin(rig, declination, flight, (parameters, &covariance), about).map_err(unusable)?;
        run_flight(&mut filter, rig, flight, &frame, from);
        for (id, (at, sigma_m)) in surveyed {
            filter.surveyed(*id, frame.ned(*at), *sigma_m);
        }
        markers.extend(filter.markers().map(|(marker, center, sigma_m)| MarkerFound {
            marker,
            flight: k + 1,
            position: frame.geodetic(&center),
            sigma_m,
        }));
        (parameters, covariance) = filter.parameters();
        fit = (fit.0 + filter.fit.0, fit.1 + filter.fit.1);
        refused += filter.refused;
    }
    Ok(Pass { parameters, covariance, markers, fit, refused })
}

/// A filter at the first instant at which GPS and compass are both known.
fn begin<'a>(
    rig: &'a Rig,
    declination: f64,
    flight: &Recording,
    known: (Parameters, &DMatrix<f64>),
    about: Option<Parameters>,
) -> Result<(LocalFrame, Filter<'a>, MonoTime), &'static str> {
    let located = |e: &Stamped<GnssEpoch>| Some((e.t_valid, position_of(&e.value)?, e.value.vel_ned_mps));
    let (t, at, velocity) = flight.gnss.iter().find_map(located).ok_or("it has no GPS position")?;
    let last = flight.frames.iter().rfind(|f| !f.1.is_empty()).ok_or("it has no marker detections")?;
    if (last.0 - t).s() < SHORTEST_S {
        return Err("it is too short: fly at least a minute over the marker");
    }
    let near = flight.attitude.iter().filter(|a| a.value.heading.is_some() && a.value.tilt.is_some());
    let first = near.min_by_key(|a| (a.t_valid - t).abs()).ok_or("it has no compass readings")?;
    let sample = first.value;
    let compass = &rig.compass;
    let tilt = sample.tilt.ok_or("it has no compass readings")?;
    let heading = sample.heading.ok_or("it has no compass readings")?
        + if sample.heading_is_true { 0.0 } else { declination }
        + compass.yaw_offset_deg.to_radians();
    let level = windhover_base::geo::Tilt {
        pitch: tilt.pitch - compass.pitch_offset_deg.to_radians(),
        roll: tilt.roll - compass.roll_offset_deg.to_radians(),
    };
    let attitude = compass.angles.ned_from_body(heading, level).ok_or("its first tilt is impossible")?;
    let frame = LocalFrame::new(at);
    let velocity = velocity.unwrap_or_default();
    let start = (Vector3::zeros(), velocity);
    Ok((frame, Filter::new(rig, declination, start, attitude, known, about), t))
}

fn position_of(e: &GnssEpoch) -> Option<Geodetic> {
    let height_m = e.alt_msl_m? + e.geoid_m.unwrap_or(0.0);
    Some(Geodetic { lat_deg: e.lat_deg?, lon_deg: e.lon_deg?, height_m })
}

fn run_flight(filter: &mut Filter<'_>, rig: &Rig, flight: &Recording, frame: &LocalFrame, from: MonoTime) {
    let markers = markers_of(rig);
    let mut items: Vec<(MonoTime, Item<'_>)> = Vec::new();
    items.extend(flight.gnss.iter().map(|e| (e.t_valid, Item::Gnss(&e.value))));
    items.extend(flight.attitude.iter().map(|a| (a.t_valid, Item::Attitude(&a.value))));
    items.extend(flight.frames.iter().map(|(t, m)| (*t, Item::Frame(m))));
    items.retain(|(t, _)| *t >= from);
    items.sort_by_key(|(t, _)| *t);
    let mut now = from;
    for (t, item) in items {
        // Long silences are divided into steps that are short relative to the motion.
        while t > now {
            let step = (t - now).min(Span::from_ms(50.0));
            filter.advance(step.s());
            now += step;
        }
        match item {
            Item::Gnss(e) => {
                if let Some(at) = position_of(e) {
                    filter.gps_position(frame.ned(at), rig.gps.noise_m);
                }
                if let Some(v) = e.vel_ned_mps {
                    let known = if e.vel_has_down { 3 } else { 2 };
                    filter.gps_velocity(&v.as_slice()[..known]);
                }
            }
            Item::Attitude(sample) => filter.compass(sample),
            Item::Frame(seen) => {
                for detection in seen {
                    if let Some(marker) = markers.get(&detection.marker) {
                        filter.marker(detection, marker);
                    }
                }
            }
        }
    }
}

/// Markers at rest: those of static targets, or all where no target is.
fn markers_of(rig: &Rig) -> BTreeMap<MarkerId, &MarkerConfig> {
    let mut all = BTreeMap::new();
    let at_rest = |t: &TargetConfig| t.model == TargetModel::Static;
    let any = rig.target.iter().any(at_rest);
    for (target, t) in rig.target.iter().enumerate().filter(|(_, t)| !any || at_rest(t)) {
        for (marker, m) in t.marker.iter().enumerate() {
            let id = match (m.family, m.id) {
                (Some(family), Some(id)) => MarkerId::Tag { family, id },
                _ => MarkerId::Disc { target, marker },
            };
            all.insert(id, m);
        }
    }
    all
}

impl Pass {
    fn result(self, prior: &DVector<f64>) -> Boresight {
        let floor = |k: usize| if k == 9 { LATENESS_FLOOR_S } else { 0.0 };
        let sigma = |k: usize| self.covariance[(k, k)].max(0.0).sqrt().hypot(floor(k));
        let parameters = NAMES
            .iter()
            .enumerate()
            .map(|(k, (name, unit, _, factor))| Finding {
                name,
                unit,
                value: self.parameters[k] * factor,
                sigma: sigma(k) * factor,
                prior: prior[k] * factor,
                determined: sigma(k) < DETERMINED * prior[k],
            })
            .collect();
        let together = [("yaw", 0, 6), ("pitch", 1, 7), ("roll", 2, 8)];
        let camera_to_compass = together
            .iter()
            .map(|(name, mount, zero)| {
                let c = &self.covariance;
                let variance = c[(*mount, *mount)] + c[(*zero, *zero)] - 2.0 * c[(*mount, *zero)];
                let (sigma, wide) = (variance.max(0.0).sqrt(), prior[*mount].hypot(prior[*zero]));
                Finding {
                    name,
                    unit: "°",
                    value: (self.parameters[*mount] - self.parameters[*zero]).to_degrees(),
                    sigma: sigma.to_degrees(),
                    prior: wide.to_degrees(),
                    determined: sigma < DETERMINED * wide,
                }
            })
            .collect();
        Boresight {
            parameters,
            camera_to_compass,
            markers: self.markers,
            rms_px: (self.fit.0 / self.fit.1.max(1) as f64).sqrt(),
            pixels: self.fit.1,
            refused: self.refused,
        }
    }
}

impl Boresight {
    /// Advice on flying so that the remaining parameters are determined; empty where all are.
    pub fn advice(&self) -> Vec<String> {
        let undetermined =
            |names: &[&str]| self.parameters.iter().any(|p| !p.determined && names.contains(&p.name));
        let blurred = |name: &str| self.camera_to_compass.iter().any(|p| p.name == name && !(p.sigma < 0.2));
        let mut advice = Vec::new();
        if blurred("yaw") {
            advice.push("The camera's yaw is not determined: fly past the marker at 3 m/s or more, in two directions.");
        }
        if blurred("pitch") || blurred("roll") {
            advice.push(
                "The camera's pitch or roll is not determined: turn the helicopter through a whole circle over the \
                 marker, twice, at constant height.",
            );
        }
        if undetermined(&["mount yaw", "compass yaw", "compass pitch zero", "compass roll zero"]) {
            advice.push(
                "Mount and compass zeros are determined only together; for positions only their difference \
                 matters. To separate yaw, bank steeply (15° and more) to both sides over the marker; to separate \
                 tilt, level the compass on the bench.",
            );
        }
        if undetermined(&["lever arm forward", "lever arm right"]) {
            advice.push(
                "The lever arm is not determined: turn on the spot over the marker, at 5 m and again at 15 m.",
            );
        }
        if undetermined(&["lever arm down"]) {
            advice
                .push("The lever arm's height cannot be separated from GPS height: measure it with a ruler.");
        }
        if undetermined(&["compass late by"]) {
            advice.push(
                "The compass's lateness is not determined: yaw quickly left and right (30° a second) over the marker.",
            );
        }
        if undetermined(&["gps late by"]) {
            advice.push(
                "The GPS's lateness is not determined: fly past the marker fast, in opposite directions.",
            );
        }
        advice.into_iter().map(str::to_owned).collect()
    }
}
