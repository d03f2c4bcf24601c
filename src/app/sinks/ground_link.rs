//! The link's sink: records to ground stations, frames for thumbnails.

use crate::app::downlink::Downlink;
use crate::app::sink::{OutgoingRecord, Sink};
use windhover_base::msg::{Event, TimedOutput};

/// Passes records to the link, and stores the numbers under which stations know them.
pub struct LinkSink(Downlink);

impl LinkSink {
    /// A sink into this link.
    pub fn new(downlink: Downlink) -> Self {
        Self(downlink)
    }
}

impl Sink for LinkSink {
    fn event(&mut self, event: &Event) {
        self.0.event(event);
    }

    fn output(&mut self, output: &TimedOutput) {
        self.0.picture(&output.output);
    }

    fn record(&mut self, record: &mut OutgoingRecord) {
        record.number = self.0.record(&record.record);
    }
}
