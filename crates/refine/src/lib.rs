#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod beginnings;
mod block;
mod dense;
mod initial;
mod felt;
mod frame;
mod front;
#[cfg(test)]
mod gtsam_tests;
#[cfg(test)]
mod jacobians;
mod covariance_pass;
mod measure;
mod motion;
mod noise;
mod plan;
mod problem;
mod recording;
mod refine;
mod roughness;
#[cfg(test)]
mod segments;
mod solve;
mod stamped;
mod surveyed;
mod result;
mod unknowns;
mod values;

pub use block::Source;
pub use recording::{OutsidePosition, Recording, SurveyedMarker};
pub use refine::{RefineError, refine};
pub use result::{ClockDifference, Constant, Outlier, Refined, Tally};
pub use unknowns::ConstantKind;
