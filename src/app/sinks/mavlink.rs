//! MAVLink's sink: the latest state of every vehicle, sent by a task at its own rate.

use crate::app::downlink::Downlink;
use crate::app::sink::Sink;
use windhover_base::msg::TimedOutput;

/// Passes to MAVLink the outputs that its messages need.
pub struct MavlinkSink(Downlink);

impl MavlinkSink {
    /// A sink into this link's MAVLink.
    pub fn new(downlink: Downlink) -> Self {
        Self(downlink)
    }
}

impl Sink for MavlinkSink {
    fn output(&mut self, output: &TimedOutput) {
        self.0.mavlink(&output.output);
    }
}
