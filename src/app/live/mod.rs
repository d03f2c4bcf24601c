//! The closed loop: a simulated helicopter that follows the MAVLink messages of the real pipeline.
//!
//! [`LiveFlight`] runs in real time, with a daemon in its own process. [`ClosedLoop`] runs in lock-step on simulated
//! time, so the same scenario and seed give the same flight.

mod autopilot;
mod closed_loop;
mod devices;
mod real_time;
mod score;

pub use autopilot::{SimulatedAutopilot, follow_target};
pub use closed_loop::{ClosedLoop, LoopSettings, Moment};
pub use real_time::{LiveError, LiveFlight, LiveFolder};
pub use score::Score;
