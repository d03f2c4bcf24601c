//! Simulated flights: motion, sensors with their errors, serial sentences and camera frames.
//!
//! A [`Scenario`] says everything by figures; [`World`] is the truth at any time; [`SensorSuite`]
//! turns it into measurements as values (for Monte Carlo runs, without bytes or pixels).
//! Everything is seeded: the same scenario and seed give the same flight on any machine.

mod camera;
mod compass;
mod gnss;
mod helicopter;
mod markers;
mod ode;
mod random;
mod scenario;
mod scenarios;
mod suite;
mod vehicle;
mod world;

pub use camera::{CameraPose, FrameTruth, MarkerTruth};
pub use markers::corners_in_vehicle;
pub use random::{Stream, Wander};
pub use scenario::{
    CameraSim, Clock, CompassSim, GpsSim, Helicopter, HelicopterPath, HiddenMarker, Route, Scenario,
    SpeedPlan, VehiclePlan, Wind,
};
pub use suite::{Sample, SensorSuite};
pub use world::{OwnshipTruth, VehicleTruth, World};

#[cfg(test)]
mod tests;
