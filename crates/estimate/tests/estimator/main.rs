//! The estimator on simulated flights, as values: neither bytes nor pixels.

mod blind;
mod filter;
mod ground;
mod honesty;
mod jumps;
mod matrix;
mod misfit;
mod misfit_table;
mod ownship;
mod tags;
mod time;
mod vibration;
