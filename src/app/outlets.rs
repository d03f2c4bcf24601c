//! The table of the daemon's outputs.

use crate::config::Config;
use crate::io::records::OutputEncoder;

use super::downlink::Downlink;
use super::flight_store::FlightStore;
use super::sink::{Outlets, Sink};
use super::sinks::{CardSink, LinkSink, MavlinkSink};

/// The daemon's sinks, one row each. The link stands before the card: the ground gets a record before the card
/// does, and the card keeps it under the number that the link gave it.
pub fn of_daemon(config: &Config, flight_store: &FlightStore, downlink: &Downlink) -> Outlets<Box<dyn Sink>> {
    let sinks: Vec<Box<dyn Sink>> = vec![
        Box::new(LinkSink::new(downlink.clone())),
        Box::new(MavlinkSink::new(downlink.clone())),
        Box::new(CardSink::new(config.camera.clone(), flight_store.clone(), downlink.clone())),
    ];
    Outlets::new(OutputEncoder::new(&config.target), sinks)
}
