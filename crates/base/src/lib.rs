#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

pub mod geo;
pub mod msg;
pub mod settings;
pub mod time;
