//! What is installed with the program: its configuration and its units.

mod shipped_config;
mod systemd;
