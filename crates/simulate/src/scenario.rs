//! Everything in a simulated flight, as numbers.

use nalgebra::Vector3;

use super::misfit::Misfit;
use super::sensor_errors::{CameraSim, CompassSim, GpsSim};
use windhover_base::geo::Geodetic;
use windhover_base::settings::Rig;
use windhover_base::time::MonoTime;

/// A flight to simulate. `rig` is what the pipeline gets and, except for `misfit`, the truth; the other fields are the
/// truth.
#[derive(Clone, PartialEq, Debug)]
pub struct Scenario {
    /// Its name on the command line.
    pub name: String,
    /// Its purpose, in one line.
    pub about: String,
    /// Length, seconds.
    pub duration_s: f64,
    /// The instruments and targets in the pipeline's configuration. Latencies, mount, lever arms, markers and compass
    /// format are true except for the errors below.
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
    /// Appearance of the frames.
    pub scene: Scene,
    /// How the flight differs from `rig`.
    pub misfit: Misfit,
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
    /// Its path.
    pub path: HelicopterPath,
    /// Height over the ground, metres.
    pub height_m: f64,
    /// Heading of the nose, degrees; random where absent.
    pub heading_deg: Option<f64>,
    /// Variation of the heading, degrees rms.
    pub heading_wander_deg: f64,
    /// Position feedback, 1/s².
    pub position_gain: f64,
    /// Velocity feedback, 1/s.
    pub velocity_gain: f64,
    /// Natural frequency with which attitude follows its command, rad/s.
    pub attitude_rate: f64,
    /// Unsteadiness of the pilot or controller, m/s² rms of commanded acceleration.
    pub agitation_mps2: f64,
    /// Largest demanded horizontal acceleration, m/s².
    pub limit_mps2: f64,
    /// Drag, 1/s: acceleration per m/s of air speed.
    pub drag_per_s: f64,
    /// Angle between the rotor's axis and the body's, degrees, in a direction drawn at random.
    pub trim_deg: f64,
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
    /// To and fro about the origin, north and, 1.37 times as often, east.
    Weave {
        /// How far to each side, metres.
        reach_m: f64,
        /// Time there and back north, seconds.
        period_s: f64,
    },
    /// To and fro along the meridian of the origin.
    Dash {
        /// How far to each side, metres.
        reach_m: f64,
        /// Highest speed, m/s.
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
    /// It stands, then goes.
    FromRest {
        /// When it goes, seconds.
        rest_s: f64,
        /// How fast, m/s.
        speed_mps: f64,
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
            trim_deg: 0.0,
        }
    }
}

impl Default for Wind {
    fn default() -> Self {
        Self { mean_mps: 3.0, toward_deg: None, gust_mps: 0.8 }
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
