#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod assembler;
mod burst;
mod calendar;
mod compass;
mod counts;
mod epoch;
mod garmin;
mod gnss;
#[cfg(test)]
mod gnss_tests;
mod lines;
mod mavlink;
mod report;
mod sentence;
mod standard;
mod ubx;
#[cfg(test)]
mod ubx_tests;

pub use compass::{CompassDecoder, CompassReading, ReceivedAttitude};
pub use counts::{DecodeCounts, Refusal};
pub use gnss::{GnssDecoder, ReceivedEpoch};
pub use mavlink::{
    AutopilotDecoder, AutopilotMeasurement, MavlinkFrame, MavlinkFrames, ReceivedAutopilot,
    asked as timesync_asked, is_autopilot, question as timesync_question,
};
pub use sentence::{Sentence, framed};
pub use ubx::{ubx_framed, ubx_packets};
