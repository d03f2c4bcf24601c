//! The data card's sink: events as they arrived, records, the flight's date, places of the vehicles in the image.

use std::sync::Arc;

use crate::app::downlink::Downlink;
use crate::app::flight_store::FlightStore;
use crate::app::sink::{OutgoingRecord, Sink};
use crate::io::records;
use crate::io::store::StoreHandle;
use windhover_base::msg::{Event, GnssEpoch, MarkerDetection, Output, SensorReading, Stamped, TimedOutput};
use windhover_base::settings::CameraConfig;
use windhover_base::time::{MonoTime, UtcTime};

/// Stores everything on the data card, while there is one.
pub struct CardSink {
    camera: CameraConfig,
    flight_store: FlightStore,
    downlink: Downlink,
    began: Option<MonoTime>,
    dated: bool,
    opened: bool,
}

impl CardSink {
    /// A sink into this store. It reports to the link when its flight is closed.
    pub fn new(camera: CameraConfig, flight_store: FlightStore, downlink: Downlink) -> Self {
        Self { camera, flight_store, downlink, began: None, dated: false, opened: false }
    }

    /// Sets the flight's name: the UTC of its start, as the receiver reports it.
    fn date(&mut self, epoch: &Stamped<GnssEpoch>, store: &StoreHandle) {
        if let (false, Some(utc), Some(began)) = (self.dated, epoch.value.utc, self.began) {
            let start = UtcTime::from_unix_ns(utc.unix_ns() - (epoch.t_valid - began).ns());
            self.dated = store.set_start(start);
        }
    }
}

impl Sink for CardSink {
    fn event(&mut self, event: &Event) {
        self.began.get_or_insert(event.t_recv);
        let Some(store) = self.flight_store.get() else {
            if std::mem::replace(&mut self.opened, false) {
                self.downlink.store_closed();
            }
            return;
        };
        // A reopened flight begins with the same messages as any flight, and needs its date again.
        if !std::mem::replace(&mut self.opened, true) {
            self.dated = false;
            for record in records::opening(&self.camera, event.t_recv) {
                store.record(Arc::new(record), None);
            }
        }
        store.event(event);
    }

    fn output(&mut self, output: &TimedOutput) {
        let Some(store) = self.flight_store.get() else { return };
        match &output.output {
            Output::Reading(SensorReading::Gnss(epoch)) => self.date(epoch, &store),
            Output::Detections { markers, .. } => store.watch(pixels(markers)),
            _ => {}
        }
    }

    fn record(&mut self, record: &mut OutgoingRecord) {
        if let Some(store) = self.flight_store.get() {
            store.record(Arc::clone(&record.record), record.number);
        }
    }
}

/// Pixels of all detections of vehicles.
fn pixels(markers: &[MarkerDetection]) -> impl Iterator<Item = (f64, f64)> + '_ {
    markers.iter().flat_map(|marker| {
        let corners = marker.corners_px.unwrap_or([marker.center_px; 4]);
        corners.map(|corner| (corner.x, corner.y))
    })
}
