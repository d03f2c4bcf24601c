//! What is installed with the program: its configuration, its units, its pages.

#[path = "../common/leave_out.rs"]
mod leave_out;
mod pages;
mod shipped_config;
mod systemd;
