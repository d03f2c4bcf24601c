//! Measurements of an autopilot over MAVLink.

mod autopilot;
mod frames;
#[cfg(test)]
mod tests;

pub use autopilot::{AutopilotDecoder, AutopilotSaid, HeardAutopilot, asked, is_autopilot, question};
pub use frames::{MavlinkFrame, MavlinkFrames};
