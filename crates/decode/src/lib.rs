#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod burst;
mod calendar;
mod compass;
mod counts;
mod epoch;
mod lines;
mod garmin;
mod gnss;
#[cfg(test)]
mod gnss_tests;
mod report;
mod sentence;
mod standard;
mod ubx;
#[cfg(test)]
mod ubx_tests;

pub use compass::{CompassDecoder, CompassReading, HeardAttitude};
pub use counts::{DecodeCounts, Refusal};
pub use gnss::{GnssDecoder, HeardEpoch};
pub use sentence::{Sentence, framed};
pub use ubx::{holds_ubx_packet, ubx_framed};
