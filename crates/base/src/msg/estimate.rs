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
    /// Heading of the second source of attitude.
    AttitudeHeading,
    /// Tilt of the second source of attitude.
    AttitudeTilt,
    /// Rates of turn.
    ImuRate,
    /// Specific forces.
    ImuForce,
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
            Self::AttitudeHeading => "attitude_heading",
            Self::AttitudeTilt => "attitude_tilt",
            Self::ImuRate => "imu_rate",
            Self::ImuForce => "imu_force",
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
    /// Number of the frame at whose exposure it is; `None` between frames.
    pub frame: Option<u32>,
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
    /// Covariance of position (north, east, down; m), velocity (likewise; m/s) and attitude (small rotations about
    /// north, east, down: `ned_from_body = exp(δ) estimate`; rad).
    pub covariance: SMatrix<f64, 9, 9>,
}

impl Ownship {
    /// One-sigma of position (north, east, down), metres.
    pub fn position_sigma_m(&self) -> Vector3<f64> {
        self.sigma(0)
    }

    /// One-sigma of velocity (north, east, down), m/s.
    pub fn velocity_sigma_mps(&self) -> Vector3<f64> {
        self.sigma(3)
    }

    /// One-sigma of attitude as small rotations about north, east, down, radians.
    pub fn attitude_sigma_rad(&self) -> Vector3<f64> {
        self.sigma(6)
    }

    fn sigma(&self, first: usize) -> Vector3<f64> {
        Vector3::from_fn(|i, _| self.covariance[(first + i, first + i)].max(0.0).sqrt())
    }
}

/// What a tilt sensor is found to feel.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum FeltTilt {
    /// Attitude, as an AHRS tells it.
    Attitude,
    /// Specific force.
    Force,
    /// A share of the tilt.
    Share(f64),
}

/// Something measured does not fit what the configuration, or the filter's model, says of it.
///
/// The filter tells it as often as it finds it, at most once a second for the same source and cause. The pipeline
/// tells the operator once, again where the figure changes, and counts it as over when it was not told for a while.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Misfit {
    /// When it was found, host time.
    pub t: MonoTime,
    /// Which source.
    pub source: FusionSource,
    /// The figure that shows it; see [`MisfitCause`].
    pub figure: f64,
    /// What does not fit.
    pub cause: MisfitCause,
}

/// What does not fit.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum MisfitCause {
    /// The tilt sensor feels something else than configured. Figure: slope of acceleration over what the reading
    /// means, 1 where it tells the tilt.
    TiltKind(FeltTilt),
    /// It errs more than it is said to. Figure: mean normalised square of its innovations, 1 where they fit.
    Noise,
    /// It errs to one side. Figure: mean of its innovations over what they should scatter by.
    Bias,
    /// More of its measurements lie outside the gate than should. Figure: their share.
    Outside,
    /// A tag's edge is not its `size_m`, as another marker of the target shows. Figure: measured over configured.
    MarkerSize(MarkerPair),
    /// A marker lies elsewhere on its target, as another one shows. Figure: by how much, m.
    MarkerPlace(MarkerPair),
    /// A marker is turned on its target, as another one shows. Figure: by how much, rad, clockwise from above.
    MarkerTurn(MarkerPair),
    /// Markers show another height over the ground than receiver and ground do. Figure: by how much higher, m.
    Height,
    /// What was taken for ground moves. Figure: share of the tracked features.
    MovingGround,
    /// A vehicle turns faster than its model can. Figure: its yaw rate over the model's bound.
    TargetTurns {
        /// Index of the target in the configuration.
        target: usize,
    },
    /// The body of a vehicle sways on its springs. Figure: standard deviation of its markers' displacement, m.
    TargetSways {
        /// Index of the target in the configuration.
        target: usize,
    },
    /// A vehicle slides across its heading. Figure: the walk of its side slip over `slip_mps`.
    TargetSlides {
        /// Index of the target in the configuration.
        target: usize,
    },
    /// The receiver's slow error wanders farther than configured. Figure: how many times as far.
    Wanders,
    /// The receiver's antenna is elsewhere than configured. Figure: by how much, m.
    AntennaPlace,
    /// Its measurements are true earlier than their stamps say. Figure: by how much, s.
    Late,
}

/// A marker that does not fit, and the one that shows it: indices in the configuration.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct MarkerPair {
    /// The target.
    pub target: usize,
    /// Its marker that does not fit.
    pub marker: usize,
    /// Its marker that it was measured against.
    pub against: usize,
}

/// What the joint filter says.
#[expect(clippy::large_enum_variant, reason = "a box would be an allocation for each of them")]
#[derive(Clone, PartialEq, Debug)]
pub enum EstimatorOutput {
    /// A target at a frame, as known when the frame had been looked at.
    Estimate(TargetEstimate),
    /// A target at a tick, while no frame comes: predicted, and lost in its time. `frame` is that of the last estimate.
    Coasted(TargetEstimate),
    /// A target at an earlier frame, with what was measured up to the smoother's lag after it.
    Smoothed(TargetEstimate),
    /// The helicopter at a frame, or between frames.
    Ownship(Ownship),
    /// What became of a measurement.
    Fusion(FusionResult),
    /// The receiver jumped for good: helicopter, targets and ground features moved along.
    Anchored {
        /// By how much, NED.
        moved_m: Vector3<f64>,
    },
    /// What the tilt sensor feels was found out, and is believed from here on.
    TiltFelt {
        /// What it feels.
        felt: FeltTilt,
        /// Slope of acceleration over what the reading means.
        slope: f64,
    },
    /// Something measured does not fit.
    Misfit(Misfit),
    /// The filter started again.
    Reset {
        /// Why.
        reason: &'static str,
    },
}
