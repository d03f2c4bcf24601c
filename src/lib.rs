//! Windhover watches an unmanned ground vehicle from a small helicopter.
//!
//! Input is a recorded or live stream of serial bytes and camera frames. Output is the vehicle's position, heading,
//! speed and yaw rate, each with its covariance. `ARCHITECTURE.md` describes how the parts fit together.
//!
//! Parts that are useful alone are separate crates (`crates/`). A module uses only modules that are listed above it
//! here. Core (the crates, and the modules down to `pipeline`) computes values from values: it never reads a clock,
//! logs, waits or touches a device. `io` moves events and records; `app` connects the parts; `cli` is the command line.
//! `tests/architecture.rs` checks this.

#![warn(
    missing_docs,
    clippy::unwrap_used,
    clippy::disallowed_methods,
    clippy::print_stdout,
    clippy::print_stderr
)]

// -- core: values in, values out
pub mod text;
pub mod config;
pub mod jpeg;
pub mod pixels;
pub mod plot;
pub mod pipeline;
// -- edge: devices, disk, network
pub mod io;
// -- wiring
pub mod app;
pub mod cli;
