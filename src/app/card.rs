//! The data card's task: it keeps the store running, closes it before power fails, and forwards its notices.

use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use crate::config::{Config, Part};
use crate::io::clock::HostClock;
use crate::io::device::blocking;
use crate::io::store::{Recording, Store, StoreNotice, StoreStatus};
use windhover_base::time::{MonoTime, Span};

use super::context::TaskContext;
use super::events::{self, OperatorEvent};
use super::flight_store::{FlightStore, StoreOrders};
use super::health::CardFigures;
use super::presence::PartState;
use super::status::SharedStatus;
use super::supervise::Heartbeat;

/// How often the task forwards the store's notices and publishes its state.
const ROUND: Duration = Duration::from_millis(100);
/// How long the flight stays open at most for a pipeline that does not end.
const PIPELINE_ENDS: Duration = Duration::from_secs(1);

/// A store that was started, and what it reports.
pub struct OpenStore {
    store: Store,
    notices: Receiver<StoreNotice>,
}

/// Starts the store before there is a pipeline, so that a flight begins with the first event; `None` where the
/// configuration records nothing.
pub fn open(config: &Config, clock: HostClock, flight_store: &FlightStore) -> Option<OpenStore> {
    // A configuration that passed its checks can be written as TOML.
    let text = config.to_toml().unwrap_or_default();
    let (store, notices) = config.store.enabled.then(|| Store::start(&config.store, text, clock))?;
    flight_store.set(Some(store.handle()));
    Some(OpenStore { store, notices })
}

/// While a flight is shorter than this, its data rate is not known.
const SETTLED: Span = Span::from_ns(10_000_000_000);

/// How long a flight has been recorded, and how long the card lasts at its data rate.
#[derive(Default)]
struct CardPace {
    /// When recording began, the flight's bytes at that time, and its bytes at the last call.
    begun: Option<(MonoTime, u64, u64)>,
}

impl CardPace {
    /// Takes the store's current state; returns the time recorded and the time left.
    fn take(&mut self, store: &StoreStatus, now: MonoTime) -> (Option<Span>, Option<Span>) {
        if store.recording != Recording::On {
            self.begun = None;
            return (None, None);
        }
        let written = store.bytes_written;
        // Fewer bytes than at the last call: this is another flight.
        let (began, first, _) =
            self.begun.filter(|(_, _, last)| *last <= written).unwrap_or((now, written, written));
        self.begun = Some((began, first, written));
        let recording = now - began;
        let pace = (written - first) as f64 / recording.s();
        let left = store.free_mb.map(|mb| mb as f64 * 1e6 / pace);
        let known = recording >= SETTLED && pace > 0.0;
        (Some(recording), left.filter(|_| known).map(Span::from_s))
    }
}

/// Why a store is closed.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Closing {
    /// The daemon is stopping.
    End,
    /// Power is about to fail.
    Power,
}

/// What the store's task works with.
pub struct StoreTask {
    /// The configuration.
    pub config: Arc<Config>,
    /// The context of every task.
    pub context: TaskContext,
    /// Where the card's state is published.
    pub status: SharedStatus,
    /// Where the other tasks find the store.
    pub flight_store: FlightStore,
    /// Requests to the store.
    pub orders: StoreOrders,
    /// The task's heartbeat.
    pub heartbeat: Heartbeat,
}

/// Runs the store until a stop is requested and the pipeline has handed over its last output.
pub async fn run(task: StoreTask, mut opened: Option<OpenStore>) {
    if !task.config.store.enabled {
        task.show_state("off");
        task.context.presence.set(Part::Store, PartState::Delivers);
        return task.heartbeat.while_waiting(task.context.stop.cancelled()).await;
    }
    while let Some(OpenStore { store, mut notices }) = opened.take() {
        let why = task.attend(&store, &mut notices).await;
        task.close(store, notices).await;
        if why == Closing::End {
            return;
        }
        let outcome = task.status.with(|status| status.outcome.clone());
        let words = match outcome {
            Some(Err(why)) => format!("power is failing: NOT everything is on the card: {why}"),
            Some(Ok(words)) => format!("power is failing: {words}"),
            None => "power is failing".into(),
        };
        OperatorEvent::FlightClosed.emit("", words);
        task.show_state("closed");
        let mut power = task.orders.power_going.subscribe();
        let back = async { power.wait_for(|going| !going).await.is_ok() };
        let back = task.context.stop.run_until_cancelled(back);
        if task.heartbeat.while_waiting(back).await.is_none() {
            return;
        }
        let (config, clock, store) =
            (Arc::clone(&task.config), task.context.clock, task.flight_store.clone());
        opened = blocking(move || open(&config, clock, &store)).await;
    }
}

impl StoreTask {
    /// Serves a running store until it has to be closed.
    async fn attend(&self, store: &Store, notices: &mut Receiver<StoreNotice>) -> Closing {
        let handle = store.handle();
        let mut power = self.orders.power_going.subscribe();
        let mut round = tokio::time::interval(ROUND);
        round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let mut pace = CardPace::default();
        let mut end = std::pin::pin!(self.end());
        loop {
            tokio::select! {
                () = &mut end => return Closing::End,
                Ok(_) = power.wait_for(|going| *going), if !self.context.stop.is_cancelled() => {
                    return Closing::Power;
                }
                _ = round.tick() => {
                    self.heartbeat.beat();
                    self.report(notices);
                    self.show(&handle.status(), &mut pace);
                }
            }
        }
    }

    /// Waits until a stop is requested and the pipeline has handed over all its outputs.
    async fn end(&self) {
        self.context.stop.cancelled().await;
        let _ = tokio::time::timeout(PIPELINE_ENDS, self.orders.pipeline_done.cancelled()).await;
    }

    /// Closes the flight and waits for the card.
    async fn close(&self, store: Store, notices: Receiver<StoreNotice>) {
        self.flight_store.set(None);
        let handle = store.handle();
        let closed = blocking(move || {
            store.stop();
            notices
        });
        self.report(&mut closed.await);
        let outcome = handle.status().outcome();
        self.status.with(|status| status.outcome = Some(outcome));
        self.heartbeat.beat();
    }

    fn report(&self, notices: &mut Receiver<StoreNotice>) {
        for notice in notices.try_iter() {
            match &notice {
                StoreNotice::Started { flight } | StoreNotice::Resumed { flight } => events::flight(flight),
                StoreNotice::Named { to, .. } => events::flight(to),
                _ => {}
            }
            OperatorEvent::from(&notice).emit("card", &notice);
        }
    }

    fn show_state(&self, state: &str) {
        self.status.with(|status| status.figures.card.state = state.into());
    }

    fn show(&self, store: &StoreStatus, pace: &mut CardPace) {
        let (state, part) = match &store.recording {
            Recording::Starting => ("starting", PartState::Open),
            Recording::On => ("ok", PartState::Delivers),
            Recording::Stopped(_) => ("stopped", PartState::Down("stopped".into())),
            Recording::Off => ("off", PartState::Down("off".into())),
        };
        if self.context.presence.get(Part::Store) != part {
            self.context.presence.set(Part::Store, part);
        }
        let (recording, left) = pace.take(store, self.context.clock.now());
        let figures = CardFigures {
            state: state.into(),
            flight: store.flight.clone(),
            free_mb: store.free_mb.map(|mb| mb as f64),
            sync_p99: (store.fsync_p99_ms > 0.0).then(|| Span::from_ms(store.fsync_p99_ms)),
            dropped: store.dropped_messages,
            recording,
            left,
        };
        self.status.with(|status| status.figures.card = figures);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_follows_from_the_flights_own_pace() {
        let mut pace = CardPace::default();
        let at = |s: f64| MonoTime::default() + Span::from_s(s);
        let store = |bytes_written| StoreStatus {
            recording: Recording::On,
            free_mb: Some(1_000),
            bytes_written,
            ..StoreStatus::default()
        };
        assert_eq!(pace.take(&StoreStatus::default(), at(0.0)), (None, None), "nothing is recorded yet");
        assert_eq!(pace.take(&store(0), at(1.0)), (Some(Span::ZERO), None));
        assert_eq!(
            pace.take(&store(5_000_000), at(6.0)),
            (Some(Span::from_s(5.0)), None),
            "too short to tell"
        );
        let reported = pace.take(&store(20_000_000), at(21.0));
        assert_eq!(reported, (Some(Span::from_s(20.0)), Some(Span::from_s(1_000.0))));
        // Another flight starts from zero.
        assert_eq!(pace.take(&store(10), at(22.0)), (Some(Span::ZERO), None));
    }
}
