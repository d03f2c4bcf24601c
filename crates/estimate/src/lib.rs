#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

pub mod align;
mod aid;
mod anchor;
mod antenna;
pub mod batch;
mod begin;
mod blocks;
mod bound;
mod camera_clock;
mod coast;
mod consensus;
mod consider;
mod core;
mod delayed;
mod filter;
mod fit;
mod fitted;
mod force;
mod frame;
mod ground;
mod height;
mod inertial;
mod kind;
mod learn;
mod learn_vehicle;
mod matrix;
mod lens;
mod measurement;
mod models;
mod motion;
mod output;
mod own;
mod paper;
mod receiver_error;
mod resume;
mod senses;
mod shape;
mod shutter;
mod size_test;
mod slip;
mod slow;
mod sources;
mod spin;
mod standstill;
mod start;
mod state;
mod shake;
mod summary;
mod sway;
mod tag_fit;
mod track;
mod twins;
mod update;
mod vehicle_misfits;
#[cfg(test)]
mod jacobians;
#[cfg(test)]
mod tests;

pub use bound::{Bound, BoundTruth};
pub use filter::Estimator;
pub use paper::PaperEstimator;
pub use windhover_base::msg::EstimatorOutput;

use windhover_base::geo::{Ground, LocalFrame};

/// Where the flight takes place.
#[derive(Clone, Debug, PartialEq)]
pub struct Site {
    /// The NED frame everything is computed in.
    pub frame: LocalFrame,
    /// The ground in it.
    pub ground: Ground,
    /// Magnetic declination, radians, east positive.
    pub declination_rad: f64,
}
