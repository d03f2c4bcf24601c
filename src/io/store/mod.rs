//! Flights on the data card: append-only MCAP segments, and beside them what can be rebuilt.
//!
//! `docs/storage.md` tells the layout and what is guaranteed.

pub mod flight;
pub mod format;
pub mod journal;
pub mod record;
pub mod scan;
pub mod seal;
#[cfg(test)]
mod seal_tests;
pub mod segment;
pub mod summary;
pub mod volume;
