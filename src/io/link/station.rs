//! The station's side of the link: payloads come in or are called; records come out, each once.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{Notify, mpsc, watch};
use tokio::time::Instant;

use super::door::Door;
use super::events::{Events, LinkError, LinkEvent};
use super::inbox::{Inbox, Progress};
use super::keys::Role;
use super::peer::Peer;
use super::ranges::RangeSet;
use super::receive;
use super::tls::KeyFiles;
use crate::io::proto::link::Thumbnail;
use windhover_base::time::MonoTime;

/// What a station's side of the link is made of.
#[derive(Clone, Debug)]
pub struct StationSettings {
    /// Certificates and keys.
    pub files: KeyFiles,
    /// Where payloads that call reach the station.
    pub listen: Option<SocketAddr>,
    /// Payloads the station calls.
    pub dial: Vec<String>,
    /// Whether it wants thumbnails.
    pub thumbnails: bool,
}

/// Topic and schema of what arrives.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Channel {
    /// Topic of the flight.
    pub topic: String,
    /// Name of the schema.
    pub schema_name: String,
    /// The schema as the payload has it; empty where it is the station's own of this name.
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
    /// When it was true, the payload's host time.
    pub publish_time: MonoTime,
    /// The protobuf message.
    pub data: Vec<u8>,
    /// Whether it came live, not as back-fill.
    pub live: bool,
    /// When it arrived.
    pub arrived: Instant,
}

/// What comes out of a station's link.
#[derive(Clone, Debug)]
pub enum FromPayload {
    /// A record, for the first time.
    Record(Arrival),
    /// A thumbnail of a payload's camera image.
    Thumbnail {
        /// Name of the payload.
        payload: Arc<str>,
        /// It.
        thumbnail: Thumbnail,
    },
}

/// What of a run the station kept in earlier lives: by payload, flight and run.
pub type Recall = Arc<dyn Fn(&str, &str, u32) -> RangeSet + Send + Sync>;

/// How the link to one payload does.
#[derive(Clone, PartialEq, Debug)]
pub struct PayloadStatus {
    /// Its name.
    pub name: String,
    /// Whether it is connected.
    pub connected: bool,
    /// Where it is, or was last.
    pub address: SocketAddr,
    /// Round-trip time, ms.
    pub rtt_ms: f64,
    /// Time since anything was heard.
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

pub(super) struct PayloadState {
    pub(super) inbox: Mutex<Inbox>,
    pub(super) stored: Notify,
    pub(super) status: Mutex<PayloadStatus>,
    pub(super) heard: Mutex<Instant>,
    peer: Mutex<Peer>,
    /// Whether the operator was told that it is up.
    told: AtomicBool,
}

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

pub(super) struct Shared {
    payloads: Mutex<BTreeMap<String, Arc<PayloadState>>>,
    pub(super) recall: Recall,
    pub(super) records: mpsc::Sender<FromPayload>,
    pub(super) thumbnails: bool,
    events: Events,
}

/// Gives the link what it must know of the disk, and tells how it does.
#[derive(Clone)]
pub struct StationHandle {
    shared: Arc<Shared>,
}

impl StationHandle {
    /// Numbers of a run are on disk: the payload is told, and may forget them.
    pub fn stored(&self, payload: &str, run: u32, numbers: &RangeSet) {
        let state = lock(&self.shared.payloads).get(payload).cloned();
        if let Some(state) = state {
            lock(&state.inbox).stored(run, numbers);
            state.stored.notify_one();
        }
    }

    /// How the link to every payload does that was ever connected.
    pub fn status(&self) -> Vec<PayloadStatus> {
        let states: Vec<_> = lock(&self.shared.payloads).values().cloned().collect();
        let of = |state: Arc<PayloadState>| {
            let mut status = lock(&state.status).clone();
            let peer = lock(&state.peer).clone();
            let connection = &peer.connection;
            status.connected &= connection.close_reason().is_none();
            status.rtt_ms = connection.rtt().as_secs_f64() * 1e3;
            status.address = peer.address();
            status.bytes = connection.stats().udp_rx.bytes;
            status.silent = lock(&state.heard).elapsed();
            status.progress = lock(&state.inbox).progress();
            status
        };
        states.into_iter().map(of).collect()
    }

    /// Handshakes refused since the start.
    pub fn refusals(&self) -> u64 {
        self.shared.events.refusals()
    }
}

/// The station's side of the link, opened.
pub struct StationLink {
    door: Door,
    dial: Vec<String>,
    shared: Arc<Shared>,
    arrivals: mpsc::Receiver<Peer>,
}

/// What [`StationLink::open`] gives: the link to run, its handle, records, events.
pub type OpenStation = (StationLink, StationHandle, mpsc::Receiver<FromPayload>, mpsc::Receiver<LinkEvent>);

impl StationLink {
    /// Opens the port.
    pub fn open(settings: &StationSettings, recall: Recall) -> Result<OpenStation, LinkError> {
        let (event_sender, event_receiver) = mpsc::channel(256);
        let events = Events::new(event_sender);
        let (door, arrivals) = Door::open(Role::Station, &settings.files, settings.listen, events.clone())?;
        let (records, record_receiver) = mpsc::channel(1_024);
        let shared = Arc::new(Shared {
            payloads: Mutex::default(),
            recall,
            records,
            thumbnails: settings.thumbnails,
            events,
        });
        let handle = StationHandle { shared: Arc::clone(&shared) };
        let link = Self { door, dial: settings.dial.clone(), shared, arrivals };
        Ok((link, handle, record_receiver, event_receiver))
    }

    /// The UDP port it has.
    pub fn local_addr(&self) -> std::io::Result<SocketAddr> {
        self.door.local_addr()
    }

    /// Receives until `stop` says so (or its sender is gone).
    pub async fn run(self, stop: watch::Receiver<bool>) {
        let shared = self.shared;
        self.door.run(self.dial, self.arrivals, stop, |peer| welcome(&shared, peer)).await;
    }
}

impl Shared {
    /// The state of a payload, made when it first comes; an older connection ends.
    fn state_of(&self, peer: &Peer) -> Arc<PayloadState> {
        let mut payloads = lock(&self.payloads);
        if let Some(state) = payloads.get(&peer.name) {
            let old = std::mem::replace(&mut *lock(&state.peer), peer.clone());
            old.supersede();
            lock(&state.status).connected = true;
            *lock(&state.heard) = Instant::now();
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
            inbox: Mutex::default(),
            stored: Notify::new(),
            status: Mutex::new(status),
            heard: Mutex::new(Instant::now()),
            peer: Mutex::new(peer.clone()),
            told: AtomicBool::new(false),
        });
        payloads.insert(peer.name.clone(), Arc::clone(&state));
        state
    }
}

/// A session; an older one of the same payload ends.
fn welcome(shared: &Arc<Shared>, peer: Peer) -> impl Future<Output = ()> + Send + use<> {
    let (state, shared) = (shared.state_of(&peer), Arc::clone(shared));
    async move {
        let up = || {
            if !state.told.swap(true, Ordering::Relaxed) {
                let address = peer.address();
                shared.events.tell(LinkEvent::Up { peer: peer.name.clone(), address });
            }
        };
        let ended = receive::receive(&shared, &state, &peer, up).await;
        let ours = lock(&state.peer).connection.stable_id() == peer.connection.stable_id();
        if ours {
            lock(&state.status).connected = false;
            state.told.store(false, Ordering::Relaxed);
            shared.events.ended(&peer, ended);
        }
    }
}
