//! The receiving station: link, disk, web page, feeds, terminal.
//!
//! ```text
//! payloads ─► io::link ─► intake ─┬─► mirror (thread: MCAP, fsync once a second) ─► "stored" to the payload
//!                                 ├─► view ─► web page, GeoJSON, KML, NMEA, Cursor on Target, OpenMetrics
//!                                 ├─► Foxglove, Zenoh, ROS 2 on Zenoh
//!                                 └─► one line a second per payload
//! ```

mod browser;
mod cot;
mod listener;
mod feeds;
#[cfg(feature = "zenoh")]
pub mod fleet;
pub mod foxglove;
mod freshness;
#[cfg(feature = "zenoh")]
mod history;
pub mod mirror;
mod nmea_port;
#[cfg(feature = "zenoh")]
mod ros_graph;
mod terminal;
pub mod view;
pub mod web;

pub use cot::{CotKeys, CotTo};

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{broadcast, mpsc, watch};

use crate::app::events::OperatorEvent;
use crate::io::clock::HostClock;
use crate::io::link::{
    Arrival, FromPayload, LinkError, LinkEvent, StationHandle, StationLink, StationSettings,
};
use foxglove::Scope;
use listener::ClientListener;
use mirror::{Mirror, MirrorError};
use terminal::Terminal;
use view::View;
use web::Web;

/// Messages that a page may be behind before it misses some.
const PAGE_QUEUE: usize = 4_096;
/// Records on their way to the disk; a full queue slows the link down and loses nothing.
const DISK_QUEUE: usize = 16_384;
/// How often received records are synced to the disk.
const SYNC: Duration = Duration::from_secs(1);

/// The settings of a station.
#[derive(Clone, Debug)]
pub struct GroundSettings {
    /// The link.
    pub link: StationSettings,
    /// Where flights are kept.
    pub out: PathBuf,
    /// Where the web page is served.
    pub web: Option<SocketAddr>,
    /// Whether the page is opened in the desktop's browser.
    pub open: bool,
    /// The token that visitors of the page, and Foxglove, must send; a random one where a port of theirs is not on
    /// loopback and none is given.
    pub token: Option<String>,
    /// Folder with map tiles.
    pub tiles: Option<PathBuf>,
    /// Position of the station, latitude and longitude in degrees: distances on the page are measured from there.
    pub position: Option<[f64; 2]>,
    /// Where NMEA is served over TCP.
    pub nmea: Option<SocketAddr>,
    /// Where position reports are sent as Cursor on Target.
    pub cot: Vec<CotTo>,
    /// The TLS files for them.
    pub cot_keys: CotKeys,
    /// Where Foxglove is served over its WebSocket.
    pub foxglove: Option<SocketAddr>,
    /// How to join Zenoh: an endpoint, or a file with Zenoh's own configuration.
    #[cfg(feature = "zenoh")]
    pub zenoh: Option<String>,
    /// The domain of ROS 2 (`ROS_DOMAIN_ID`) in which the payloads are published over Zenoh.
    #[cfg(feature = "zenoh")]
    pub ros: Option<u8>,
    /// Whether lines are rewritten in place, as on a terminal.
    pub terminal: bool,
}

/// Why a station could not run.
#[derive(Debug, thiserror::Error)]
pub enum GroundError {
    /// The link.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The disk.
    #[error("station: {0}")]
    Mirror(#[from] MirrorError),
    /// A TCP port.
    #[error("station: cannot listen on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's error.
        source: std::io::Error,
    },
    /// Zenoh.
    #[cfg(feature = "zenoh")]
    #[error("station: cannot join Zenoh as {words}: {source}")]
    Zenoh {
        /// The endpoint or file as given.
        words: String,
        /// Zenoh's error.
        source: zenoh::Error,
    },
    /// Cursor on Target over TLS.
    #[error("station: {0}")]
    Cot(String),
    /// The system.
    #[error("station: {0}")]
    System(#[from] std::io::Error),
}

fn lock(view: &Mutex<View>) -> MutexGuard<'_, View> {
    view.lock().unwrap_or_else(PoisonError::into_inner)
}

async fn listen(address: SocketAddr) -> Result<tokio::net::TcpListener, GroundError> {
    tokio::net::TcpListener::bind(address).await.map_err(|source| GroundError::Listen { address, source })
}

/// The token that visitors must send, and whether it was given.
struct Tokens(Option<Arc<str>>, bool);

impl Tokens {
    /// The given token, or a random one where a port is not on loopback.
    fn of(settings: &GroundSettings) -> std::io::Result<Self> {
        let open = [settings.web, settings.foxglove].into_iter().flatten();
        let given = settings.token.as_deref().map(Arc::from);
        if given.is_some() || open.clone().all(|address| address.ip().is_loopback()) {
            return Ok(Self(given, settings.token.is_some()));
        }
        let made = random_token().ok_or_else(|| std::io::Error::other("no random bytes"))?;
        Ok(Self(Some(made.into()), false))
    }

    /// The token required at this address: on loopback only one that was given.
    fn at(&self, address: SocketAddr) -> Option<Arc<str>> {
        self.0.clone().filter(|_| self.1 || !address.ip().is_loopback())
    }

    /// How it is written in a link.
    fn asked(&self, address: SocketAddr) -> String {
        self.at(address).map_or_else(String::new, |token| format!("?token={token}"))
    }
}

/// 128 random bits in hexadecimal.
fn random_token() -> Option<String> {
    use ring::rand::SecureRandom as _;
    let mut bytes = [0_u8; 16];
    ring::rand::SystemRandom::new().fill(&mut bytes).ok()?;
    Some(bytes.iter().map(|b| format!("{b:02x}")).collect())
}

/// Runs a station until `stop` is set.
pub async fn run(settings: GroundSettings, stop: watch::Receiver<bool>) -> Result<(), GroundError> {
    let shown = Terminal::start(settings.terminal);
    let terminal = shown.terminal();
    let mirror = Mirror::at(&settings.out)?;
    let root = settings.out.clone();
    let recall =
        Arc::new(move |payload: &str, flight: &str, run: u32| mirror::recall(&root, payload, flight, run));
    let (link, handle, records, events) = StationLink::open(&settings.link, recall)?;
    if settings.link.listen.is_some() {
        terminal.line(format_args!("payloads connect to {}", link.local_addr()?));
    }
    let view = Arc::new(Mutex::new(View::default()));
    let live = broadcast::Sender::new(PAGE_QUEUE);
    let mut tasks = tokio::task::JoinSet::new();
    let scope = serve(&settings, &view, &live, terminal, &mut tasks).await?;
    let (to_disk, from_link) = std::sync::mpsc::sync_channel(DISK_QUEUE);
    let disk_handle = handle.clone();
    let disk = std::thread::Builder::new()
        .name("mirror".into())
        .spawn(move || keep(mirror, &from_link, &disk_handle))?;
    let linked = tokio::spawn(link.run(stop));
    tasks.spawn(report(handle, Arc::clone(&view), live.clone(), terminal.clone()));
    tasks.spawn(tell(events, Arc::clone(&view), live.clone()));
    let ended = watch::Sender::new(false);
    #[cfg(feature = "zenoh")]
    let fleet = match settings.zenoh {
        None => None,
        Some(words) => match fleet::Fleet::open(&words, settings.out.clone(), settings.ros).await {
            Ok(fleet) => Some(fleet),
            Err(source) => return Err(GroundError::Zenoh { words, source }),
        },
    };
    let outputs = StationOutputs {
        to_disk,
        view,
        live,
        scope,
        #[cfg(feature = "zenoh")]
        fleet,
    };
    let taken = tokio::spawn(intake(records, ended.subscribe(), outputs));
    let _ = linked.await;
    // The link ended: received records are handed on, the channel to the disk closes, and everything is stored.
    ended.send_replace(true);
    let _ = tokio::time::timeout(Duration::from_secs(5), taken).await;
    let _ = tokio::task::spawn_blocking(move || disk.join()).await;
    Ok(())
}

/// Starts everything that the station serves and sends; returns Foxglove's channels, where they are served.
async fn serve(
    settings: &GroundSettings,
    view: &Arc<Mutex<View>>,
    live: &broadcast::Sender<Arc<str>>,
    terminal: &Terminal,
    tasks: &mut tokio::task::JoinSet<std::io::Result<()>>,
) -> Result<Option<Scope>, GroundError> {
    let tokens = Tokens::of(settings)?;
    if let Some(address) = settings.web {
        let listener = listen(address).await?;
        let (bound, asked) = (listener.local_addr()?, tokens.asked(address));
        terminal.line(format_args!("page at http://{bound}/{asked}"));
        if settings.open {
            let url = format!("http://{}/{asked}", browser::reachable(bound));
            tasks.spawn(browser::open(url, terminal.clone()));
        }
        let (tiles, position) = (settings.tiles.clone(), settings.position);
        let web =
            Web { view: Arc::clone(view), live: live.clone(), tiles, position, token: tokens.at(address) };
        tasks.spawn(web::serve(listener, web));
    }
    let scope = settings.foxglove.map(|_| Scope::default());
    if let (Some(address), Some(scope)) = (settings.foxglove, scope.clone()) {
        let listener = listen(address).await?;
        terminal.line(format_args!("Foxglove at ws://{}/{}", listener.local_addr()?, tokens.asked(address)));
        let token = tokens.at(address);
        tasks.spawn(foxglove::serve(listener, foxglove::Server { scope, token }));
    }
    if let Some(address) = settings.nmea {
        let listener = listen(address).await?;
        terminal.line(format_args!("NMEA at tcp://{}", listener.local_addr()?));
        tasks.spawn(nmea_port::serve(ClientListener::new(listener, "nmea"), Arc::clone(view)));
    }
    if !settings.cot.is_empty() {
        let over_tls = settings.cot.iter().any(|to| matches!(to, CotTo::Tls(_)));
        let tls =
            over_tls.then(|| cot::connector(&settings.cot_keys)).transpose().map_err(GroundError::Cot)?;
        for to in &settings.cot {
            terminal.line(format_args!("Cursor on Target to {to}"));
        }
        tasks.spawn(cot::serve(settings.cot.clone(), tls, Arc::clone(view)));
    }
    Ok(scope)
}

/// Where records go.
struct StationOutputs {
    to_disk: std::sync::mpsc::SyncSender<Arrival>,
    view: Arc<Mutex<View>>,
    live: broadcast::Sender<Arc<str>>,
    scope: Option<Scope>,
    #[cfg(feature = "zenoh")]
    fleet: Option<fleet::Fleet>,
}

impl StationOutputs {
    /// To all viewers; returns the message for the pages, where there is one.
    fn show(&self, arrival: &Arrival) -> Option<Arc<str>> {
        if let Some(scope) = &self.scope {
            scope.record(arrival);
        }
        #[cfg(feature = "zenoh")]
        if let Some(fleet) = &self.fleet {
            fleet.record(arrival);
        }
        lock(&self.view).record(arrival)
    }

    /// To the disk; `false` where its thread has ended. A full queue slows the link down.
    async fn keep(&self, arrival: Arrival) -> bool {
        let mut arrival = arrival;
        loop {
            match self.to_disk.try_send(arrival) {
                Ok(()) => return true,
                Err(std::sync::mpsc::TrySendError::Full(back)) => arrival = back,
                Err(std::sync::mpsc::TrySendError::Disconnected(_)) => return false,
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}

/// Hands records to the disk and to the viewers, until the link has ended and none is waiting.
async fn intake(
    mut records: mpsc::Receiver<FromPayload>,
    mut ended: watch::Receiver<bool>,
    outputs: StationOutputs,
) {
    loop {
        let message = tokio::select! {
            biased;
            message = records.recv() => message,
            _ = ended.wait_for(|ended| *ended) => None,
        };
        let news = match message {
            None => return,
            Some(FromPayload::Record(arrival)) => {
                let news = outputs.show(&arrival);
                if !outputs.keep(arrival).await {
                    return;
                }
                news
            }
            Some(FromPayload::Thumbnail { payload, thumbnail }) => {
                if let Some(scope) = &outputs.scope {
                    scope.thumbnail(&payload, &thumbnail);
                }
                #[cfg(feature = "zenoh")]
                if let Some(fleet) = &outputs.fleet {
                    fleet.thumbnail(&payload, &thumbnail);
                }
                Some(lock(&outputs.view).thumbnail(&payload, thumbnail))
            }
        };
        if let Some(news) = news {
            // There may be no viewer.
            let _ = outputs.live.send(news);
        }
    }
}

/// The disk's thread: writes, syncs once a second, acknowledges. A failing disk is reported and tried again, and
/// nothing is acknowledged or requested meanwhile; live estimates continue.
fn keep(mut mirror: Mirror, records: &std::sync::mpsc::Receiver<Arrival>, handle: &StationHandle) {
    use std::sync::mpsc::RecvTimeoutError;
    let mut due = tokio::time::Instant::now() + SYNC;
    let mut troubled = false;
    loop {
        match records.recv_timeout(due.saturating_duration_since(tokio::time::Instant::now())) {
            Ok(arrival) => mirror.keep(&arrival),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                settle(&mirror.finish(), handle, &mut troubled);
                return;
            }
        }
        if tokio::time::Instant::now() >= due {
            settle(&mirror.sync(), handle, &mut troubled);
            due = tokio::time::Instant::now() + SYNC;
        }
    }
}

/// Reports the disk's results to the link and to the operator.
fn settle(kept: &mirror::Kept, handle: &StationHandle, troubled: &mut bool) {
    kept.done.iter().for_each(|d| handle.stored(&d.payload, d.run, &d.numbers));
    kept.lost.iter().for_each(|d| handle.forget(&d.payload, d.run, &d.numbers));
    for (payload, why) in &kept.excess {
        OperatorEvent::LinkFault.emit(payload, why);
        handle.dismiss(payload, "more channels and schemas than the limit");
    }
    handle.hold(kept.trouble.is_some());
    match &kept.trouble {
        Some(why) if !*troubled => {
            OperatorEvent::RecordingStopped.emit("disk", format!("{why}; tried again every second"))
        }
        None if *troubled => OperatorEvent::RecordingResumed.emit("disk", "flights are stored again"),
        _ => {}
    }
    *troubled = kept.trouble.is_some();
}

/// One line a second for each payload, and the link's state for the pages.
async fn report(
    handle: StationHandle,
    view: Arc<Mutex<View>>,
    live: broadcast::Sender<Arc<str>>,
    terminal: Terminal,
) -> std::io::Result<()> {
    let mut tick = tokio::time::interval(Duration::from_secs(1));
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let mut last = tokio::time::Instant::now();
    loop {
        tick.tick().await;
        let status = handle.status();
        let now = tokio::time::Instant::now();
        let passed = (now - std::mem::replace(&mut last, now)).as_secs_f64();
        let (message, lines) = {
            let mut view = lock(&view);
            let message = view.link(&status, passed, now);
            (message, status.iter().map(|s| view.line(s, now)).collect::<Vec<_>>())
        };
        let _ = live.send(message);
        terminal.status(&lines);
    }
}

/// Events for the operator, in the log and on the pages.
async fn tell(
    mut events: mpsc::Receiver<LinkEvent>,
    view: Arc<Mutex<View>>,
    live: broadcast::Sender<Arc<str>>,
) -> std::io::Result<()> {
    let clock = HostClock::start();
    while let Some(event) = events.recv().await {
        use crate::io::proto::foxglove::log::Level;
        use OperatorEvent::{LinkDown, LinkFault, LinkUp, Reloaded};
        let (of, peer, text) = match &event {
            LinkEvent::Up { peer, address } => (LinkUp, peer.as_str(), format!("connected from {address}")),
            LinkEvent::Down { peer, why } => (LinkDown, peer.as_str(), format!("disconnected: {why}")),
            LinkEvent::Refused { address, why, unreported } => {
                let more = if *unreported > 0 { format!(" ({unreported} more)") } else { String::new() };
                (LinkFault, "", format!("{address}: {why}{more}"))
            }
            LinkEvent::KeysReloaded => (Reloaded, "", "keys were read again".into()),
            LinkEvent::KeysUnusable { why } => {
                (LinkFault, "", format!("keys changed and cannot be used: {why}"))
            }
            LinkEvent::Unresolved { address, why } => (LinkFault, "", format!("{address}: {why}")),
        };
        of.emit(peer, &text);
        if !peer.is_empty() {
            let level = if of == LinkUp { Level::Info } else { Level::Warning };
            let _ = live.send(lock(&view).remark(peer, clock.now(), level as u32, &text));
        }
    }
    Ok(())
}
