//! What is installed with the program: its configuration and its units.

#[path = "../common/leave_out.rs"]
mod leave_out;
mod shipped_config;
mod systemd;
