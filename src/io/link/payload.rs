//! The payload's side of the link: a handle that never blocks, and the tasks behind it.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

use super::backlog::{Backlog, Extent, Found, MemoryBacklog, Unread};
use super::door::Door;
use super::events::{Events, LinkError, LinkEvent};
use super::keys::Role;
use super::live::downlink_class;
use super::pace::Bucket;
use super::peer::Peer;
use super::session;
use super::thumbnail::Picture;
use super::tls::KeyFiles;
use crate::config::LinkConfig;
use crate::io::records::Record;

/// What the payload's side of the link is made of.
#[derive(Clone, Debug)]
pub struct PayloadSettings {
    /// Certificates and keys.
    pub files: KeyFiles,
    /// Where stations reach the payload.
    pub listen: Option<SocketAddr>,
    /// Stations the payload calls.
    pub dial: Vec<String>,
    /// Most that may be sent, bytes a second.
    pub ceiling: Option<f64>,
    /// Least time between two thumbnails; `None` sends none.
    pub thumbnails: Option<Duration>,
    /// Width of thumbnails, pixels.
    pub thumbnail_width: u32,
    /// Memory for what may have to be sent again, bytes.
    pub backlog_bytes: usize,
}

impl PayloadSettings {
    /// As configured.
    pub fn from_config(config: &LinkConfig) -> Self {
        Self {
            files: KeyFiles {
                authority: (&config.authority).into(),
                certificate: (&config.certificate).into(),
                key: (&config.key).into(),
                revoked: config.revoked.as_ref().map(Into::into),
            },
            // The configuration was checked: what does not parse is not there.
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

/// How the link does with one station.
#[derive(Clone, PartialEq, Debug)]
pub struct StationStatus {
    /// Its name.
    pub name: String,
    /// Whether its acknowledgements arrive.
    pub hears_us: bool,
    /// Round-trip time, ms.
    pub rtt_ms: f64,
    /// What the path is found to carry, kbit/s.
    pub rate_kbps: f64,
    /// Records sent live.
    pub live: u64,
    /// Records left to back-fill because newer ones overtook them.
    pub thinned: u64,
    /// Records sent again.
    pub backfilled: u64,
    /// Times that the card could not be read for it.
    pub unread: u64,
    /// Records it asked for that are still to be sent.
    pub wanted: u64,
}

/// How the link does.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct LinkStatus {
    /// Connected stations.
    pub stations: Vec<StationStatus>,
    /// Handshakes refused since the start.
    pub refused: u64,
    /// Records numbered so far in this run.
    pub records: u32,
    /// Memory held for back-fill, bytes.
    pub backlog_bytes: usize,
}

/// A station's latest connection.
struct Connected {
    peer: Peer,
    status: StationStatus,
    /// Whether the operator was told that it is up; a connection that takes over inherits it.
    told: Arc<AtomicBool>,
}

/// What the sessions share.
pub(super) struct Shared {
    pub(super) recent: MemoryBacklog,
    pub(super) deep: Option<Arc<dyn Backlog>>,
    pub(super) ceiling: Option<Mutex<Bucket>>,
    pub(super) thumbnails: Option<Duration>,
    pub(super) thumbnail_width: u32,
    pub(super) picture: watch::Sender<Option<Arc<Picture>>>,
    end: watch::Sender<u32>,
    stations: Mutex<BTreeMap<String, Connected>>,
    events: Events,
}

impl Shared {
    /// Tells of every new record.
    pub(super) fn news(&self) -> watch::Receiver<u32> {
        self.end.subscribe()
    }

    fn stations(&self) -> MutexGuard<'_, BTreeMap<String, Connected>> {
        self.stations.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Every run of which something is held; the present one last.
    pub(super) fn extents(&self) -> Vec<Extent> {
        let recent = self.recent.extents();
        let mut all = self.deep.as_ref().map_or(Vec::new(), |deep| deep.extents());
        for now in recent {
            match all.iter_mut().find(|e| e.run == now.run) {
                Some(same) => {
                    same.first = same.first.min(now.first);
                    same.end = same.end.max(now.end);
                }
                None => all.push(now),
            }
        }
        all
    }

    /// Reads records again, from memory where they are there, else from the card. Numbers left out are
    /// gone for good.
    pub(super) async fn read(self: &Arc<Self>, run: u32, first: u32, end: u32, max_bytes: usize) -> Found {
        let recent = self.recent.read(run, first, end, max_bytes)?;
        let covered = recent.first().is_some_and(|(number, _)| *number == first);
        match &self.deep {
            Some(deep) if !covered => {
                let deep = Arc::clone(deep);
                let end = recent.first().map_or(end, |(number, _)| *number);
                let read = move || deep.read(run, first, end, max_bytes);
                let found = tokio::task::spawn_blocking(read).await.unwrap_or(Err(Unread { end }))?;
                Ok(if found.is_empty() { recent } else { found })
            }
            _ => Ok(recent),
        }
    }

    pub(super) fn note_status(&self, status: StationStatus) {
        if let Some(connected) = self.stations().get_mut(&status.name) {
            connected.status = status;
        }
    }
}

/// Records of a run whose link is not open yet: they are numbered like all that follow.
#[derive(Debug)]
pub struct EarlyRecords(MemoryBacklog);

impl EarlyRecords {
    /// Of a link with these settings: bounded like its own memory, the oldest go first.
    pub fn new(settings: &PayloadSettings) -> Self {
        Self(MemoryBacklog::new(0, "", settings.backlog_bytes))
    }

    /// Keeps a record for when the link is open and gives its number; `None` where its topic is not for the
    /// ground.
    pub fn send(&self, record: &Record) -> Option<u32> {
        numbered(&self.0, record)
    }
}

/// Keeps a record that is for the ground; its number.
fn numbered(recent: &MemoryBacklog, record: &Record) -> Option<u32> {
    downlink_class(&record.topic)?;
    Some(recent.append(Arc::new(record.clone())))
}

/// Gives records to the link. Copies are cheap; nothing here ever blocks.
#[derive(Clone)]
pub struct LinkHandle {
    shared: Arc<Shared>,
}

impl LinkHandle {
    /// Begins with records that were made before the link was open, under the numbers they got.
    pub fn begin_with(&self, early: EarlyRecords) {
        self.shared.recent.adopt(early.0);
        self.shared.end.send_replace(self.shared.recent.end());
    }

    /// Takes a record on its way to the ground and gives its number in this run; `None` where its topic
    /// is not for the ground. Sessions are told at once.
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

    /// Whether a thumbnail would be sent to anybody: spares the making of pictures nobody sees.
    pub fn wants_pictures(&self) -> bool {
        self.shared.thumbnails.is_some() && !self.shared.stations().is_empty()
    }

    /// How the link does, for the health line.
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
    door: Door,
    dial: Vec<String>,
    shared: Arc<Shared>,
    arrivals: mpsc::Receiver<Peer>,
}

impl PayloadLink {
    /// Opens the port. `run` and `flight` identify this run of the program; `deep` is what the store
    /// holds of earlier ones and of what memory lost. Events for the operator come out of the receiver.
    pub fn open(
        settings: &PayloadSettings,
        run: u32,
        flight: &str,
        deep: Option<Arc<dyn Backlog>>,
    ) -> Result<(Self, LinkHandle, mpsc::Receiver<LinkEvent>), LinkError> {
        let (event_sender, event_receiver) = mpsc::channel(256);
        let events = Events::new(event_sender);
        let (door, arrivals) = Door::open(Role::Payload, &settings.files, settings.listen, events.clone())?;
        let shared = Arc::new(Shared {
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
        let link = Self { door, dial: settings.dial.clone(), shared, arrivals };
        Ok((link, handle, event_receiver))
    }

    /// The UDP port it has.
    pub fn local_addr(&self) -> std::io::Result<SocketAddr> {
        self.door.local_addr()
    }

    /// Serves stations until `stop` says so (or its sender is gone).
    pub async fn run(self, stop: watch::Receiver<bool>) {
        let shared = self.shared;
        self.door.run(self.dial, self.arrivals, stop, |peer| welcome(&shared, peer)).await;
    }
}

/// A session; an older one of the same station ends.
fn welcome(shared: &Arc<Shared>, peer: Peer) -> impl Future<Output = ()> + Send + use<> {
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
    let told = {
        let mut stations = shared.stations();
        let old = stations.remove(&peer.name);
        let open = old.as_ref().filter(|old| old.peer.connection.close_reason().is_none());
        let told = open.map_or_else(Arc::default, |old| Arc::clone(&old.told));
        if let Some(old) = old {
            old.peer.supersede();
        }
        let connected = Connected { peer: peer.clone(), status, told: Arc::clone(&told) };
        stations.insert(peer.name.clone(), connected);
        told
    };
    let shared = Arc::clone(shared);
    async move {
        let up = || {
            if !told.swap(true, Ordering::Relaxed) {
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
