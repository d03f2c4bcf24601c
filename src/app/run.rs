//! `windhover run`: start the graph, watch over it, end it cleanly.

use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};

use super::config_file::{self, ConfigFileError};
use super::events::{self, OperatorEvent as Event};
use super::log::{self, Log};
use super::topology::{self, Graph};
use super::watch::Watch;
use crate::config::Config;
use crate::io::clock::HostClock;
use crate::io::notify::ServiceManager;

/// Why the daemon ended other than by being asked to.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// No configuration, no daemon.
    #[error(transparent)]
    Config(#[from] ConfigFileError),
    /// The system refused a thread or a signal.
    #[error("cannot start: {0}")]
    Start(#[from] std::io::Error),
    /// A task panicked; the service manager starts the daemon again.
    #[error("task {0} failed; see the log")]
    TaskFailed(&'static str),
    /// The card took longer than there was time for.
    #[error("the card is too slow: the end of the flight is not on it; the next start seals what is")]
    NotWritten,
}

/// How often the health task looks round.
const ROUND: Duration = Duration::from_millis(250);

/// Longest the tasks get to end; with the store's flush inside, well under two seconds.
const ENDING: Duration = Duration::from_millis(1_600);

/// Longest a slow card gets on top of that to take the end of the flight; together less than the unit's
/// `TimeoutStopSec`.
const WRITING: Duration = Duration::from_millis(2_400);

/// Runs until asked to end.
pub fn run(config_path: &Path) -> Result<(), RunError> {
    let config = config_file::load(config_path)?;
    let clock = HostClock::start();
    let (log, log_end) = log::start(&config.log, clock);
    tell_of_panics(&log);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let result = runtime.block_on(daemon(config_path.to_owned(), config, clock, &log));
    log.settle();
    log.tell(
        Event::Stopped,
        "",
        match &result {
            Ok(()) => "everything is written".to_owned(),
            Err(error) => error.to_string(),
        },
    );
    drop(log_end);
    result
}

/// A panic is told with its place before it unwinds. The camera's thread catches its own: the V4L2
/// library panics where a device vanishes.
fn tell_of_panics(log: &Log) {
    let log = log.clone();
    std::panic::set_hook(Box::new(move |panic| {
        let thread = std::thread::current();
        let name = thread.name().unwrap_or("unnamed");
        if name != topology::CAMERA.name {
            log.tell(Event::TaskFailed, name, panic.to_string());
        }
    }));
}

/// Signals the daemon listens to.
struct Signals {
    terminate: Signal,
    interrupt: Signal,
    hang_up: Signal,
}

impl Signals {
    fn new() -> std::io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            hang_up: signal(SignalKind::hangup())?,
        })
    }
}

async fn daemon(path: PathBuf, config: Config, clock: HostClock, log: &Log) -> Result<(), RunError> {
    let mut signals = Signals::new()?;
    events::started(&path);
    let graph = topology::start(&config, clock, log)?;
    let mut watch = Watch::new(path, config, graph);
    let mut round = tokio::time::interval(ROUND);
    round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let (why, result) = loop {
        tokio::select! {
            _ = signals.terminate.recv() => break ("SIGTERM", Ok(())),
            _ = signals.interrupt.recv() => break ("SIGINT", Ok(())),
            _ = signals.hang_up.recv() => watch.reload(),
            _ = round.tick() => if let Err(failed) = watch.look_round() {
                break ("a task failed", Err(RunError::TaskFailed(failed)));
            },
        }
    };
    let written = end(watch.into_graph(), log, why);
    result.and(if written { Ok(()) } else { Err(RunError::NotWritten) })
}

/// Ends the tasks: devices first, then what waits is handled, then the card is flushed; whether it was.
fn end(mut graph: Graph, log: &Log, why: &str) -> bool {
    ServiceManager.stopping(&format!("stopping: {why}"));
    log.tell(Event::Stopping, "", why);
    graph.around.stop.ask();
    let mut late = graph.tasks.join(ENDING);
    if late.contains(&topology::STORE.name) {
        late = graph.tasks.join(WRITING);
    }
    for task in &late {
        log.tell(Event::TaskSilent, task, "did not end in time");
    }
    !late.contains(&topology::STORE.name)
}
