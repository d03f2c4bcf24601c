//! The link's task: ground stations over QUIC, and the vehicles as MAVLink beside it.
//!
//! The pipeline's task hands records and outputs to a [`Downlink`], which never waits; this task, with a
//! runtime of its own, does the rest. It lives on without a card, without stations, without keys.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{mpsc, watch};

use crate::config::Config;
use crate::io::clock::HostClock;
use crate::io::link::{
    Backlog, EarlyRecords, LinkEvent, LinkHandle, LinkStatus, PayloadLink, PayloadSettings, Picture,
    StoreBacklog,
};
use crate::io::mavlink::MavlinkSender;
use crate::io::records::Record;
use windhover_base::msg::{Event, EventBody, FramePayload, Output};
use windhover_base::time::{Span, UtcTime};

use super::brain::Board;
use super::card::Slot;
use super::devices::Surroundings;
use super::events::OperatorEvent;
use super::supervise::Heart;

/// How often the task looks round.
const ROUND: Duration = Duration::from_millis(100);
/// Pause before a link that could not be opened is tried again.
const AGAIN: Span = Span::from_ns(10_000_000_000);
/// How long the link waits for the card at the start.
const CARD: Span = Span::from_ns(2_000_000_000);
/// A clock that reads less was never set: 2020-01-01.
const CLOCK_SET_UNIX_NS: i64 = 1_577_836_800_000_000_000;

struct Lines {
    link: Option<LinkHandle>,
    /// What was made before there was one; `None` where there is to be none.
    early: Option<EarlyRecords>,
    mavlink: Option<MavlinkSender>,
    frame: Option<FramePayload>,
}

/// The way down, from the pipeline's side. Copies are the same; nothing here waits.
#[derive(Clone)]
pub struct Downlink {
    lines: Arc<Mutex<Lines>>,
    /// Whether the link numbers records in the run the store is in.
    one_run: Arc<AtomicBool>,
}

impl Downlink {
    /// Before anything is open; with a link configured, records are numbered from the first on.
    pub fn new(config: &Config) -> Self {
        let early =
            config.link.enabled.then(|| EarlyRecords::new(&PayloadSettings::from_config(&config.link)));
        let lines = Lines { link: None, early, mavlink: None, frame: None };
        Self { lines: Arc::new(Mutex::new(lines)), one_run: Arc::new(AtomicBool::new(true)) }
    }

    fn lines(&self) -> MutexGuard<'_, Lines> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends a record; gives the number under which the store is to keep it for back-fill.
    pub fn record(&self, record: &Record) -> Option<u32> {
        let lines = self.lines();
        let number = match (&lines.link, &lines.early) {
            (Some(link), _) => link.send(record),
            (None, Some(early)) => early.send(record),
            (None, None) => None,
        }?;
        self.one_run.load(Ordering::Relaxed).then_some(number)
    }

    /// The store closed its flight: from here on its runs are others than the link's.
    pub fn store_closed(&self) {
        self.one_run.store(false, Ordering::Relaxed);
    }

    /// Keeps a frame for the next thumbnail, where anybody wants one.
    pub fn event(&self, event: &Event) {
        if let EventBody::Frame(frame) = &event.body {
            let mut lines = self.lines();
            let wanted = lines.link.as_ref().is_some_and(LinkHandle::wants_pictures);
            lines.frame = wanted.then(|| frame.clone());
        }
    }

    /// Gives MAVLink what it needs of an output.
    pub fn mavlink(&self, output: &Output) {
        if let Some(mavlink) = &mut self.lines().mavlink {
            mavlink.output(output);
        }
    }

    /// Makes a thumbnail's picture of what was seen in a frame that was kept for it.
    pub fn picture(&self, output: &Output) {
        let mut lines = self.lines();
        let Output::Detections { frame, markers, features, .. } = output else { return };
        let Some(of) = lines.frame.take_if(|of| of.index == *frame) else { return };
        if let Some(link) = &lines.link {
            link.offer_picture(Picture { frame: of, markers: markers.clone(), features: features.clone() });
        }
    }
}

/// Serves stations until the end is asked for.
pub fn run(
    config: &Config,
    around: &Surroundings,
    board: &Board,
    slot: &Slot,
    downlink: &Downlink,
    heart: &Heart,
) {
    let fault =
        |why: &dyn std::fmt::Display| around.log.tell(OperatorEvent::LinkFault, "link", why.to_string());
    if config.mavlink.enabled {
        match MavlinkSender::open(config) {
            Ok(sender) => downlink.lines().mavlink = Some(sender),
            Err(error) => fault(&error),
        }
    }
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return fault(&error),
    };
    let task = Task { config, around, board, slot, downlink, heart };
    runtime.block_on(async {
        if config.mavlink.enabled {
            let every = Duration::from_secs_f64(1.0 / config.mavlink.rate_hz);
            tokio::spawn(send_mavlink(downlink.clone(), around.clock, every));
        }
        while !around.stop.asked() {
            if !config.link.enabled {
                task.word("off");
                task.rounds(None).await;
                continue;
            }
            match task.open().await {
                Ok((link, handle, events)) => {
                    let stop = watch::Sender::new(false);
                    let serving = tokio::spawn(link.run(stop.subscribe()));
                    task.rounds(Some((&handle, events))).await;
                    stop.send_replace(true);
                    let _ = serving.await;
                }
                Err(error) => {
                    task.word("fault");
                    fault(&error);
                    task.wait(AGAIN).await;
                }
            }
        }
    });
}

async fn send_mavlink(downlink: Downlink, clock: HostClock, every: Duration) {
    let mut tick = tokio::time::interval(every);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    loop {
        tick.tick().await;
        if let Some(mavlink) = &mut downlink.lines().mavlink {
            mavlink.send(clock.now());
        }
    }
}

type Opened = (PayloadLink, LinkHandle, mpsc::Receiver<LinkEvent>);

struct Task<'a> {
    config: &'a Config,
    around: &'a Surroundings,
    board: &'a Board,
    slot: &'a Slot,
    downlink: &'a Downlink,
    heart: &'a Heart,
}

impl Task<'_> {
    fn word(&self, word: impl Into<String>) {
        let word = word.into();
        self.board.with(|shown| shown.figures.link = word);
    }

    /// One look round: shows life.
    async fn round(&self) {
        self.heart.beat();
        tokio::time::sleep(ROUND).await;
    }

    /// Waits for what takes as long as the card does, showing life meanwhile.
    async fn while_beating<T>(&self, work: impl Future<Output = T>) -> T {
        let mut work = std::pin::pin!(work);
        loop {
            tokio::select! {
                done = &mut work => return done,
                () = self.round() => {}
            }
        }
    }

    /// Looks round for a while, or until the end is asked for.
    async fn wait(&self, length: Span) {
        let end = self.around.clock.now() + length;
        while !self.around.stop.asked() && self.around.clock.now() < end {
            self.round().await;
        }
    }

    async fn open(&self) -> Result<Opened, crate::io::link::LinkError> {
        let (deep, run, flight) = self.identity().await;
        let one_run = deep.is_some();
        let settings = PayloadSettings::from_config(&self.config.link);
        let opened = PayloadLink::open(&settings, run, &flight, deep)?;
        let mut lines = self.downlink.lines();
        // A store that closed its flight meanwhile stays another's.
        self.downlink.one_run.fetch_and(one_run, Ordering::Relaxed);
        if let Some(early) = lines.early.take() {
            opened.1.begin_with(early);
        }
        lines.link = Some(opened.1.clone());
        drop(lines);
        Ok(opened)
    }

    /// Which run this is: the store's, where the card answers soon, else one of its own.
    async fn identity(&self) -> (Option<Arc<dyn Backlog>>, u32, String) {
        let end = self.around.clock.now() + CARD;
        while self.config.store.enabled && self.slot.get().is_none() && self.around.clock.now() < end {
            self.round().await;
        }
        if let Some(store) = self.slot.get() {
            let opening = tokio::task::spawn_blocking(move || StoreBacklog::open(store));
            if let Ok((backlog, run, flight)) = self.while_beating(opening).await {
                return (Some(Arc::new(backlog)), run, flight);
            }
        }
        let now = self.around.clock.now().ns();
        // Nanoseconds of the start, folded: no two starts share them.
        let run = (now as u64 ^ (now as u64 >> 32)) as u32 | 0x8000_0000;
        let dated = now >= CLOCK_SET_UNIX_NS;
        let flight = if dated { UtcTime::from_unix_ns(now).compact() } else { format!("boot-{run}") };
        (None, run, flight)
    }

    /// Looks round until the end is asked for: events to the operator, how the link does on the board.
    async fn rounds(&self, mut link: Option<(&LinkHandle, mpsc::Receiver<LinkEvent>)>) {
        while !self.around.stop.asked() {
            self.round().await;
            if let Some((handle, events)) = &mut link {
                while let Ok(event) = events.try_recv() {
                    self.tell(&event);
                }
                self.word(describe(&handle.status()));
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
            LinkEvent::KeysReloaded => (Reloaded, "link", "keys read again".into()),
            LinkEvent::KeysUnusable { why } => (LinkFault, "link", why.clone()),
            LinkEvent::Unresolved { address, why } => (LinkFault, "link", format!("{address}: {why}")),
        };
        self.around.log.tell(what, about, words);
    }
}

/// The link in a few words, for the health line.
fn describe(status: &LinkStatus) -> String {
    let hearing = status.stations.iter().filter(|station| station.hears_us);
    let best = hearing.clone().map(|station| station.rtt_ms).min_by(f64::total_cmp);
    match (status.stations.len(), best) {
        (0, _) => "waiting".into(),
        (n, None) => format!("{n}-silent"),
        (n, Some(rtt_ms)) => format!("{}/{n}-up-{rtt_ms:.0}ms", hearing.count()),
    }
}
