#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod camera;
mod closed;
mod company;
mod compass;
mod compass_binary;
mod compass_wire;
mod deviation;
mod deviations;
mod flight;
mod follower;
mod garmin;
mod gnss;
mod guide;
mod helicopter;
mod instant;
mod lag;
mod line;
mod markers;
mod misfit;
mod ode;
mod random;
pub mod render;
mod rough;
mod scenario;
mod scenarios;
mod sensor_errors;
mod suite;
pub mod truth;
mod vehicle;
mod world;

pub use camera::{CameraPose, FrameTruth, MarkerTruth};
pub use closed::{ClosedFlight, Lateness};
pub use deviation::{Deviation, DeviationError, Effect};
pub use flight::{Flight, FlightError, FrameStorage, JpegEncoder};
pub use follower::{FollowTarget, Follower, FollowerTuning};

pub use instant::{OwnshipTruth, VehicleTruth};
pub use markers::corners_in_vehicle;
pub use misfit::{Company, Driving, GroundMisfit, MarkerMisfit, Misfit};
pub use random::{SmoothNoise, Stream};
pub use scenario::{Clock, Helicopter, HelicopterPath, Route, Scenario, Scene, SpeedPlan, VehiclePlan, Wind};
pub use sensor_errors::{CameraSim, CompassSim, GpsSim, HiddenMarker};
pub use suite::{Sample, SensorSuite};
pub use world::World;

#[cfg(test)]
mod misfit_tests;
#[cfg(test)]
mod tests;
