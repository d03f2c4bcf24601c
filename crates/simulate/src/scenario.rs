//! Everything a simulated flight is made of, as figures.

use nalgebra::Vector3;

use windhover_base::geo::Geodetic;
use windhover_base::settings::{GroundConfig, Rig};
use windhover_base::time::MonoTime;

/// A flight to simulate. `rig` is what the pipeline is told; the rest is what really happens.
#[derive(Clone, PartialEq, Debug)]
pub struct Scenario {
    /// Its name on the command line.
    pub name: String,
    /// What it is for, in a line.
    pub about: String,
    /// Length, seconds.
    pub duration_s: f64,
    /// The instruments and targets as the pipeline is told of them. Latencies, mount, lever arms,
    /// markers and compass format are true to it except for the errors below.
    pub rig: Rig,
    /// Origin of the truth's NED frame: on the ground, height above the ellipsoid.
    pub origin: Geodetic,
    /// Geoid over ellipsoid there, metres.
    pub geoid_m: f64,
    /// Magnetic declination there, degrees, east positive.
    pub declination_deg: f64,
    /// Host time at which the flight starts.
    pub start: MonoTime,
    /// Host clock against UTC.
    pub clock: Clock,
    /// The helicopter.
    pub helicopter: Helicopter,
    /// The wind.
    pub wind: Wind,
    /// One plan for each target of the configuration.
    pub vehicles: Vec<VehiclePlan>,
    /// The GPS receiver's errors.
    pub gps: GpsSim,
    /// The compass's errors.
    pub compass: CompassSim,
    /// The camera's errors.
    pub camera: CameraSim,
    /// What the frames look like.
    pub scene: Scene,
}

impl Scenario {
    /// The ground's section of a configuration: level, at the height of the origin.
    pub fn ground(&self) -> GroundConfig {
        let elevation_msl_m = Some(self.origin.height_m - self.geoid_m);
        GroundConfig { elevation_msl_m, source: None, terrain: None }
    }
}

/// The host's clock against UTC: `host = utc + offset + drift · (utc − start)`.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Clock {
    /// Offset, ms.
    pub offset_ms: f64,
    /// Drift, parts per million.
    pub drift_ppm: f64,
}

/// How the helicopter flies. Its acceleration comes from thrust along −z of the body, gravity and
/// drag, so attitude and motion agree.
#[derive(Clone, PartialEq, Debug)]
pub struct Helicopter {
    /// Where it is sent.
    pub path: HelicopterPath,
    /// Height over the ground, metres.
    pub height_m: f64,
    /// Where its nose points, degrees; drawn at random where absent.
    pub heading_deg: Option<f64>,
    /// How far the nose wanders about it, degrees rms.
    pub heading_wander_deg: f64,
    /// Position feedback, 1/s².
    pub position_gain: f64,
    /// Velocity feedback, 1/s.
    pub velocity_gain: f64,
    /// Natural frequency with which attitude follows its command, rad/s.
    pub attitude_rate: f64,
    /// Restlessness of the pilot or controller, m/s² rms of commanded acceleration.
    pub agitation_mps2: f64,
    /// Largest horizontal acceleration asked for, m/s².
    pub limit_mps2: f64,
    /// Drag, 1/s: acceleration per m/s of air speed.
    pub drag_per_s: f64,
}

/// Where the helicopter is sent.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum HelicopterPath {
    /// Over a point.
    Hover {
        /// Metres north of the origin.
        north_m: f64,
        /// Metres east of the origin.
        east_m: f64,
    },
    /// Over a vehicle.
    Follow {
        /// Which.
        target: usize,
    },
    /// Around the origin.
    Circle {
        /// Radius, metres.
        radius_m: f64,
        /// Speed, m/s; negative turns left.
        speed_mps: f64,
    },
}

/// Wind at flying height.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Wind {
    /// Mean speed, m/s.
    pub mean_mps: f64,
    /// Where it blows to, degrees; drawn at random where absent.
    pub toward_deg: Option<f64>,
    /// Gusts, m/s rms an axis.
    pub gust_mps: f64,
}

/// How a vehicle is driven.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct VehiclePlan {
    /// Where it starts: metres north, metres east, heading in degrees (random where absent).
    pub start: (f64, f64, Option<f64>),
    /// How fast.
    pub speed: SpeedPlan,
    /// Where to.
    pub route: Route,
}

/// How fast a vehicle is driven; the drive follows with a smooth lag.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum SpeedPlan {
    /// It stands.
    Parked,
    /// It keeps going.
    Cruise {
        /// Mean speed, m/s.
        mean_mps: f64,
        /// Variation, m/s rms.
        wander_mps: f64,
    },
    /// It goes, stops, and, if asked, reverses and stops.
    StopAndGo {
        /// Speed ahead, m/s.
        speed_mps: f64,
        /// How long it goes each time, seconds.
        go_s: f64,
        /// How long it stands each time, seconds.
        stop_s: f64,
        /// Speed of the reversing legs, m/s; 0 for none.
        reverse_mps: f64,
    },
}

/// Where a vehicle is driven.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Route {
    /// Anywhere: the driver turns the wheel at random.
    Free {
        /// Path curvature, 1/m rms.
        curvature_per_m: f64,
    },
    /// Around a circle.
    Circle {
        /// Metres north of the centre.
        north_m: f64,
        /// Metres east of the centre.
        east_m: f64,
        /// Radius, metres; negative turns left.
        radius_m: f64,
    },
    /// A figure of eight about the origin: `(a sin θ, b sin 2θ)`.
    Eight {
        /// Half length north, metres.
        a_m: f64,
        /// Half width east, metres.
        b_m: f64,
    },
}

/// Errors of the GPS receiver.
#[derive(Clone, PartialEq, Debug)]
pub struct GpsSim {
    /// Fixes a second.
    pub rate_hz: f64,
    /// Slowly wandering error, metres one-sigma an axis, horizontally (first-order Gauss–Markov).
    pub bias_sigma_m: f64,
    /// Its correlation time, seconds.
    pub bias_tau_s: f64,
    /// White error, metres one-sigma an axis, horizontally.
    pub noise_m: f64,
    /// Vertical errors are this many times the horizontal ones.
    pub vertical_factor: f64,
    /// Velocity error, m/s one-sigma an axis.
    pub velocity_noise_mps: f64,
    /// The true latency lies this far around the configured one, ms (uniform, one draw a flight).
    pub latency_spread_ms: f64,
    /// Added to the latency on top, ms.
    pub latency_offset_ms: f64,
    /// Jitter of the arrival, ms one-sigma.
    pub jitter_ms: f64,
    /// What the fit of arrival times leaves of the jitter in a stamp, ms one-sigma (values only:
    /// with bytes, the fit itself does this).
    pub stamp_noise_ms: f64,
    /// Probability that an epoch is not sent at all.
    pub dropout: f64,
    /// From and to, seconds: no fix.
    pub outages_s: Vec<(f64, f64)>,
    /// Digits of velocity behind the point in `$PGRMV`.
    pub velocity_decimals: u32,
}

/// Errors of the compass.
#[derive(Clone, PartialEq, Debug)]
pub struct CompassSim {
    /// Samples a second.
    pub rate_hz: f64,
    /// Constant heading error, degrees one-sigma (one draw a flight).
    pub bias_sigma_deg: f64,
    /// Added to that, degrees.
    pub bias_offset_deg: f64,
    /// Heading noise, degrees one-sigma.
    pub heading_noise_deg: f64,
    /// Tilt noise, degrees one-sigma an axis.
    pub tilt_noise_deg: f64,
    /// How much of the true tilt it reads: 1 is perfect, 0.15 what an accelerometer sees on a
    /// rotorcraft (geometry of thrust: see ARCHITECTURE).
    pub tilt_gain: f64,
    /// Magnetic dip, degrees: where given, wrong tilt also enters the heading, as in a real
    /// tilt-compensated magnetic compass.
    pub dip_deg: Option<f64>,
    /// The true latency lies this far around the configured one, ms (uniform, one draw a flight).
    pub latency_spread_ms: f64,
    /// Added to the latency on top, ms.
    pub latency_offset_ms: f64,
    /// Jitter of the arrival, ms one-sigma.
    pub jitter_ms: f64,
    /// From and to, seconds: silent.
    pub outages_s: Vec<(f64, f64)>,
    /// Probability that a sample carries an error flag and no valid heading.
    pub flagged: f64,
}

/// Errors of the camera and of what is seen in its frames.
#[derive(Clone, PartialEq, Debug)]
pub struct CameraSim {
    /// Jitter of the exposure times, ms one-sigma.
    pub period_jitter_ms: f64,
    /// Error of the driver's stamp, ms one-sigma.
    pub stamp_noise_ms: f64,
    /// From exposure to dequeuing, ms.
    pub transfer_ms: f64,
    /// Jitter of that, ms one-sigma.
    pub transfer_jitter_ms: f64,
    /// Probability that a frame is lost.
    pub dropped: f64,
    /// From and to, seconds: no frames.
    pub outages_s: Vec<(f64, f64)>,
    /// Mounting error against the configured mount, degrees: yaw, pitch, roll.
    pub mount_error_deg: [f64; 3],
    /// Noise of a marker's corners (values only), pixels one-sigma an axis.
    pub marker_noise_px: f64,
    /// Probability that a marker in view is missed (values only).
    pub marker_missed: f64,
    /// Probability that a marker is grossly wrong, tens of pixels off (values only).
    pub marker_outlier: f64,
    /// Markers covered for a while.
    pub hidden: Vec<HiddenMarker>,
    /// Ground features followed (values only).
    pub features: usize,
    /// Noise of a ground feature (values only), pixels one-sigma an axis.
    pub feature_noise_px: f64,
    /// Mean time until a ground feature is lost though still in view (values only), seconds.
    pub feature_life_s: f64,
}

/// What the frames look like.
#[derive(Clone, PartialEq, Debug)]
pub struct Scene {
    /// Exposure time, ms: it smears what moves.
    pub exposure_ms: f64,
    /// Blur of the lens, pixels one-sigma.
    pub blur_px: f64,
    /// Noise of the sensor at mid grey, grey levels one-sigma.
    pub noise_levels: f64,
    /// Light lost in the frame's corners, as a share.
    pub vignetting: f64,
    /// Where the sun stands: azimuth and elevation, degrees.
    pub sun_deg: (f64, f64),
    /// Objects that lie about on 100 m² of ground.
    pub objects: f64,
    /// Bands of shadow across the ground, this many metres from one to the next.
    pub shadow_bands_m: Option<f64>,
    /// At this time, seconds, the picture becomes this many times brighter.
    pub light_change: Option<(f64, f64)>,
}

/// A marker covered for a while.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct HiddenMarker {
    /// Which target.
    pub target: usize,
    /// Which of its markers.
    pub marker: usize,
    /// From, seconds.
    pub from_s: f64,
    /// To, seconds.
    pub to_s: f64,
    /// Share of it that is covered, from its right: 1 is all of it.
    pub share: f64,
}

impl Default for Clock {
    fn default() -> Self {
        Self { offset_ms: 137.0, drift_ppm: 8.0 }
    }
}

impl Default for Helicopter {
    fn default() -> Self {
        Self {
            path: HelicopterPath::Hover { north_m: 0.0, east_m: 0.0 },
            height_m: 15.0,
            heading_deg: None,
            heading_wander_deg: 10.0,
            position_gain: 0.6,
            velocity_gain: 1.3,
            attitude_rate: 6.0,
            agitation_mps2: 0.25,
            limit_mps2: 4.0,
            drag_per_s: 0.2,
        }
    }
}

impl Default for Wind {
    fn default() -> Self {
        Self { mean_mps: 3.0, toward_deg: None, gust_mps: 0.8 }
    }
}

impl Default for GpsSim {
    fn default() -> Self {
        Self {
            rate_hz: 5.0,
            bias_sigma_m: 1.5,
            bias_tau_s: 100.0,
            noise_m: 0.15,
            vertical_factor: 1.5,
            velocity_noise_mps: 0.05,
            latency_spread_ms: 25.0,
            latency_offset_ms: 0.0,
            jitter_ms: 4.0,
            stamp_noise_ms: 1.0,
            dropout: 0.002,
            outages_s: Vec::new(),
            velocity_decimals: 2,
        }
    }
}

impl Default for CompassSim {
    fn default() -> Self {
        Self {
            rate_hz: 30.0,
            bias_sigma_deg: 1.0,
            bias_offset_deg: 0.0,
            heading_noise_deg: 0.5,
            tilt_noise_deg: 0.3,
            tilt_gain: 1.0,
            dip_deg: None,
            latency_spread_ms: 4.0,
            latency_offset_ms: 0.0,
            jitter_ms: 0.7,
            outages_s: Vec::new(),
            flagged: 0.0,
        }
    }
}

impl Default for CameraSim {
    fn default() -> Self {
        Self {
            period_jitter_ms: 0.5,
            stamp_noise_ms: 0.05,
            transfer_ms: 45.0,
            transfer_jitter_ms: 3.0,
            dropped: 0.005,
            outages_s: Vec::new(),
            mount_error_deg: [0.0; 3],
            marker_noise_px: 0.5,
            marker_missed: 0.0,
            marker_outlier: 0.0,
            hidden: Vec::new(),
            features: 8,
            feature_noise_px: 0.5,
            feature_life_s: 10.0,
        }
    }
}

impl Default for Scene {
    fn default() -> Self {
        Self {
            exposure_ms: 3.0,
            blur_px: 0.4,
            noise_levels: 2.0,
            vignetting: 0.2,
            sun_deg: (140.0, 50.0),
            objects: 12.0,
            shadow_bands_m: None,
            light_change: None,
        }
    }
}

/// Whether `t_s` lies in one of the windows.
pub(super) fn within(windows_s: &[(f64, f64)], t_s: f64) -> bool {
    windows_s.iter().any(|(from, to)| (*from..*to).contains(&t_s))
}

/// A vector of the configuration.
pub(super) fn vector(figures: [f64; 3]) -> Vector3<f64> {
    Vector3::from(figures)
}
