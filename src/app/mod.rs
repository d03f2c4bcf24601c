//! Wiring: configuration files, the task graph, supervision, the operator log, reports.

pub mod config_file;
pub mod devices;
pub mod events;
pub mod flight;
pub mod health;
pub mod inbox;
pub mod log;
pub mod presence;
pub mod reload;
pub mod report;
pub mod supervise;
pub mod truth;
pub mod export;
pub mod replay;
