//! Measurements: decoded, stamped with their time of validity.

use nalgebra::{Matrix2, Vector2, Vector3};

use crate::geo::Tilt;
use crate::msg::TagFamily;
use crate::time::{MonoTime, Span, UtcTime};

/// A value with its times of validity and reception, both host time.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Stamped<T> {
    /// Time of validity.
    pub t_valid: MonoTime,
    /// Time of reception.
    pub t_recv: MonoTime,
    /// Position in the stream of events.
    pub seq: u64,
    /// The value.
    pub value: T,
}

/// Kind of fix that a receiver reports; each kind contains more than the one before.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug, Default)]
pub enum FixKind {
    /// No position.
    #[default]
    None,
    /// Position without height.
    TwoD,
    /// Position and height.
    ThreeD,
    /// Position and height, from carrier phases with unresolved ambiguities (GGA quality 5): decimetres.
    RtkFloat,
    /// Position and height, from carrier phases with resolved ambiguities (GGA quality 4): centimetres.
    RtkFixed,
}

impl FixKind {
    /// Whether there is a position.
    pub fn has_position(self) -> bool {
        self != Self::None
    }

    /// Whether there is a position with its height.
    pub fn has_height(self) -> bool {
        self >= Self::ThreeD
    }

    /// `none`, `2d` or `3d`, for logs and files: RTK is `3d`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::TwoD => "2d",
            Self::ThreeD | Self::RtkFloat | Self::RtkFixed => "3d",
        }
    }
}

/// All values that a receiver reported for one instant. `None` where it did not report one.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct GnssEpoch {
    /// UTC with its date; `None` until the receiver reported a date.
    pub utc: Option<UtcTime>,
    /// Time of day, nanoseconds since UTC midnight.
    pub time_of_day_ns: Option<i64>,
    /// Kind of fix.
    pub fix: FixKind,
    /// Latitude, degrees, north positive.
    pub lat_deg: Option<f64>,
    /// Longitude, degrees, east positive.
    pub lon_deg: Option<f64>,
    /// Altitude above mean sea level, metres.
    pub alt_msl_m: Option<f64>,
    /// Geoid over ellipsoid, metres: height = alt_msl + geoid.
    pub geoid_m: Option<f64>,
    /// Speed over ground, m/s.
    pub speed_mps: Option<f64>,
    /// Course over ground, degrees, true.
    pub course_deg: Option<f64>,
    /// Velocity north, east, down, m/s; down is 0 and unknown unless `vel_has_down`.
    pub vel_ned_mps: Option<Vector3<f64>>,
    /// Whether the down component of `vel_ned_mps` was measured (PGRMV) or is not known (RMC, VTG).
    pub vel_has_down: bool,
    /// Horizontal position error as the receiver reports it, metres.
    pub hpe_m: Option<f64>,
    /// Vertical position error as the receiver reports it, metres.
    pub vpe_m: Option<f64>,
    /// One-sigma of the position along north, east, down, as the receiver reports it, metres.
    pub position_sigma_m: Option<Vector3<f64>>,
    /// One-sigma of the velocity along north, east, down, as the receiver reports it, m/s.
    pub velocity_sigma_mps: Option<Vector3<f64>>,
    /// Satellites used.
    pub sats: Option<u32>,
    /// Horizontal dilution of precision.
    pub hdop: Option<f64>,
}

/// One compass reading, radians, after evaluation of its error flags.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct AttitudeSample {
    /// Heading as the device reports it; `None` where its flags mark it as invalid.
    pub heading: Option<f64>,
    /// Whether the heading is already true (declination applied by the device).
    pub heading_is_true: bool,
    /// Pitch and roll as the device reports them; `None` where not valid.
    pub tilt: Option<Tilt>,
}

/// Rates of turn and specific forces. `None` where the device has no such sensors.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct InertialSample {
    /// Rate of turn about each axis, rad/s.
    pub rate_rps: Option<Vector3<f64>>,
    /// Specific force along each axis, m/s²: level and at rest (0, 0, −9.8) in forward-right-down.
    pub force_mps2: Option<Vector3<f64>>,
}

/// The helicopter's position in its autopilot's estimate, which the autopilot uses for flying.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct AutopilotPosition {
    /// Its time of validity, since the autopilot's start by its own clock.
    pub boot: Span,
    /// Latitude, degrees.
    pub lat_deg: f64,
    /// Longitude, degrees.
    pub lon_deg: f64,
    /// Altitude above mean sea level, metres.
    pub alt_msl_m: f64,
    /// Velocity north, east, down, m/s.
    pub vel_ned_mps: Vector3<f64>,
}

/// A decoded reading of a source.
#[expect(
    clippy::large_enum_variant,
    reason = "some hundred readings a second, moved from a list to the filter"
)]
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum SensorReading {
    /// From a GPS receiver.
    Gnss(Stamped<GnssEpoch>),
    /// From a compass.
    Attitude(Stamped<AttitudeSample>),
    /// From a second source of attitude.
    SecondAttitude(Stamped<AttitudeSample>),
    /// From gyros and accelerometers.
    Inertial(Stamped<InertialSample>),
    /// From an autopilot.
    Autopilot(Stamped<AutopilotPosition>),
}

/// The marker of a detection.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum MarkerId {
    /// A square tag.
    Tag {
        /// Its family.
        family: TagFamily,
        /// Its identity.
        id: u32,
    },
    /// A disc of the configuration, by target and marker index.
    Disc {
        /// Index of the target in the configuration.
        target: usize,
        /// Index of the marker in the target.
        marker: usize,
    },
}

/// A marker found in a frame. The centre of the top-left pixel is (0, 0).
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct MarkerDetection {
    /// Which marker.
    pub marker: MarkerId,
    /// The marker's centre: the intersection of a tag's diagonals, or a disc's centre (corrected for perspective).
    pub center_px: Vector2<f64>,
    /// Covariance of the centre, px².
    pub center_cov_px2: Matrix2<f64>,
    /// A tag's corners: top-left, top-right, bottom-right, bottom-left of the tag as AprilRobotics
    /// prints it. `None` for discs.
    pub corners_px: Option<[Vector2<f64>; 4]>,
    /// Covariance of each corner, px²; zero for discs.
    pub corner_cov_px2: [Matrix2<f64>; 4],
    /// Number of corrected bits.
    pub hamming: u8,
    /// Contrast between a tag's white and black cells at the weakest decision, grey levels.
    pub margin: f32,
    /// Apparent size: a tag's mean edge, a disc's mean diameter, pixels.
    pub size_px: f64,
}

/// A static ground feature followed from frame to frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FeatureTrack {
    /// The same number in every frame through which it is followed; never reused.
    pub id: u64,
    /// Its place in this frame.
    pub px: Vector2<f64>,
    /// One-sigma per axis, pixels.
    pub sigma_px: f64,
}

/// All detections of one frame.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct FrameObservations {
    /// Number of the frame.
    pub frame: u32,
    /// Markers.
    pub markers: Vec<MarkerDetection>,
    /// Ground features.
    pub features: Vec<FeatureTrack>,
}
