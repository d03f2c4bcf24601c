//! Settings of the core: sections of the configuration as values, with their defaults.
//!
//! Angles are degrees here, as people write them; each user converts them. Ranges are checked where the whole
//! configuration is read.

mod autopilot;
mod camera;
mod estimator;
mod framing;
mod gpio;
mod inertial;
mod montecarlo;
mod rig;
mod sensors;
mod target;

pub use autopilot::{AutopilotConfig, AutopilotUse};
pub use camera::{CameraConfig, CameraMount, PixelFormat};
pub use estimator::{DetectorConfig, EstimatorConfig};
pub use framing::{Framing, Parity};
pub use gpio::GpioLine;
pub use inertial::{AttitudeConfig, ImuConfig};
pub use montecarlo::{Distribution, MonteCarloConfig};
pub use rig::{Rig, shares_line};
pub use sensors::{
    CompassConfig, CompassFormat, Datum, Declination, GpsConfig, GpsFormat, GroundConfig, GroundSource,
    TiltKind,
};
pub use target::{Brightness, MarkerConfig, MarkerKind, TargetConfig, TargetModel};
