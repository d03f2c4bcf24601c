//! Windhover watches an unmanned ground vehicle from a small helicopter.
//!
//! A recorded or live stream of serial bytes and camera frames goes in; where the vehicle is, where
//! it points, how fast it drives and turns comes out, each with its covariance. `ARCHITECTURE.md`
//! tells how the parts fit.
//!
//! What is worth having alone are crates of their own (`crates/`). A module names only modules listed
//! above it here. Core (the crates, and modules up to `pipeline`) turns values into
//! values: it never reads a clock, logs, waits or touches a device. `io` moves events and records;
//! `app` wires; `cli` talks to people. `tests/architecture.rs` holds this.

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
