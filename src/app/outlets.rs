//! Where events and outputs go beside the operator's log: the data card and the link.

use std::sync::Arc;

use crate::config::Config;
use crate::io::records::{DaemonFigures, Record, Recorder};
use windhover_base::msg::{Event, GnssEpoch, MarkerDetection, Output, Stamped};
use windhover_base::time::{MonoTime, UtcTime};

use super::card::Slot;
use super::downlink::Downlink;

/// The data card and the link, from the pipeline's side. Nothing here waits.
pub struct Outlets {
    slot: Slot,
    downlink: Downlink,
    recorder: Recorder,
    records: Vec<Record>,
    began: Option<MonoTime>,
    dated: bool,
    opened: bool,
}

impl Outlets {
    /// For a pipeline of this configuration.
    pub fn new(config: &Config, slot: Slot, downlink: Downlink) -> Self {
        Self {
            slot,
            downlink,
            recorder: Recorder::new(config),
            records: Vec::new(),
            began: None,
            dated: false,
            opened: false,
        }
    }

    /// The data card's place.
    pub fn slot(&self) -> &Slot {
        &self.slot
    }

    /// Keeps an event as it was heard.
    pub fn event(&mut self, event: &Event) {
        self.began.get_or_insert(event.t_recv);
        self.downlink.event(event);
        let Some(store) = self.slot.get() else {
            if std::mem::replace(&mut self.opened, false) {
                self.downlink.store_closed();
            }
            return;
        };
        // A flight opened anew begins with what every flight begins with, and wants its date again.
        if !std::mem::replace(&mut self.opened, true) {
            self.dated = false;
            for record in self.recorder.opening(event.t_recv) {
                store.record(Arc::new(record), None);
            }
        }
        store.event(event);
    }

    /// What the next health messages tell of the daemon.
    pub fn figures(&mut self, figures: DaemonFigures) {
        self.recorder.figures = figures;
    }

    /// Keeps and sends an output that followed from what was heard at `t`.
    pub fn output(&mut self, output: &Output, t: MonoTime) {
        self.downlink.output(output);
        self.recorder.output(output, t, &mut self.records);
        let store = self.slot.get();
        if let Some(store) = &store {
            match output {
                Output::Fix(epoch) => self.date(epoch, store),
                Output::Detections { markers, .. } => store.watch(pixels(markers)),
                _ => {}
            }
        }
        for record in self.records.drain(..) {
            // Sent first: the ground hears of it before the card does.
            let number = self.downlink.record(&record);
            if let Some(store) = &store {
                store.record(Arc::new(record), number);
            }
        }
    }

    /// The flight's name is the UTC of its start, as the receiver tells it.
    fn date(&mut self, epoch: &Stamped<GnssEpoch>, store: &crate::io::store::StoreHandle) {
        if let (false, Some(utc), Some(began)) = (self.dated, epoch.value.utc, self.began) {
            let start = UtcTime::from_unix_ns(utc.unix_ns() - (epoch.t_valid - began).ns());
            self.dated = store.set_start(start);
        }
    }
}

/// Pixels of everything seen of vehicles.
fn pixels(markers: &[MarkerDetection]) -> impl Iterator<Item = (f64, f64)> + '_ {
    markers.iter().flat_map(|marker| {
        let corners = marker.corners_px.unwrap_or([marker.center_px; 4]);
        corners.map(|corner| (corner.x, corner.y))
    })
}
