//! The unknowns: those of a knot, and the constants of the flight.

use nalgebra::Vector3;

use windhover_base::msg::MisfitCause;
use windhover_base::settings::Rig;
use windhover_estimate::batch::{Predictor, RigOffsets, SWAY_COLUMNS, TAG_COLUMNS, TARGET_COLUMNS, columns};

/// Unknowns of a knot: the helicopter, its slow errors, then each target.
pub(crate) mod knot {
    /// NED, m.
    pub(crate) const POSITION: usize = 0;
    /// NED, m/s.
    pub(crate) const VELOCITY: usize = 3;
    /// Small rotation about NED, rad.
    pub(crate) const ATTITUDE: usize = 6;
    /// Body axes, rad/s.
    pub(crate) const RATE: usize = 9;
    /// Angular acceleration, body axes, rad/s².
    pub(crate) const SPIN: usize = 12;
    /// North, east, m/s².
    pub(crate) const GUST: usize = 15;
    /// m/s².
    pub(crate) const THRUST: usize = 17;
    /// Pitch, roll, rad.
    pub(crate) const TILT_ERROR: usize = 18;
    /// North, east, m/s².
    pub(crate) const WIND: usize = 20;
    /// NED, m.
    pub(crate) const GPS_BIAS: usize = 22;
    /// The first target's.
    pub(crate) const TARGETS: usize = 25;

    /// Length of a target's part: north, east, heading, speed, yaw rate, acceleration, yaw acceleration, jerk, yaw jerk,
    /// sway (roll, pitch, heave).
    pub(crate) const TARGET: usize = 12;
    /// Length of the part that all targets have: the others are zero where the target does not sway.
    pub(crate) const RIGID: usize = 9;
    pub(crate) const HEADING: usize = 2;
    pub(crate) const SPEED: usize = 3;
    pub(crate) const YAW_RATE: usize = 4;
    pub(crate) const ACCELERATION: usize = 5;
    pub(crate) const YAW_ACCELERATION: usize = 6;
    pub(crate) const JERK: usize = 7;
    pub(crate) const YAW_JERK: usize = 8;
    pub(crate) const SWAY: usize = 9;

    /// Where a target's part begins.
    pub(crate) const fn target(i: usize) -> usize {
        TARGETS + TARGET * i
    }
}

/// A constant of the flight.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum ConstantKind {
    /// Trim of the thrust in the body, forward and right; component.
    Trim(usize),
    /// Error of the compass's heading.
    HeadingBias,
    /// Share of the tilt (or force) that the tilt sensor reads.
    TiltShare,
    /// Error of the tilt reading: pitch, roll.
    TiltBias(usize),
    /// How much older fixes are than configured.
    GpsDelay,
    /// Drag of the helicopter.
    Drag,
    /// Iron: sine and cosine of the heading, then of twice the heading.
    Iron(usize),
    /// How much older compass readings are than configured.
    CompassDelay,
    /// How much older frames are than configured.
    CameraDelay,
    /// Time from the first row's exposure to the last one's, minus the configured value.
    Readout,
    /// Rotation of the camera on the body about forward, right, down, relative to its configuration.
    Mount(usize),
    /// Position of the camera relative to its configuration: forward, right, down.
    CameraAt(usize),
    /// Position of the antenna, likewise.
    AntennaAt(usize),
    /// Logarithm of the focal length over that configured.
    Focal,
    /// A distortion term of the lens relative to its configuration: k1, k2, p1, p2; of a fisheye its four.
    Lens(usize),
    /// Time constant of the low-pass that the receiver applies to velocity and not to position.
    VelocityDelay,
    /// Of a tag: logarithm of its size over that configured; place forward, right; turn.
    Tag {
        /// Index of the target.
        target: usize,
        /// Index of the marker.
        marker: usize,
        /// Which of the four.
        part: usize,
    },
}

impl ConstantKind {
    /// Whether its expected value is from the configuration.
    const fn is_configured(self) -> bool {
        !matches!(self, Self::Trim(_) | Self::Drag | Self::TiltShare | Self::VelocityDelay)
    }
}

/// Places of the constants.
pub(crate) mod constant {
    pub(crate) const TRIM: usize = 0;
    pub(crate) const HEADING_BIAS: usize = 2;
    pub(crate) const TILT_SHARE: usize = 3;
    pub(crate) const TILT_BIAS: usize = 4;
    pub(crate) const GPS_DELAY: usize = 6;
    pub(crate) const DRAG: usize = 7;
    pub(crate) const IRON: usize = 8;
    pub(crate) const COMPASS_DELAY: usize = 12;
    pub(crate) const CAMERA_DELAY: usize = 13;
    pub(crate) const READOUT: usize = 14;
    pub(crate) const MOUNT: usize = 15;
    pub(crate) const CAMERA_AT: usize = 18;
    pub(crate) const ANTENNA_AT: usize = 21;
    pub(crate) const FOCAL: usize = 24;
    pub(crate) const LENS: usize = 25;
    pub(crate) const VELOCITY_DELAY: usize = 29;
    pub(crate) const TAGS: usize = 30;
}

/// The prior of a constant.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Prior {
    pub(crate) kind: ConstantKind,
    pub(crate) mean: f64,
    /// One sigma; zero where it is known.
    pub(crate) sigma: f64,
    /// One sigma of a careful configuration; `sigma` is larger where it turned out to be wrong.
    pub(crate) careful: f64,
    /// Whether it is fixed: the flight must not change it.
    pub(crate) held: bool,
}

impl Prior {
    /// Whether the flight estimates it.
    pub(crate) fn is_estimated(&self) -> bool {
        self.sigma > 0.0 && !self.held
    }

    /// Whether a value is so far from the expected one that the configuration is wrong: widens it then.
    pub(crate) fn widen(&mut self, value: f64) -> bool {
        let beyond = self.is_estimated()
            && self.sigma == self.careful
            && self.kind.is_configured()
            && (value - self.mean).abs() > BEYOND * self.sigma;
        if beyond {
            self.sigma *= OTHERWISE;
        }
        beyond
    }

    /// Widens it where the filter found that it is configured wrongly.
    pub(crate) fn widen_by(&mut self, wrong: &[MisfitCause]) {
        use ConstantKind as Kind;
        let is_it = |cause: &MisfitCause| match (*cause, self.kind) {
            (MisfitCause::AntennaPlace, Kind::AntennaAt(_))
            | (MisfitCause::Lens, Kind::Lens(_))
            | (MisfitCause::Readout, Kind::Readout)
            | (MisfitCause::Late, Kind::CameraDelay) => true,
            (
                MisfitCause::MarkerSize(p) | MisfitCause::MarkerPlace(p) | MisfitCause::MarkerTurn(p),
                Kind::Tag { target, .. },
            ) => p.target == target,
            _ => false,
        };
        if self.sigma == self.careful && wrong.iter().any(is_it) {
            self.sigma *= OTHERWISE;
        }
    }
}

/// Sigmas of a careful configuration beyond which it is wrong.
const BEYOND: f64 = 2.5;
/// How much less a wrong configuration says than a careful one.
const OTHERWISE: f64 = 10.0;

/// Trim: a tail rotor makes a helicopter hang by some degrees.
const TRIM: f64 = 0.06;
/// Drag of small rotorcraft, 1/s: mean and sigma.
const DRAG: (f64, f64) = (0.2, 0.1);
/// Tilt zero of a carefully mounted compass, rad.
const TILT_BIAS: f64 = 0.007;
/// Prior sigma of the share of the tilt that is read.
const SHARE: f64 = 0.15;
/// Iron of a compass that was calibrated once: one cycle and two, rad.
const IRON: [f64; 2] = [0.026, 0.009];
/// Delays in addition to the configured ones, s.
const COMPASS_DELAY: f64 = 0.03;
const CAMERA_DELAY: f64 = 0.005;
const READOUT: f64 = 0.01;
/// Mount measured with a protractor, rad; places with a ruler, m.
const MOUNT: f64 = 0.0175;
const CAMERA_AT: f64 = 0.02;
const ANTENNA_AT: f64 = 0.1;
/// Focal length of a calibrated lens after refocusing: share.
const FOCAL: f64 = 0.005;
/// Distortion of a calibrated lens: k1, k2, p1, p2.
const LENS: [f64; 4] = [0.02, 0.02, 0.0005, 0.0005];
/// Receivers filter velocity over some tenths of a second, s.
const VELOCITY_DELAY: f64 = 0.1;
/// A tag as printed and glued on: share of its size, m, m, rad.
const TAG: [f64; TAG_COLUMNS] = [0.005, 0.01, 0.01, 0.0175];

/// Constants with their priors, in their places.
///
/// In a blind flight (hardly a marker in view) only the compass's heading is estimated: a rotorcraft responds to gusts
/// with tilt, so any other free constant absorbs the errors of the motion model.
pub(crate) fn priors(rig: &Rig, predictor: &Predictor, share: Option<f64>, blind: bool) -> Vec<Prior> {
    use ConstantKind as Kind;
    let prior = |kind, sigma| Prior { kind, mean: 0.0, sigma, careful: sigma, held: false };
    let gps_delay = rig.gps.latency_sigma_ms * 1e-3;
    let mut all = vec![
        prior(Kind::Trim(0), TRIM),
        prior(Kind::Trim(1), TRIM),
        prior(Kind::HeadingBias, predictor.heading_bias_var().sqrt()),
        Prior { mean: share.unwrap_or(1.0), ..prior(Kind::TiltShare, share.map_or(0.0, |k| k * SHARE)) },
        prior(Kind::TiltBias(0), TILT_BIAS),
        prior(Kind::TiltBias(1), TILT_BIAS),
        prior(Kind::GpsDelay, gps_delay),
        Prior { mean: DRAG.0, ..prior(Kind::Drag, DRAG.1) },
    ];
    all.extend((0..4).map(|i| prior(Kind::Iron(i), IRON[i / 2])));
    all.push(prior(Kind::CompassDelay, COMPASS_DELAY));
    all.push(prior(Kind::CameraDelay, CAMERA_DELAY));
    all.push(prior(Kind::Readout, READOUT));
    all.extend((0..3).map(|i| prior(Kind::Mount(i), MOUNT)));
    all.extend((0..3).map(|i| prior(Kind::CameraAt(i), CAMERA_AT)));
    all.extend((0..3).map(|i| prior(Kind::AntennaAt(i), ANTENNA_AT)));
    all.push(prior(Kind::Focal, FOCAL));
    all.extend((0..4).map(|i| prior(Kind::Lens(i), LENS[i])));
    all.push(prior(Kind::VelocityDelay, VELOCITY_DELAY));
    let mut last = None;
    for (target, marker) in predictor.tags() {
        // Place and yaw of a target's first tag define the target's frame.
        let first = last.replace(target) != Some(target);
        all.extend((0..TAG_COLUMNS).map(|part| {
            let sigma = if first && part > 0 { 0.0 } else { TAG[part] };
            prior(Kind::Tag { target, marker, part }, sigma)
        }));
    }
    all.iter_mut().for_each(|prior| prior.held = blind && prior.kind != Kind::HeadingBias);
    all
}

/// Deviations of camera and antenna, from the constants.
pub(crate) fn rig_offsets(constants: &[f64]) -> RigOffsets {
    let three = |at: usize| Vector3::from_column_slice(&constants[at..at + 3]);
    RigOffsets {
        mount: three(constant::MOUNT),
        camera_at: three(constant::CAMERA_AT),
        antenna_at: three(constant::ANTENNA_AT),
        ln_focal: constants[constant::FOCAL],
        readout_s: constants[constant::READOUT],
    }
}

/// The unknown that corresponds to a column of the filter's error state.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Place {
    Knot(usize),
    Constant(usize),
    Landmark(usize),
    /// Displacement of the frame at hand.
    Shake(usize),
    /// A constant that is not estimated.
    Known(usize),
    /// No unknown.
    Nowhere,
}

/// The same for an external position, which is independent of the receiver's errors.
pub(crate) fn outside_places(places: &[Place]) -> Vec<Place> {
    let mut places = places.to_vec();
    columns::GPS_BIAS
        .chain(columns::GPS_DELAY)
        .chain(columns::VELOCITY_DELAY)
        .for_each(|column| places[column] = Place::Nowhere);
    places
}

/// The place of each column.
pub(crate) fn places(predictor: &Predictor, sways: &[bool], shakes: bool, priors: &[Prior]) -> Vec<Place> {
    let mut places = vec![Place::Nowhere; predictor.len()];
    let of_knot = [
        (columns::POSITION, knot::POSITION),
        (columns::VELOCITY, knot::VELOCITY),
        (columns::ATTITUDE, knot::ATTITUDE),
        (columns::RATE, knot::RATE),
        (columns::GUST, knot::GUST),
        (columns::THRUST, knot::THRUST),
        (columns::TILT_ERROR, knot::TILT_ERROR),
        (columns::WIND, knot::WIND),
        (columns::GPS_BIAS, knot::GPS_BIAS),
    ];
    let of_flight = [
        (columns::TRIM, constant::TRIM),
        (columns::HEADING_BIAS, constant::HEADING_BIAS),
        (columns::TILT_GAIN, constant::TILT_SHARE),
        (columns::TILT_BIAS, constant::TILT_BIAS),
        (columns::GPS_DELAY, constant::GPS_DELAY),
        (columns::DRAG, constant::DRAG),
        (columns::LENS, constant::LENS),
        (columns::VELOCITY_DELAY, constant::VELOCITY_DELAY),
    ];
    for (range, first) in of_knot {
        range.enumerate().for_each(|(i, column)| places[column] = Place::Knot(first + i));
    }
    for (range, first) in of_flight {
        range.enumerate().for_each(|(i, column)| places[column] = Place::Constant(first + i));
    }
    for (target, sways) in sways.iter().enumerate() {
        let range = predictor.target_columns(target);
        debug_assert_eq!(range.len(), TARGET_COLUMNS);
        range.enumerate().for_each(|(i, column)| places[column] = Place::Knot(knot::target(target) + i));
        let range = predictor.sway_columns(target);
        debug_assert_eq!(range.len(), SWAY_COLUMNS);
        let first = knot::target(target) + knot::SWAY;
        range.enumerate().filter(|_| *sways).for_each(|(i, column)| places[column] = Place::Knot(first + i));
    }
    predictor.feature_columns().enumerate().for_each(|(i, column)| places[column] = Place::Landmark(i));
    let shake = predictor.shake_columns().enumerate().filter(|_| shakes);
    shake.for_each(|(i, column)| places[column] = Place::Shake(i));
    for tag in 0..predictor.tags().len() {
        let first = constant::TAGS + TAG_COLUMNS * tag;
        let range = predictor.tag_columns(tag);
        range.enumerate().for_each(|(i, column)| places[column] = Place::Constant(first + i));
    }
    for place in &mut places {
        if let Place::Constant(i) = *place
            && !priors[i].is_estimated()
        {
            *place = Place::Known(i);
        }
    }
    places
}
