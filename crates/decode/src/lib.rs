//! Serial framing, NMEA, Garmin sentences, compass formats.
//!
//! Bytes of one read go in with the time the read returned; epochs and attitude samples come out.
//! Nothing here fails: what cannot be used is counted in [`DecodeCounts`], and the decoders are in
//! step again with the next sound sentence.

#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod burst;
mod compass;
#[cfg(test)]
mod compass_tests;
mod compass_text;
mod counts;
mod epoch;
mod frame;
mod garmin;
mod gnss;
#[cfg(test)]
mod gnss_tests;
mod pni;
mod report;
mod sentence;
mod standard;

pub use compass::{CompassDecoder, CompassReading, HeardAttitude};
pub use counts::{DecodeCounts, Refusal};
pub use gnss::{GnssDecoder, HeardEpoch};
pub use sentence::{Sentence, framed};
