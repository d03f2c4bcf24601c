//! The station's side of the link: payloads connect or are connected to; records come out, each once.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use quinn::VarInt;
use tokio::sync::{mpsc, watch};

use super::endpoint::LinkEndpoint;
use super::keys::Role;
use super::link_events::{Events, LinkError, LinkEvent};
use super::peer::{Peer, close};
use super::ranges::RangeSet;
use super::receive;
use super::station_shared::{FromPayload, PayloadState, PayloadStatus, Recall, StationShared, lock};
use super::tls::KeyFiles;

/// Settings of the station's side of the link.
#[derive(Clone, Debug)]
pub struct StationSettings {
    /// Certificates and keys.
    pub files: KeyFiles,
    /// Where payloads reach the station.
    pub listen: Option<SocketAddr>,
    /// Payloads to which the station connects.
    pub dial: Vec<String>,
    /// Whether it wants thumbnails.
    pub thumbnails: bool,
}

/// Reports the disk's state to the link, and reads the link's state.
#[derive(Clone)]
pub struct StationHandle {
    shared: Arc<StationShared>,
}

impl StationHandle {
    /// Numbers of a run are on disk: the payload gets the acknowledgement, and may drop them.
    pub fn stored(&self, payload: &str, run: u32, numbers: &RangeSet) {
        let state = lock(&self.shared.payloads).get(payload).cloned();
        if let Some(state) = state {
            lock(&state.received).stored(run, numbers);
            state.stored.notify_one();
        }
    }

    /// Numbers of a run are not on disk, or no longer: they are requested again.
    pub fn forget(&self, payload: &str, run: u32, numbers: &RangeSet) {
        let state = lock(&self.shared.payloads).get(payload).cloned();
        if let Some(state) = state {
            lock(&state.received).forget(run, numbers);
        }
    }

    /// While the disk accepts nothing, nothing is requested again.
    pub fn hold(&self, holding: bool) {
        self.shared.holding.store(holding, Ordering::Relaxed);
    }

    /// Ends the session of a payload that exceeds a limit.
    pub fn dismiss(&self, payload: &str, why: &str) {
        let state = lock(&self.shared.payloads).get(payload).cloned();
        if let Some(state) = state {
            let code = VarInt::from_u32(close::EXCESS);
            lock(&state.peer).connection.close(code, why.as_bytes());
        }
    }

    /// State of the link to every payload that was ever connected.
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
            status.silent = lock(&state.last_received).elapsed();
            status.progress = lock(&state.received).progress();
            status
        };
        states.into_iter().map(of).collect()
    }

    /// Number of handshakes refused since the start.
    pub fn refusals(&self) -> u64 {
        self.shared.events.refusals()
    }
}

/// The station's side of the link, opened.
pub struct StationLink {
    link_endpoint: LinkEndpoint,
    dial: Vec<String>,
    shared: Arc<StationShared>,
    arrivals: mpsc::Receiver<Peer>,
}

/// Result of [`StationLink::open`]: the link to run, its handle, records, events.
pub type OpenStation = (StationLink, StationHandle, mpsc::Receiver<FromPayload>, mpsc::Receiver<LinkEvent>);

impl StationLink {
    /// Opens the port.
    pub fn open(settings: &StationSettings, recall: Recall) -> Result<OpenStation, LinkError> {
        let (event_sender, event_receiver) = mpsc::channel(256);
        let events = Events::new(event_sender);
        let (link_endpoint, arrivals) =
            LinkEndpoint::open(Role::Station, &settings.files, settings.listen, events.clone())?;
        let (records, record_receiver) = mpsc::channel(1_024);
        let shared = Arc::new(StationShared {
            payloads: Mutex::default(),
            recall,
            records,
            thumbnails: settings.thumbnails,
            holding: AtomicBool::new(false),
            events,
        });
        let handle = StationHandle { shared: Arc::clone(&shared) };
        let link = Self { link_endpoint, dial: settings.dial.clone(), shared, arrivals };
        Ok((link, handle, record_receiver, event_receiver))
    }

    /// The local UDP address.
    pub fn local_addr(&self) -> std::io::Result<SocketAddr> {
        self.link_endpoint.local_addr()
    }

    /// Receives until `stop` is set (or its sender is gone).
    pub async fn run(self, stop: watch::Receiver<bool>) {
        let shared = self.shared;
        self.link_endpoint.run(self.dial, self.arrivals, stop, |peer| welcome(&shared, peer)).await;
    }
}

/// Runs a session; an older one of the same payload ends.
fn welcome(shared: &Arc<StationShared>, peer: Peer) -> impl Future<Output = ()> + Send + use<> {
    let (state, shared) = (shared.state_of(&peer), Arc::clone(shared));
    async move {
        let up = || {
            if !state.up_reported.swap(true, Ordering::Relaxed) {
                let address = peer.address();
                shared.events.tell(LinkEvent::Up { peer: peer.name.clone(), address });
            }
        };
        let ended = receive::receive(&shared, &state, &peer, up).await;
        let ours = lock(&state.peer).connection.stable_id() == peer.connection.stable_id();
        if ours {
            lock(&state.status).connected = false;
            state.up_reported.store(false, Ordering::Relaxed);
            shared.events.ended(&peer, ended);
        }
    }
}
