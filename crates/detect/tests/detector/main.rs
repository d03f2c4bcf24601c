//! The detector on generated images: tags, discs, and what any image may hold.

mod bound;
mod common;
mod discs;
mod faults;
mod limit;
mod tags;
