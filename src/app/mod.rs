//! Wiring: configuration files, the task graph, supervision, the operator log, reports.

pub mod config_file;
