//! Wiring: configuration files, the task graph, supervision, the operator log, reports.

pub mod config_file;
pub mod events;
pub mod health;
pub mod inbox;
pub mod log;
