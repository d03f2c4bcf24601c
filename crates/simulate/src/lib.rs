#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod camera;
mod compass;
mod compass_wire;
mod flight;
mod garmin;
mod gnss;
mod guide;
mod helicopter;
mod line;
mod markers;
mod ode;
mod random;
pub mod render;
mod scenario;
mod scenarios;
mod suite;
pub mod truth;
mod vehicle;
mod world;

pub use camera::{CameraPose, FrameTruth, MarkerTruth};
pub use flight::{Flight, FlightError, FrameStorage, JpegEncoder};
pub use markers::corners_in_vehicle;
pub use random::{Stream, Wander};
pub use scenario::{
    CameraSim, Clock, CompassSim, GpsSim, Helicopter, HelicopterPath, HiddenMarker, Route, Scenario, Scene,
    SpeedPlan, VehiclePlan, Wind,
};
pub use suite::{Sample, SensorSuite};
pub use world::{OwnshipTruth, VehicleTruth, World};

#[cfg(test)]
mod tests;
