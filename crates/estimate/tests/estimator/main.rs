//! The estimator on simulated flights, as values: neither bytes nor pixels.

mod filter;
mod ground;
mod honesty;
mod ownship;
