//! Shared by the station's handle and its receivers: the payloads, their state, and what arrives from them.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{Notify, mpsc};
use tokio::time::Instant;

use super::link_events::Events;
use super::peer::Peer;
use super::ranges::RangeSet;
use super::received_numbers::{Progress, ReceivedNumbers};
use crate::io::proto::link::Thumbnail;
use windhover_base::time::MonoTime;

/// Topic and schema of a record.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Channel {
    /// Topic of the flight.
    pub topic: String,
    /// Name of the schema.
    pub schema_name: String,
    /// The payload's schema; empty where it is the station's own of this name.
    pub schema: Vec<u8>,
}

/// A record that arrived for the first time.
#[derive(Clone, Debug)]
pub struct Arrival {
    /// Name of the payload.
    pub payload: Arc<str>,
    /// Run of the payload.
    pub run: u32,
    /// Name of the run's flight.
    pub flight: Arc<str>,
    /// Its number in the run.
    pub number: u32,
    /// Topic and schema.
    pub channel: Arc<Channel>,
    /// Log clock, the payload's host time.
    pub log_time: MonoTime,
    /// Its time of validity, the payload's host time.
    pub publish_time: MonoTime,
    /// The protobuf message.
    pub data: Vec<u8>,
    /// Whether it came live, not as back-fill.
    pub live: bool,
    /// When it arrived.
    pub arrived: Instant,
}

/// Output of a station's link.
#[derive(Clone, Debug)]
pub enum FromPayload {
    /// A record, on its first arrival.
    Record(Arrival),
    /// A thumbnail of a payload's camera image.
    Thumbnail {
        /// Name of the payload.
        payload: Arc<str>,
        /// The thumbnail.
        thumbnail: Thumbnail,
    },
}

/// The numbers of a run that earlier runs of the station stored: by payload, flight and run.
pub type Recall = Arc<dyn Fn(&str, &str, u32) -> RangeSet + Send + Sync>;

/// State of the link to one payload.
#[derive(Clone, PartialEq, Debug)]
pub struct PayloadStatus {
    /// Its name.
    pub name: String,
    /// Whether it is connected.
    pub connected: bool,
    /// Its present or last address.
    pub address: SocketAddr,
    /// Round-trip time, ms.
    pub rtt_ms: f64,
    /// Time since anything was received.
    pub silent: Duration,
    /// Bytes received on this connection.
    pub bytes: u64,
    /// Records received live.
    pub live: u64,
    /// Program and version on board.
    pub software: String,
    /// How complete the station is.
    pub progress: Progress,
}

/// A payload that was ever connected.
pub(super) struct PayloadState {
    pub(super) received: Mutex<ReceivedNumbers>,
    pub(super) stored: Notify,
    pub(super) status: Mutex<PayloadStatus>,
    pub(super) last_received: Mutex<Instant>,
    pub(super) peer: Mutex<Peer>,
    /// Whether `link_up` was reported.
    pub(super) up_reported: AtomicBool,
}

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Shared by the station's handle and its receivers.
pub(super) struct StationShared {
    pub(super) payloads: Mutex<BTreeMap<String, Arc<PayloadState>>>,
    pub(super) recall: Recall,
    pub(super) records: mpsc::Sender<FromPayload>,
    pub(super) thumbnails: bool,
    /// Whether the disk accepts nothing now.
    pub(super) holding: AtomicBool,
    pub(super) events: Events,
}

impl StationShared {
    /// The state of a payload, made at its first connection; an older connection ends.
    pub(super) fn state_of(&self, peer: &Peer) -> Arc<PayloadState> {
        let mut payloads = lock(&self.payloads);
        if let Some(state) = payloads.get(&peer.name) {
            let old = std::mem::replace(&mut *lock(&state.peer), peer.clone());
            old.supersede();
            lock(&state.status).connected = true;
            *lock(&state.last_received) = Instant::now();
            return Arc::clone(state);
        }
        let status = PayloadStatus {
            name: peer.name.clone(),
            connected: true,
            address: peer.address(),
            rtt_ms: 0.0,
            silent: Duration::ZERO,
            bytes: 0,
            live: 0,
            software: String::new(),
            progress: Progress::default(),
        };
        let state = Arc::new(PayloadState {
            received: Mutex::default(),
            stored: Notify::new(),
            status: Mutex::new(status),
            last_received: Mutex::new(Instant::now()),
            peer: Mutex::new(peer.clone()),
            up_reported: AtomicBool::new(false),
        });
        payloads.insert(peer.name.clone(), Arc::clone(&state));
        state
    }
}
