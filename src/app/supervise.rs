//! Tasks with a name, a restart rule and a heartbeat, and which of them answer.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tracing::Instrument as _;

use crate::io::clock::HostClock;
use windhover_base::time::{MonoTime, Span};

/// What happens when a task cannot continue.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Restart {
    /// It tries again itself, with growing pauses: devices, card, link.
    Retries,
    /// The process ends and the service manager restarts it: a task that computes has no other way to a known good
    /// state.
    EndsProcess,
}

impl Restart {
    /// The rule in words, for the log.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Retries => "retries",
            Self::EndsProcess => "ends the process",
        }
    }
}

/// A task as the topology lists it. A task of either rule that panics ends the process.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct TaskRule {
    /// Its name, in the log and of its thread where it has one.
    pub name: &'static str,
    /// What happens when it cannot continue.
    pub restart: Restart,
}

/// Heartbeat period of a waiting task.
const BEAT: Duration = Duration::from_millis(250);

/// A task's heartbeat. Copies share the same heartbeat.
#[derive(Clone, Debug)]
pub struct Heartbeat {
    last_ns: Arc<AtomicI64>,
    clock: HostClock,
}

impl Heartbeat {
    /// A heartbeat with a beat now.
    pub fn new(clock: HostClock) -> Self {
        let heartbeat = Self { last_ns: Arc::new(AtomicI64::new(0)), clock };
        heartbeat.beat();
        heartbeat
    }

    /// Records that the task answers.
    pub fn beat(&self) {
        self.last_ns.store(self.clock.now().ns(), Ordering::Relaxed);
    }

    /// Waits, with heartbeats meanwhile.
    pub async fn while_waiting<T>(&self, work: impl Future<Output = T>) -> T {
        let mut work = std::pin::pin!(work);
        loop {
            self.beat();
            if let Ok(done) = tokio::time::timeout(BEAT, &mut work).await {
                return done;
            }
        }
    }

    /// Time since the task last answered.
    pub fn silence(&self) -> Span {
        self.clock.now() - MonoTime::from_ns(self.last_ns.load(Ordering::Relaxed))
    }
}

tokio::task_local! {
    /// Name of the task that runs here.
    static NAME: &'static str;
}

/// Name of the task on the calling thread: of an async task, else of the thread.
pub fn running_task() -> String {
    let thread = || std::thread::current().name().unwrap_or("unnamed").to_owned();
    NAME.try_with(|name| (*name).to_owned()).unwrap_or_else(|_| thread())
}

struct Task {
    rule: TaskRule,
    heartbeat: Heartbeat,
    id: tokio::task::Id,
}

/// All tasks, on the runtime and on their own threads.
pub struct Supervisor {
    clock: HostClock,
    running: JoinSet<()>,
    tasks: Vec<Task>,
}

impl Supervisor {
    /// A supervisor without tasks.
    pub fn new(clock: HostClock) -> Self {
        Self { clock, running: JoinSet::new(), tasks: Vec::new() }
    }

    /// Starts a task on the runtime; `body` beats the heartbeat that it gets and never blocks.
    pub fn spawn<F>(&mut self, rule: TaskRule, body: impl FnOnce(Heartbeat) -> F)
    where
        F: Future<Output = ()> + Send + 'static,
    {
        let heartbeat = Heartbeat::new(self.clock);
        let task = NAME.scope(rule.name, body(heartbeat.clone()));
        self.keep(rule, heartbeat, task);
    }

    /// Starts a task that computes or blocks, on its own thread; `body` beats the heartbeat that it gets.
    pub fn spawn_thread(
        &mut self,
        rule: TaskRule,
        body: impl FnOnce(Heartbeat) + Send + 'static,
    ) -> std::io::Result<()> {
        let heartbeat = Heartbeat::new(self.clock);
        let beating = heartbeat.clone();
        // Dropped when the body returns and when it panics.
        let (running, ended) = oneshot::channel::<()>();
        let span = tracing::Span::current();
        std::thread::Builder::new().name(rule.name.to_owned()).spawn(move || {
            let _running = running;
            span.in_scope(|| body(beating));
        })?;
        self.keep(rule, heartbeat, async move {
            let _ = ended.await;
        });
        Ok(())
    }

    fn keep(
        &mut self,
        rule: TaskRule,
        heartbeat: Heartbeat,
        task: impl Future<Output = ()> + Send + 'static,
    ) {
        let id = self.running.spawn(task.in_current_span()).id();
        self.tasks.push(Task { rule, heartbeat, id });
    }

    /// Tasks that have not answered for longer than `limit`, each with that time.
    pub fn silent(&self, limit: Span) -> Vec<(&'static str, Span)> {
        let silences = self.tasks.iter().map(|task| (task.rule.name, task.heartbeat.silence()));
        silences.filter(|(_, silence)| *silence > limit).collect()
    }

    /// Waits until a task ends, with or without a panic; returns its name. Without end where there is no task.
    pub async fn ended(&mut self) -> &'static str {
        loop {
            let id = match self.running.join_next_with_id().await {
                Some(Ok((id, ()))) => id,
                Some(Err(panicked)) => panicked.id(),
                None => std::future::pending().await,
            };
            if let Some(at) = self.tasks.iter().position(|task| task.id == id) {
                return self.tasks.swap_remove(at).rule.name;
            }
        }
    }

    /// Waits for the tasks to end, until `patience` is over; returns the names of those that did not.
    pub async fn join(&mut self, patience: Duration) -> Vec<&'static str> {
        let limit = tokio::time::Instant::now() + patience;
        while !self.tasks.is_empty() && tokio::time::timeout_at(limit, self.ended()).await.is_ok() {}
        self.tasks.iter().map(|task| task.rule.name).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULE: TaskRule = TaskRule { name: "test", restart: Restart::EndsProcess };

    #[tokio::test]
    async fn a_task_that_hangs_is_silent_and_one_that_panics_has_ended() {
        let mut tasks = Supervisor::new(HostClock::start());
        let (sender, receiver) = std::sync::mpsc::channel::<()>();
        tasks
            .spawn_thread(RULE, move |heartbeat| {
                heartbeat.beat();
                let _ = receiver.recv();
            })
            .expect("a thread");
        assert!(tasks.silent(Span::from_s(5.0)).is_empty());
        tokio::time::sleep(Duration::from_millis(30)).await;
        assert_eq!(tasks.silent(Span::from_ms(10.0)).first().map(|s| s.0), Some("test"));
        assert_eq!(tasks.join(Duration::from_millis(10)).await, ["test"]);
        drop(sender);
        assert!(tasks.join(Duration::from_secs(2)).await.is_empty());

        let named = TaskRule { name: "named", ..RULE };
        tasks.spawn(RULE, |_| std::future::pending());
        tasks.spawn(named, |_| async {
            assert_eq!(running_task(), "named");
            panic!("the panic of a task");
        });
        assert_eq!(tasks.ended().await, "named");
        tasks.spawn_thread(named, |_| panic!("the panic of a thread")).expect("a thread");
        assert_eq!(tasks.ended().await, "named");
        assert_eq!(tasks.join(Duration::from_millis(10)).await, ["test"]);
    }
}
