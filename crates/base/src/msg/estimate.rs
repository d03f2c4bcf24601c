//! Estimates, and what became of each measurement.

use nalgebra::{SMatrix, UnitQuaternion, Vector3};

use crate::time::MonoTime;

/// What became of a measurement.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Disposition {
    /// Used as it is.
    Fused,
    /// Used with its weight reduced by the soft gate.
    Deweighted,
    /// Refused by the gate.
    GateRejected,
    /// True before the history begins.
    TooOld,
    /// True later than it was heard.
    TooNew,
    /// The helicopter's own state is not known yet.
    NoOwnship,
    /// Not a finite number, or outside what can be.
    Invalid,
    /// Belongs to no target of the configuration.
    Unknown,
}

impl Disposition {
    /// Its name in logs and files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fused => "fused",
            Self::Deweighted => "deweighted",
            Self::GateRejected => "gate_rejected",
            Self::TooOld => "too_old",
            Self::TooNew => "too_new",
            Self::NoOwnship => "no_ownship",
            Self::Invalid => "invalid",
            Self::Unknown => "unknown",
        }
    }
}

/// Which measurement a [`FusionResult`] is about.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum FusionSource {
    /// GPS position.
    GpsPosition,
    /// GPS velocity.
    GpsVelocity,
    /// Compass heading.
    CompassHeading,
    /// Compass tilt.
    CompassTilt,
    /// A marker's pixels.
    Marker,
    /// A ground feature's pixel.
    Feature,
}

impl FusionSource {
    /// Its name in logs and files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::GpsPosition => "gps_position",
            Self::GpsVelocity => "gps_velocity",
            Self::CompassHeading => "compass_heading",
            Self::CompassTilt => "compass_tilt",
            Self::Marker => "marker",
            Self::Feature => "feature",
        }
    }
}

/// What became of one measurement in the filter.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FusionResult {
    /// When the measurement was true.
    pub t_valid: MonoTime,
    /// Which measurement.
    pub source: FusionSource,
    /// What became of it.
    pub disposition: Disposition,
    /// Innovation, first three components, in the measurement's unit (m, m/s, rad, px).
    pub innovation: [f64; 3],
    /// How many components `innovation` has (at most three are kept).
    pub dimension: usize,
    /// Normalised innovation squared over the gate: above 1 is outside.
    pub test_ratio: f64,
}

/// What the filter holds of a track.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default)]
pub enum TrackStatus {
    /// Seen, not yet settled.
    Acquiring,
    /// Seen and settled.
    Tracking,
    /// Not seen for a moment; predicted.
    Coasting,
    /// Not known.
    #[default]
    Lost,
}

impl TrackStatus {
    /// Its name in logs and files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Acquiring => "acquiring",
            Self::Tracking => "tracking",
            Self::Coasting => "coasting",
            Self::Lost => "lost",
        }
    }
}

/// A vehicle's state at its reference point.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TargetState {
    /// North of the datum, metres.
    pub north_m: f64,
    /// East of the datum, metres.
    pub east_m: f64,
    /// Heading from true north, radians in (−π, π].
    pub heading_rad: f64,
    /// Signed speed of the rear axle, m/s.
    pub speed_mps: f64,
    /// Yaw rate, rad/s, clockwise from above positive.
    pub yaw_rate_radps: f64,
    /// Latitude of the reference point, degrees.
    pub lat_deg: f64,
    /// Longitude of the reference point, degrees.
    pub lon_deg: f64,
    /// Height of the ground under it above the ellipsoid, metres.
    pub height_m: f64,
    /// Covariance of (north, east, heading, speed, yaw rate); `None` from the paper's estimator.
    pub covariance: Option<SMatrix<f64, 5, 5>>,
    /// One-sigma of the horizontal position relative to the helicopter, larger axis, metres; `None` where the
    /// estimator does not tell it (the smoother's and the paper's do not).
    pub relative_sigma_m: Option<f64>,
}

/// A target's estimate at one frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TargetEstimate {
    /// Exposure time of the frame.
    pub t_valid: MonoTime,
    /// Number of the frame.
    pub frame: u32,
    /// Index of the target in the configuration.
    pub target: usize,
    /// What the filter holds of it.
    pub status: TrackStatus,
    /// The state; `None` where nothing is known.
    pub state: Option<TargetState>,
}

/// The helicopter's own state: the body frame's origin.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Ownship {
    /// When.
    pub t_valid: MonoTime,
    /// Number of the frame it belongs to.
    pub frame: u32,
    /// North, east, down of the datum, metres.
    pub position_ned_m: Vector3<f64>,
    /// Velocity north, east, down, m/s.
    pub velocity_ned_mps: Vector3<f64>,
    /// Attitude.
    pub ned_from_body: UnitQuaternion<f64>,
    /// Latitude, degrees.
    pub lat_deg: f64,
    /// Longitude, degrees.
    pub lon_deg: f64,
    /// Height above the ellipsoid, metres.
    pub height_m: f64,
    /// One-sigma of position (north, east, down), metres.
    pub position_sigma_m: Vector3<f64>,
    /// One-sigma of attitude as small rotations about north, east, down, radians.
    pub attitude_sigma_rad: Vector3<f64>,
}

/// What the joint filter says.
#[derive(Clone, PartialEq, Debug)]
pub enum EstimatorOutput {
    /// A target at a frame, as known when the frame had been looked at.
    Estimate(TargetEstimate),
    /// A target at a tick, while no frame comes: predicted, and lost in its time. `frame` is that of the last estimate.
    Coasted(TargetEstimate),
    /// A target at an earlier frame, with what was measured up to the smoother's lag after it.
    Smoothed(TargetEstimate),
    /// The helicopter at a frame.
    Ownship(Ownship),
    /// What became of a measurement.
    Fusion(FusionResult),
    /// The receiver jumped for good: helicopter, targets and ground features moved along.
    Anchored {
        /// By how much, NED.
        moved_m: Vector3<f64>,
    },
    /// The filter started again.
    Reset {
        /// Why.
        reason: &'static str,
    },
}
