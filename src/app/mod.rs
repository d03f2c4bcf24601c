//! Wiring: configuration files, the task graph, supervision, the operator log, reports.

pub mod brain;
pub mod card;
pub mod config_file;
pub mod declination;
pub mod devices;
pub mod downlink;
pub mod events;
pub mod export;
pub mod flight;
pub mod geopositions;
pub mod ground;
pub mod health;
pub mod import;
pub mod inbox;
pub mod latencies;
pub mod log;
pub mod outlets;
pub mod presence;
pub mod reload;
pub mod recording;
pub mod replay;
pub mod report;
pub mod run;
pub mod supervise;
pub mod topology;
pub mod truth;
mod watch;
