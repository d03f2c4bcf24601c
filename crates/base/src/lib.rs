//! What the crates of windhover have in common: time, frames and geodesy, the values that flow
//! between them, and the settings that they take.
//!
//! Nothing here reads a clock, waits, logs or touches a device.

#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

pub mod geo;
pub mod msg;
pub mod settings;
pub mod time;
