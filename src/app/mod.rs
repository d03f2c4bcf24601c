//! Wiring: configuration files, the task graph, supervision, the operator log, reports.

pub mod config_file;
pub mod devices;
pub mod events;
pub mod health;
pub mod inbox;
pub mod log;
pub mod presence;
pub mod reload;
pub mod supervise;
