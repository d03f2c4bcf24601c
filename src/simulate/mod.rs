//! Simulated flights: motion, sensors, rendered frames.
