//! Measurements of an autopilot over MAVLink.

mod autopilot;
mod frames;
#[cfg(test)]
mod tests;

pub use autopilot::{
    AutopilotDecoder, AutopilotMeasurement, ReceivedAutopilot, asked, is_autopilot, question,
};
pub use frames::{MavlinkFrame, MavlinkFrames};
