#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod block;
mod first;
mod front;
#[cfg(test)]
mod jacobians;
mod look;
mod measure;
mod motion;
mod noise;
mod plan;
mod problem;
mod recording;
mod refine;
mod solve;
mod told;
mod unknowns;
mod values;

pub use block::Source;
pub use recording::{OutsidePosition, Recording};
pub use refine::{RefineError, refine};
pub use told::{Constant, Outlier, Refined, Tally};
pub use unknowns::ConstantKind;
