#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

pub mod align;
mod anchor;
mod begin;
mod bound;
mod core;
mod filter;
mod learn;
mod matrix;
mod models;
mod motion;
mod output;
mod ownship;
mod paper;
mod shape;
mod state;
mod track;
mod update;
mod vision;
mod warm;
#[cfg(test)]
mod jacobians;
#[cfg(test)]
mod tests;

pub use bound::{Bound, BoundTruth};
pub use filter::{Estimator, EstimatorOutput};
pub use paper::PaperEstimator;

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
