//! The table of the daemon's outputs.

use crate::config::Config;
use crate::io::records::OutputEncoder;

use super::downlink::Downlink;
use super::flight_store::FlightStore;
use super::sink::{Outlets, Sink};
use super::sinks::{CardSink, LatestHealth, LinkSink, MavlinkSink, MetricsSink, VideoQueue, VideoSink};

/// The daemon's sinks, one for each row. The link comes before the card: the ground gets a record before the card does,
/// and the card keeps it under the number that the link assigned.
pub fn of_daemon(
    config: &Config,
    flight_store: &FlightStore,
    downlink: &Downlink,
    metrics: &LatestHealth,
    video: &VideoQueue,
) -> Outlets<Box<dyn Sink>> {
    let mut sinks: Vec<Box<dyn Sink>> = vec![
        Box::new(LinkSink::new(downlink.clone())),
        Box::new(MavlinkSink::new(downlink.clone())),
        Box::new(CardSink::new(config.camera.clone(), flight_store.clone(), downlink.clone())),
    ];
    if config.daemon.metrics.is_some() {
        sinks.push(Box::new(MetricsSink::new(metrics.clone())));
    }
    if config.video.is_on() {
        sinks.push(Box::new(VideoSink::new(video.clone(), config.video.rate_hz)));
    }
    Outlets::new(OutputEncoder::new(&config.target), sinks)
}
