//! `windhover run`: starts the task graph, supervises it, ends it cleanly.

use std::path::Path;
use std::time::Duration;

use tokio::runtime::Runtime;
use tracing::Instrument as _;

use super::config_file::{ConfigFileError, Loaded};
use super::context::TaskContext;
use super::events::{self, OperatorEvent};
use super::log::{self, Log};
use super::reload::Reloading;
use super::signals::{SignalRequest, Signals};
use super::supervise::{Supervisor, running_task};
use super::topology::{self, Graph};
use super::watch::Watch;
use crate::io::clock::HostClock;
use crate::io::device::panics_are_caught;
use crate::io::notify::ServiceManager;

/// Why the daemon ended without a request.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The configuration could not be loaded.
    #[error(transparent)]
    Config(#[from] ConfigFileError),
    /// The system refused a thread or a signal.
    #[error("cannot start: {0}")]
    Start(#[from] std::io::Error),
    /// A task panicked; the service manager restarts the daemon.
    #[error("task {0} failed; see the log")]
    TaskFailed(&'static str),
    /// The card took longer than the time available.
    #[error(
        "the card is too slow: the end of the flight is not on it; the next start seals the part that is"
    )]
    NotWritten,
    /// The card was gone, full or failing at the end.
    #[error("the end of the flight is not on the card: {0}")]
    Lost(String),
}

/// Period of the health task's checks.
const ROUND: Duration = Duration::from_millis(250);

/// Longest time for the tasks to end; with the store's flush included, well under two seconds.
const ENDING: Duration = Duration::from_millis(1_600);

/// Additional time for a slow card to take the end of the flight; together less than the unit's `TimeoutStopSec`.
const WRITING: Duration = Duration::from_millis(2_400);

/// Threads of the runtime that poll tasks. One is enough for the load; with two, a task that copies a frame or encrypts
/// a packet does not delay another task's stamp.
const WORKERS: usize = 2;

/// Most threads for blocking operations: opening and closing devices, reading files, thumbnails, back-fill. An
/// operation that hangs makes its task silent.
const BLOCKING: usize = 32;

/// The runtime, and the signals received since it was made.
#[derive(Debug)]
pub struct Prepared {
    runtime: Runtime,
    signals: Signals,
}

/// Makes the runtime and takes over the signals. The daemon does this first, so that a signal within its first
/// millisecond is handled like any other.
pub fn prepare() -> std::io::Result<Prepared> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(WORKERS)
        .max_blocking_threads(BLOCKING)
        .thread_name("runtime")
        .enable_all()
        .build()?;
    let signals = {
        let _entered = runtime.enter();
        Signals::new()?
    };
    Ok(Prepared { runtime, signals })
}

/// Runs until a stop is requested.
pub fn run(prepared: Prepared, config_path: &Path) -> Result<(), RunError> {
    let Prepared { runtime, mut signals } = prepared;
    let result = runtime.block_on(daemon(config_path, &mut signals));
    // A thread that still reads a slow file is abandoned.
    runtime.shutdown_background();
    result
}

async fn daemon(path: &Path, signals: &mut Signals) -> Result<(), RunError> {
    let mut reloading = Reloading::new(path);
    let Some(loaded) = first_load(&mut reloading, signals).await? else { return Ok(()) };
    let clock = HostClock::start();
    let (log, log_end) = log::start(&loaded.config.log, clock);
    report_panics();
    events::started(path);
    let result = fly(loaded, reloading, signals, clock, &log).instrument(events::run_span(clock.now())).await;
    log.settle();
    match &result {
        Ok(words) => OperatorEvent::Stopped.emit("", words),
        Err(error) => OperatorEvent::Stopped.emit("", error),
    }
    drop(log_end);
    result.map(drop)
}

/// Reads the configuration; `None` where a stop was requested meanwhile.
async fn first_load(
    reloading: &mut Reloading,
    signals: &mut Signals,
) -> Result<Option<Loaded>, ConfigFileError> {
    reloading.ask();
    loop {
        tokio::select! {
            loaded = reloading.read() => match loaded {
                // A signal requested another read meanwhile.
                _ if reloading.reads() => {}
                loaded => return loaded.map(Some),
            },
            asked = signals.next() => match asked {
                SignalRequest::End(_) => return Ok(None),
                SignalRequest::Reload => reloading.ask(),
            },
        }
    }
}

/// Reports a panic with its place before it unwinds, unless it is caught.
fn report_panics() {
    std::panic::set_hook(Box::new(|panic| {
        if !panics_are_caught() {
            OperatorEvent::TaskFailed.emit(&running_task(), panic);
        }
    }));
}

/// Runs the task graph; this is the health task, which handles signals and notifies the watchdog. Returns what was
/// written, as text.
async fn fly(
    loaded: Loaded,
    mut reloading: Reloading,
    signals: &mut Signals,
    clock: HostClock,
    log: &Log,
) -> Result<String, RunError> {
    let config = loaded.config.clone();
    let Graph { context, status, orders, power, exposure, mut tasks } = topology::start(loaded, clock)?;
    let mut watch =
        Watch::new(config, context.clone(), log.clone(), (status.clone(), orders, power, exposure));
    let mut round = tokio::time::interval(ROUND);
    round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let (why, result) = loop {
        tokio::select! {
            asked = signals.next() => match asked {
                SignalRequest::End(signal) => break (signal, Ok(())),
                SignalRequest::Reload => {
                    watch.reloading();
                    reloading.ask();
                }
            },
            task = tasks.ended() => {
                OperatorEvent::TaskFailed.emit(task, "ended unexpectedly");
                break ("a task failed", Err(RunError::TaskFailed(task)));
            }
            news = watch.power_news() => watch.power(news),
            read = reloading.read() => watch.reload(read.map(|loaded| loaded.config)),
            _ = round.tick() => watch.look_round(&tasks),
        }
    };
    let written = end(&mut tasks, &context, why).await;
    result?;
    match status.with(|status| status.outcome.clone()) {
        _ if !written => Err(RunError::NotWritten),
        Some(Err(why)) => Err(RunError::Lost(why)),
        Some(Ok(words)) => Ok(words),
        None => Ok("nothing was to be recorded".into()),
    }
}

/// Ends the tasks: first the devices, then queued events are handled, then the card is flushed; returns whether it was.
async fn end(tasks: &mut Supervisor, context: &TaskContext, why: &str) -> bool {
    ServiceManager.stopping(&format!("stopping: {why}"));
    OperatorEvent::Stopping.emit("", why);
    context.stop.cancel();
    context.events.wake();
    let mut late = tasks.join(ENDING).await;
    if late.contains(&topology::STORE.name) {
        late = tasks.join(WRITING).await;
    }
    for task in &late {
        OperatorEvent::TaskSilent.emit(task, "did not end in time");
    }
    !late.contains(&topology::STORE.name)
}
