//! Measurements kept in order of the time at which they were true, whatever the order they came in.

mod history;

pub use history::{Entry, History, Stamp};
