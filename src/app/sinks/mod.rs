//! The outputs: one file each, behind [`super::sink::Sink`].

mod card;
mod flight_file;
mod ground_link;
mod mavlink;
mod metrics;
mod video;

pub use card::CardSink;
pub use flight_file::FlightFile;
pub use ground_link::LinkSink;
pub use mavlink::MavlinkSink;
pub use metrics::{LatestHealth, MetricsSink};
pub use video::{VideoQueue, VideoSink};
