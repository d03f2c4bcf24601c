//! The link's task: ground stations over QUIC, and the vehicles over MAVLink.
//!
//! The pipeline's task hands records and outputs to a [`Downlink`], which never waits; this task does the rest. It also
//! runs without a card, stations or keys.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;

use crate::config::Config;
use crate::io::autopilot::ToAutopilot;
use crate::io::clock::HostClock;
use crate::io::device::blocking;
use crate::io::link::{
    Backlog, EarlyRecords, LinkError, LinkEvent, LinkHandle, LinkStatus, PayloadLink, PayloadSettings,
    Picture, StoreBacklog,
};
use crate::io::mavlink::{self, MavlinkSender, Station, StationChange};
use crate::io::records::Record;
use windhover_base::msg::{Event, EventBody, FramePayload, Output};
use windhover_base::time::UtcTime;

use super::context::TaskContext;
use super::events::OperatorEvent;
use super::flight_store::FlightStore;
use super::status::SharedStatus;
use super::supervise::Heartbeat;

/// How often the task publishes the link's state.
const ROUND: Duration = Duration::from_millis(250);
/// Pause before the link is opened again after a failure.
const AGAIN: Duration = Duration::from_secs(10);
/// How long the link waits for the card at the start.
const CARD: Duration = Duration::from_secs(2);
/// A clock below this value was never set: 2020-01-01.
const CLOCK_SET_UNIX_NS: i64 = 1_577_836_800_000_000_000;

struct Lines {
    link: Option<LinkHandle>,
    /// Records made before the link is open; `None` where the link is off.
    early: Option<EarlyRecords>,
    mavlink: Option<MavlinkSender>,
    frame: Option<FramePayload>,
}

/// The pipeline's side of the link. Copies share the same link; no call waits.
#[derive(Clone)]
pub struct Downlink {
    lines: Arc<Mutex<Lines>>,
    /// Whether the link numbers its records in the store's current run.
    one_run: Arc<AtomicBool>,
    to_autopilot: ToAutopilot,
}

impl Downlink {
    /// Made before the link is open; with a link configured, records are numbered from the first one on.
    pub fn new(config: &Config, to_autopilot: &ToAutopilot) -> Self {
        let early =
            config.link.enabled.then(|| EarlyRecords::new(&PayloadSettings::from_config(&config.link)));
        let lines = Lines { link: None, early, mavlink: None, frame: None };
        let one_run = Arc::new(AtomicBool::new(true));
        Self { lines: Arc::new(Mutex::new(lines)), one_run, to_autopilot: to_autopilot.clone() }
    }

    fn lines(&self) -> MutexGuard<'_, Lines> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends a record; returns the number under which the store keeps it for back-fill.
    pub fn record(&self, record: &Record) -> Option<u32> {
        let lines = self.lines();
        let number = match (&lines.link, &lines.early) {
            (Some(link), _) => link.send(record),
            (None, Some(early)) => early.send(record),
            (None, None) => None,
        }?;
        self.one_run.load(Ordering::Relaxed).then_some(number)
    }

    /// The store closed its flight: its later runs differ from the link's run.
    pub fn store_closed(&self) {
        self.one_run.store(false, Ordering::Relaxed);
    }

    /// Keeps a frame for the next thumbnail, where a station asks for thumbnails.
    pub fn event(&self, event: &Event) {
        if let EventBody::Frame(frame) = &event.body {
            let mut lines = self.lines();
            let wanted = lines.link.as_ref().is_some_and(LinkHandle::wants_pictures);
            lines.frame = wanted.then(|| frame.clone());
        }
    }

    /// Passes an output to MAVLink.
    pub fn mavlink(&self, output: &Output) {
        if let Some(mavlink) = &mut self.lines().mavlink {
            mavlink.output(output);
        }
    }

    /// Makes the picture of a thumbnail from the detections of a frame that was kept for it.
    pub fn picture(&self, output: &Output) {
        let mut lines = self.lines();
        let Output::Detections { frame, markers, features, .. } = output else { return };
        let Some(of) = lines.frame.take_if(|of| of.index == *frame) else { return };
        if let Some(link) = &lines.link {
            link.offer_picture(Picture { frame: of, markers: markers.clone(), features: features.clone() });
        }
    }
}

/// What the link's task works with.
pub struct LinkTask {
    /// The configuration.
    pub config: Arc<Config>,
    /// The context of every task.
    pub context: TaskContext,
    /// Where the link's state is published.
    pub status: SharedStatus,
    /// Where the back-fill is read.
    pub flight_store: FlightStore,
    /// The pipeline's side of the link.
    pub downlink: Downlink,
    /// The task's heartbeat.
    pub heartbeat: Heartbeat,
}

/// Serves stations until a stop is requested.
pub async fn run(task: LinkTask) {
    let mut beside = JoinSet::new();
    if task.config.mavlink.enabled
        && let Some(sender) = task.open_mavlink().await
    {
        let every = Duration::from_secs_f64(sender.every().s());
        task.downlink.lines().mavlink = Some(sender);
        let (downlink, status) = (task.downlink.clone(), task.status.clone());
        beside.spawn(send_mavlink(downlink, status, task.context.clock, every));
    }
    while !task.context.stop.is_cancelled() {
        if !task.config.link.enabled {
            task.show("off");
            task.heartbeat.while_waiting(task.context.stop.cancelled()).await;
            continue;
        }
        match task.open().await {
            Ok((link, handle, events)) => {
                let stop = watch::Sender::new(false);
                let serving = tokio::spawn(link.run(stop.subscribe()));
                task.attend(&handle, events).await;
                stop.send_replace(true);
                let _ = serving.await;
            }
            Err(error) => {
                task.show("fault");
                task.fault(&error);
                let pause = task.context.stop.run_until_cancelled(tokio::time::sleep(AGAIN));
                task.heartbeat.while_waiting(pause).await;
            }
        }
    }
}

async fn send_mavlink(downlink: Downlink, status: SharedStatus, clock: HostClock, every: Duration) {
    let mut tick = tokio::time::interval(every);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    loop {
        tick.tick().await;
        let names = downlink.lines().mavlink.as_mut().and_then(|mavlink| mavlink.unresolved(clock.now()));
        let found = match names {
            Some(names) => blocking(move || mavlink::look_up(names)).await,
            None => Vec::new(),
        };
        let changes = downlink.lines().mavlink.as_mut().map(|mavlink| {
            mavlink.found(found);
            mavlink.send(clock.now());
            let mut words: Vec<String> = mavlink.stations().iter().map(Station::words).collect();
            words.extend(mavlink.counts().words());
            (mavlink.news(), words.join("; "))
        });
        if let Some((news, words)) = changes {
            news.iter().for_each(tell_mavlink);
            status.with(|status| status.figures.mavlink = words);
        }
    }
}

/// Reports a change of a station that receives MAVLink.
fn tell_mavlink(news: &StationChange) {
    match &news.fault {
        Some(fault) => OperatorEvent::MavlinkFault.emit(&news.name, fault),
        None => OperatorEvent::MavlinkUp.emit(&news.name, "datagrams are sent again"),
    }
}

type Opened = (PayloadLink, LinkHandle, mpsc::Receiver<LinkEvent>);

impl LinkTask {
    fn fault(&self, why: &dyn std::fmt::Display) {
        OperatorEvent::LinkFault.emit("link", why);
    }

    fn show(&self, word: impl Into<String>) {
        let word = word.into();
        self.status.with(|status| status.figures.link = word);
    }

    async fn open_mavlink(&self) -> Option<MavlinkSender> {
        let config = Arc::clone(&self.config);
        let to_autopilot = self.downlink.to_autopilot.clone();
        let open = move || MavlinkSender::open(&config, to_autopilot);
        blocking(open).await.inspect_err(|error| self.fault(error)).ok()
    }

    async fn open(&self) -> Result<Opened, LinkError> {
        let (deep, run, flight) = self.identity().await;
        let one_run = deep.is_some();
        let settings = PayloadSettings::from_config(&self.config.link);
        // Keys are read from files, which blocks.
        let opened = blocking(move || PayloadLink::open(&settings, run, &flight, deep)).await?;
        let mut lines = self.downlink.lines();
        // If the store closed its flight meanwhile, its run stays another one.
        self.downlink.one_run.fetch_and(one_run, Ordering::Relaxed);
        if let Some(early) = lines.early.take() {
            opened.1.begin_with(early);
        }
        lines.link = Some(opened.1.clone());
        drop(lines);
        Ok(opened)
    }

    /// The number of this run: the store's, where the card answers in time, else the link's own.
    async fn identity(&self) -> (Option<Arc<dyn Backlog>>, u32, String) {
        let store = tokio::time::timeout(CARD, self.flight_store.opened());
        if self.config.store.enabled
            && let Ok(store) = self.heartbeat.while_waiting(store).await
        {
            let opening = blocking(move || StoreBacklog::open(store));
            let (backlog, run, flight) = self.heartbeat.while_waiting(opening).await;
            return (Some(Arc::new(backlog)), run, flight);
        }
        let now = self.context.clock.now().ns();
        // Nanoseconds of the start, folded to 32 bits: two starts do not share them.
        let run = (now as u64 ^ (now as u64 >> 32)) as u32 | 0x8000_0000;
        let dated = now >= CLOCK_SET_UNIX_NS;
        let flight = if dated { UtcTime::from_unix_ns(now).compact() } else { format!("boot-{run}") };
        (None, run, flight)
    }

    /// Forwards the link's events to the operator and publishes its state, until a stop is requested.
    async fn attend(&self, handle: &LinkHandle, mut events: mpsc::Receiver<LinkEvent>) {
        let mut round = tokio::time::interval(ROUND);
        round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                () = self.context.stop.cancelled() => return,
                Some(event) = events.recv() => self.tell(&event),
                _ = round.tick() => {
                    self.heartbeat.beat();
                    self.show(describe(&handle.status()));
                }
            }
        }
    }

    fn tell(&self, event: &LinkEvent) {
        use OperatorEvent::{LinkDown, LinkFault, LinkUp, Reloaded};
        let (what, about, words) = match event {
            LinkEvent::Up { peer, address } => (LinkUp, peer.as_str(), format!("connected from {address}")),
            LinkEvent::Down { peer, why } => (LinkDown, peer.as_str(), why.clone()),
            LinkEvent::Refused { address, why, unreported } => {
                (LinkFault, "link", format!("{address}: {why} ({unreported} more)"))
            }
            LinkEvent::KeysReloaded => (Reloaded, "link", "keys were read again".into()),
            LinkEvent::KeysUnusable { why } => (LinkFault, "link", why.clone()),
            LinkEvent::Unresolved { address, why } => (LinkFault, "link", format!("{address}: {why}")),
        };
        what.emit(about, words);
    }
}

/// The link's state for the health line.
fn describe(status: &LinkStatus) -> String {
    let hearing = status.stations.iter().filter(|station| station.hears_us);
    let best = hearing.clone().map(|station| station.rtt_ms).min_by(f64::total_cmp);
    match (status.stations.len(), best) {
        (0, _) => "waiting".into(),
        (n, None) => format!("{n}-silent"),
        (n, Some(rtt_ms)) => format!("{}/{n}-up-{rtt_ms:.0}ms", hearing.count()),
    }
}
