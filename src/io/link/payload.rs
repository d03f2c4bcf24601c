//! The payload's side of the link: a handle that never blocks, and its tasks.

use std::net::SocketAddr;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

use super::backlog::{Backlog, MemoryBacklog};
use super::endpoint::LinkEndpoint;
use super::keys::Role;
use super::link_events::{Events, LinkError, LinkEvent};
use super::live::downlink_class;
use super::pace::Bucket;
use super::payload_shared::{Connected, LinkStatus, PayloadShared, StationStatus};
use super::peer::Peer;
use super::session;
use super::thumbnail::Picture;
use super::tls::KeyFiles;
use crate::config::LinkConfig;
use crate::io::records::Record;

/// Settings of the payload's side of the link.
#[derive(Clone, Debug)]
pub struct PayloadSettings {
    /// Certificates and keys.
    pub files: KeyFiles,
    /// Where stations reach the payload.
    pub listen: Option<SocketAddr>,
    /// Stations to which the payload connects.
    pub dial: Vec<String>,
    /// Highest rate, bytes a second.
    pub ceiling: Option<f64>,
    /// Least time between two thumbnails; `None` sends none.
    pub thumbnails: Option<Duration>,
    /// Width of thumbnails, pixels.
    pub thumbnail_width: u32,
    /// Memory for back-fill, bytes.
    pub backlog_bytes: usize,
}

impl PayloadSettings {
    /// The settings from the configuration.
    pub fn from_config(config: &LinkConfig) -> Self {
        Self {
            files: KeyFiles {
                authority: (&config.authority).into(),
                certificate: (&config.certificate).into(),
                key: (&config.key).into(),
                revoked: config.revoked.as_ref().map(Into::into),
            },
            // The configuration was checked: a value that does not parse is treated as absent.
            listen: config.listen.as_ref().and_then(|address| address.parse().ok()),
            dial: config.dial.clone(),
            ceiling: config.ceiling_kbps.map(|kbps| kbps * 1e3 / 8.0),
            thumbnails: (config.thumbnail_width_px > 0)
                .then(|| Duration::from_secs_f64(config.thumbnail_interval_s)),
            thumbnail_width: config.thumbnail_width_px,
            backlog_bytes: (config.backlog_mb * 1e6) as usize,
        }
    }
}

/// Records of a run whose link is not open yet: they are numbered like the later ones.
#[derive(Debug)]
pub struct EarlyRecords(MemoryBacklog);

impl EarlyRecords {
    /// For a link with these settings: bounded like its memory, the oldest are dropped first.
    pub fn new(settings: &PayloadSettings) -> Self {
        Self(MemoryBacklog::new(0, "", settings.backlog_bytes))
    }

    /// Stores a record until the link is open and returns its number; `None` where its topic is not for the ground.
    pub fn send(&self, record: &Record) -> Option<u32> {
        numbered(&self.0, record)
    }
}

/// Stores a record that is for the ground; returns its number.
fn numbered(recent: &MemoryBacklog, record: &Record) -> Option<u32> {
    downlink_class(&record.topic)?;
    Some(recent.append(Arc::new(record.clone())))
}

/// Passes records to the link. Copies are cheap; no call ever blocks.
#[derive(Clone)]
pub struct LinkHandle {
    shared: Arc<PayloadShared>,
}

impl LinkHandle {
    /// Takes over records that were made before the link was open, with their numbers.
    pub fn begin_with(&self, early: EarlyRecords) {
        self.shared.recent.adopt(early.0);
        self.shared.end.send_replace(self.shared.recent.end());
    }

    /// Sends a record to the ground and returns its number in this run; `None` where its topic is not for the ground.
    /// Sessions are notified at once.
    pub fn send(&self, record: &Record) -> Option<u32> {
        let number = numbered(&self.shared.recent, record)?;
        self.shared.end.send_modify(|end| *end = (*end).max(number + 1));
        Some(number)
    }

    /// Offers a camera frame for the next thumbnail; only the newest is kept.
    pub fn offer_picture(&self, picture: Picture) {
        if self.shared.thumbnails.is_some() {
            self.shared.picture.send_replace(Some(Arc::new(picture)));
        }
    }

    /// Whether any station would get a thumbnail, so that no unused picture is made.
    pub fn wants_pictures(&self) -> bool {
        self.shared.thumbnails.is_some() && !self.shared.stations().is_empty()
    }

    /// State of the link, for the health line.
    pub fn status(&self) -> LinkStatus {
        LinkStatus {
            stations: self.shared.stations().values().map(|c| c.status.clone()).collect(),
            refused: self.shared.events.refusals(),
            records: self.shared.recent.end(),
            backlog_bytes: self.shared.recent.bytes(),
        }
    }
}

/// The payload's side of the link, opened.
pub struct PayloadLink {
    link_endpoint: LinkEndpoint,
    dial: Vec<String>,
    shared: Arc<PayloadShared>,
    arrivals: mpsc::Receiver<Peer>,
}

impl PayloadLink {
    /// Opens the port. `run` and `flight` identify this run of the program; `deep` is the store's backlog of earlier
    /// runs and of records that are no longer in memory. Events for the operator come out of the receiver.
    pub fn open(
        settings: &PayloadSettings,
        run: u32,
        flight: &str,
        deep: Option<Arc<dyn Backlog>>,
    ) -> Result<(Self, LinkHandle, mpsc::Receiver<LinkEvent>), LinkError> {
        let (event_sender, event_receiver) = mpsc::channel(256);
        let events = Events::new(event_sender);
        let (link_endpoint, arrivals) =
            LinkEndpoint::open(Role::Payload, &settings.files, settings.listen, events.clone())?;
        let shared = Arc::new(PayloadShared {
            recent: MemoryBacklog::new(run, flight, settings.backlog_bytes),
            deep,
            ceiling: settings.ceiling.map(|rate| Mutex::new(Bucket::new(rate, Instant::now()))),
            thumbnails: settings.thumbnails,
            thumbnail_width: settings.thumbnail_width,
            picture: watch::Sender::new(None),
            end: watch::Sender::new(0),
            stations: Mutex::default(),
            events,
        });
        let handle = LinkHandle { shared: Arc::clone(&shared) };
        let link = Self { link_endpoint, dial: settings.dial.clone(), shared, arrivals };
        Ok((link, handle, event_receiver))
    }

    /// The local UDP address.
    pub fn local_addr(&self) -> std::io::Result<SocketAddr> {
        self.link_endpoint.local_addr()
    }

    /// Serves stations until `stop` is set (or its sender is gone).
    pub async fn run(self, stop: watch::Receiver<bool>) {
        let shared = self.shared;
        self.link_endpoint.run(self.dial, self.arrivals, stop, |peer| welcome(&shared, peer)).await;
    }
}

/// Runs a session; an older one of the same station ends.
fn welcome(shared: &Arc<PayloadShared>, peer: Peer) -> impl Future<Output = ()> + Send + use<> {
    let status = StationStatus {
        name: peer.name.clone(),
        hears_us: true,
        rtt_ms: peer.connection.rtt().as_secs_f64() * 1e3,
        rate_kbps: 0.0,
        live: 0,
        thinned: 0,
        backfilled: 0,
        unread: 0,
        wanted: 0,
    };
    let up_reported = {
        let mut stations = shared.stations();
        let old = stations.remove(&peer.name);
        let open = old.as_ref().filter(|old| old.peer.connection.close_reason().is_none());
        let up_reported = open.map_or_else(Arc::default, |old| Arc::clone(&old.up_reported));
        if let Some(old) = old {
            old.peer.supersede();
        }
        let connected = Connected { peer: peer.clone(), status, up_reported: Arc::clone(&up_reported) };
        stations.insert(peer.name.clone(), connected);
        up_reported
    };
    let shared = Arc::clone(shared);
    async move {
        let up = || {
            if !up_reported.swap(true, Ordering::Relaxed) {
                let address = peer.address();
                shared.events.tell(LinkEvent::Up { peer: peer.name.clone(), address });
            }
        };
        let ended = session::serve(&shared, &peer, up).await;
        let mut stations = shared.stations();
        let id = peer.connection.stable_id();
        let ours = stations.get(&peer.name).is_some_and(|c| c.peer.connection.stable_id() == id);
        if ours {
            stations.remove(&peer.name);
            shared.events.ended(&peer, ended);
        }
    }
}
