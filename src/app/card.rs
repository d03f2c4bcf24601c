//! The data card's task: keeps the store running, closes it when power goes, tells what it has to say.

use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::config::{Config, Part};
use crate::io::clock::HostClock;
use crate::io::device::Stop;
use crate::io::store::{Recording, Store, StoreHandle, StoreNotice, StoreStatus};
use windhover_base::time::Span;

use super::brain::Board;
use super::devices::Surroundings;
use super::events::OperatorEvent as Event;
use super::health::CardFigures;
use super::presence::PartState;
use super::supervise::Heart;

/// The store, while it runs; nothing while power is going. Copies are the same slot.
#[derive(Clone, Debug, Default)]
pub struct Slot(Arc<Mutex<Option<StoreHandle>>>);

impl Slot {
    /// The store, where it runs.
    pub fn get(&self) -> Option<StoreHandle> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set(&self, handle: Option<StoreHandle>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = handle;
    }
}

/// What the card's task listens to.
#[derive(Clone, Debug, Default)]
pub struct CardOrders {
    /// The pipeline has said its last word.
    pub last_word: Stop,
    /// Power is going: close the flight and wait.
    pub power_going: Arc<std::sync::atomic::AtomicBool>,
}

impl CardOrders {
    fn power_goes(&self) -> bool {
        self.power_going.load(std::sync::atomic::Ordering::Acquire)
    }
}

/// How often the task looks round.
const ROUND: Duration = Duration::from_millis(50);
/// Longest the flight is kept open for a pipeline that does not end.
const LAST_WORD: Span = Span::from_ns(1_000_000_000);

/// Starts the store into the slot before there is a pipeline, so that a flight begins with the first
/// thing heard; `None` where nothing is to be kept.
pub fn open(config: &Config, clock: HostClock, slot: &Slot) -> Option<Opened> {
    // A configuration that was checked can be written.
    let text = config.to_toml().unwrap_or_default();
    let (store, notices) = config.store.enabled.then(|| Store::start(config, text, clock))?;
    slot.set(Some(store.handle()));
    Some(Opened { store, notices })
}

/// A store that was started, and what it has to tell.
pub struct Opened {
    store: Store,
    notices: Receiver<StoreNotice>,
}

/// Keeps the store running until the pipeline has said its last word after the end was asked for.
pub fn run(
    config: &Config,
    around: &Surroundings,
    board: &Board,
    (slot, mut opened): (&Slot, Option<Opened>),
    orders: &CardOrders,
    heart: &Heart,
) {
    if !config.store.enabled {
        board
            .with(|shown| shown.figures.card = CardFigures { state: "off".into(), ..CardFigures::default() });
        around.presence.set(Part::Store, PartState::Delivers);
        while !around.stop.asked() {
            heart.beat();
            std::thread::sleep(ROUND);
        }
        return;
    }
    while let Some(Opened { store, notices }) = opened.take().or_else(|| open(config, around.clock, slot)) {
        let ended = attend(&store, &notices, around, board, orders, heart);
        slot.set(None);
        store.stop();
        tell_all(&notices, around);
        heart.beat();
        if ended {
            return;
        }
        around.log.tell(Event::FlightClosed, "", "power is going: everything is on the card");
        board.with(|shown| shown.figures.card.state = "closed".into());
        while orders.power_goes() {
            heart.beat();
            if around.stop.asked() {
                return;
            }
            std::thread::sleep(ROUND);
        }
    }
}

/// Attends to a running store; whether the end was asked for (else power is going).
fn attend(
    store: &Store,
    notices: &Receiver<StoreNotice>,
    around: &Surroundings,
    board: &Board,
    orders: &CardOrders,
    heart: &Heart,
) -> bool {
    let handle = store.handle();
    let mut end = None;
    loop {
        heart.beat();
        tell_all(notices, around);
        show(&handle.status(), around, board);
        if around.stop.asked() {
            let now = around.clock.now();
            if orders.last_word.asked() || now - *end.get_or_insert(now) > LAST_WORD {
                return true;
            }
        } else if orders.power_goes() {
            return false;
        }
        std::thread::sleep(ROUND);
    }
}

fn tell_all(notices: &Receiver<StoreNotice>, around: &Surroundings) {
    for notice in notices.try_iter() {
        around.log.tell((&notice).into(), "card", notice.to_string());
    }
}

fn show(status: &StoreStatus, around: &Surroundings, board: &Board) {
    let (state, part) = match &status.recording {
        Recording::Starting => ("starting", PartState::Open),
        Recording::On => ("ok", PartState::Delivers),
        Recording::Stopped(_) => ("stopped", PartState::Down("stopped".into())),
        Recording::Off => ("off", PartState::Down("off".into())),
    };
    if around.presence.get(Part::Store) != part {
        around.presence.set(Part::Store, part);
    }
    let figures = CardFigures {
        state: state.into(),
        free_mb: status.free_mb.map(|mb| mb as f64),
        sync_p99: (status.fsync_p99_ms > 0.0).then(|| Span::from_ms(status.fsync_p99_ms)),
        dropped: status.dropped_messages,
    };
    board.with(|shown| shown.figures.card = figures);
}
