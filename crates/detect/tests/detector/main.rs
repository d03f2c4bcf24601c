//! The detector on generated images: tags, discs, and arbitrary content.

mod bound;
mod common;
mod discs;
mod faults;
mod limit;
mod tags;
