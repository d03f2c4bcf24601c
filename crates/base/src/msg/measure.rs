//! Measurements: decoded, stamped with the time at which they were true.

use nalgebra::{Matrix2, Vector2, Vector3};

use crate::geo::Tilt;
use crate::msg::TagFamily;
use crate::time::{MonoTime, Span, UtcTime};

/// A value with when it was true and when it was heard, both host time.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Stamped<T> {
    /// When it was true.
    pub t_valid: MonoTime,
    /// When it was heard.
    pub t_recv: MonoTime,
    /// Position in the stream of events.
    pub seq: u64,
    /// The value.
    pub value: T,
}

/// What kind of fix a receiver reports; each says more than the one before.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug, Default)]
pub enum FixKind {
    /// No position.
    #[default]
    None,
    /// Position without height.
    TwoD,
    /// Position and height.
    ThreeD,
    /// Position and height, from carrier phases of unknown whole cycles (GGA quality 5): decimetres.
    RtkFloat,
    /// Position and height, from carrier phases of known whole cycles (GGA quality 4): centimetres.
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

    /// `none`, `2d` or `3d`, as logs and files tell it: RTK is `3d`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::TwoD => "2d",
            Self::ThreeD | Self::RtkFloat | Self::RtkFixed => "3d",
        }
    }
}

/// Everything a receiver said of one instant. `None` where it did not say.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct GnssEpoch {
    /// UTC with its date; `None` until the receiver told a date.
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
    /// Velocity north, east, down, m/s; down is 0 and means nothing unless `vel_has_down`.
    pub vel_ned_mps: Option<Vector3<f64>>,
    /// Whether the down component of `vel_ned_mps` was measured (PGRMV) or is not known (RMC, VTG).
    pub vel_has_down: bool,
    /// Horizontal position error as the receiver puts it, metres.
    pub hpe_m: Option<f64>,
    /// Vertical position error as the receiver puts it, metres.
    pub vpe_m: Option<f64>,
    /// One-sigma of the position along north, east, down, as the receiver puts it, metres.
    pub position_sigma_m: Option<Vector3<f64>>,
    /// One-sigma of the velocity along north, east, down, as the receiver puts it, m/s.
    pub velocity_sigma_mps: Option<Vector3<f64>>,
    /// Satellites used.
    pub sats: Option<u32>,
    /// Horizontal dilution of precision.
    pub hdop: Option<f64>,
}

/// One compass reading, radians, with its error flags already honoured.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct AttitudeSample {
    /// Heading as the device reports it; `None` where its flags say it is not valid.
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

/// Where the helicopter's autopilot takes it to be: what it flies by.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct AutopilotPosition {
    /// When it was true, since the autopilot's start by its own clock.
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

/// What a source's bytes were decoded to.
#[expect(
    clippy::large_enum_variant,
    reason = "some hundred readings a second, moved from a list to the filter"
)]
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum SensorReading {
    /// Of a GPS receiver.
    Gnss(Stamped<GnssEpoch>),
    /// Of a compass.
    Attitude(Stamped<AttitudeSample>),
    /// Of a second source of attitude.
    SecondAttitude(Stamped<AttitudeSample>),
    /// Of gyros and accelerometers.
    Inertial(Stamped<InertialSample>),
    /// Of an autopilot.
    Autopilot(Stamped<AutopilotPosition>),
}

/// Which marker a detection is of.
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
    /// Where the marker's centre is: the intersection of a tag's diagonals, or a disc's centre
    /// (corrected for perspective).
    pub center_px: Vector2<f64>,
    /// Covariance of the centre, px².
    pub center_cov_px2: Matrix2<f64>,
    /// A tag's corners: top-left, top-right, bottom-right, bottom-left of the tag as AprilRobotics
    /// prints it. `None` for discs.
    pub corners_px: Option<[Vector2<f64>; 4]>,
    /// Covariance of each corner, px²; zero for discs.
    pub corner_cov_px2: [Matrix2<f64>; 4],
    /// Wrong bits corrected.
    pub hamming: u8,
    /// Contrast between a tag's white and black cells at the weakest decision, grey levels.
    pub margin: f32,
    /// Apparent size: a tag's mean edge, a disc's mean diameter, pixels.
    pub size_px: f64,
}

/// A static ground feature followed from frame to frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FeatureTrack {
    /// The same number in every frame it is followed through; never used again.
    pub id: u64,
    /// Where it is in this frame.
    pub px: Vector2<f64>,
    /// One-sigma per axis, pixels.
    pub sigma_px: f64,
}

/// Everything seen in one frame.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct FrameObservations {
    /// Number of the frame.
    pub frame: u32,
    /// Markers.
    pub markers: Vec<MarkerDetection>,
    /// Ground features.
    pub features: Vec<FeatureTrack>,
}
