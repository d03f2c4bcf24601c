//! Tasks as threads with a name, a restart rule and a heartbeat, and who of them answers.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::io::clock::HostClock;
use windhover_base::time::{MonoTime, Span};

/// What happens when a task cannot go on.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Restart {
    /// It tries again by itself, waiting longer each time: devices, card, link.
    Retries,
    /// The process ends and the service manager starts it again: what computes has no other way to a
    /// state that is known to be good.
    EndsProcess,
}

impl Restart {
    /// In a word, for the log.
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
    /// Its name: of its thread, in the log, in the configuration.
    pub name: &'static str,
    /// What happens when it cannot go on.
    pub restart: Restart,
}

/// A task's heartbeat. Copies are the same heart.
#[derive(Clone, Debug)]
pub struct Heart {
    last_ns: Arc<AtomicI64>,
    clock: HostClock,
}

impl Heart {
    /// A heart that beat just now.
    pub fn new(clock: HostClock) -> Self {
        let heart = Self { last_ns: Arc::new(AtomicI64::new(0)), clock };
        heart.beat();
        heart
    }

    /// The task answers.
    pub fn beat(&self) {
        self.last_ns.store(self.clock.now().ns(), Ordering::Relaxed);
    }

    /// How long ago the task last answered.
    pub fn silence(&self) -> Span {
        self.clock.now() - MonoTime::from_ns(self.last_ns.load(Ordering::Relaxed))
    }
}

struct Task {
    rule: TaskRule,
    heart: Heart,
    thread: Option<JoinHandle<()>>,
}

/// All tasks.
pub struct Supervisor {
    clock: HostClock,
    tasks: Vec<Task>,
}

impl Supervisor {
    /// No tasks yet.
    pub const fn new(clock: HostClock) -> Self {
        Self { clock, tasks: Vec::new() }
    }

    /// Starts a task on a thread of its own; `body` beats the heart it is given.
    pub fn spawn(
        &mut self,
        rule: TaskRule,
        body: impl FnOnce(Heart) + Send + 'static,
    ) -> std::io::Result<()> {
        let heart = Heart::new(self.clock);
        let thread = std::thread::Builder::new().name(rule.name.to_owned()).spawn({
            let heart = heart.clone();
            move || body(heart)
        })?;
        self.tasks.push(Task { rule, heart, thread: Some(thread) });
        Ok(())
    }

    /// Watches the heart of a task that runs elsewhere (in a runtime of its own).
    pub fn watch(&mut self, rule: TaskRule, heart: Heart) {
        self.tasks.push(Task { rule, heart, thread: None });
    }

    /// Tasks that have not answered for longer than `limit`, and for how long.
    pub fn silent(&self, limit: Span) -> Vec<(&'static str, Span)> {
        let silences = self.tasks.iter().map(|task| (task.rule.name, task.heart.silence()));
        silences.filter(|(_, silence)| *silence > limit).collect()
    }

    /// Tasks whose thread has ended.
    pub fn ended(&self) -> Vec<TaskRule> {
        let ended = |task: &&Task| task.thread.as_ref().is_some_and(JoinHandle::is_finished);
        self.tasks.iter().filter(ended).map(|task| task.rule).collect()
    }

    /// Waits for the threads to end, until `patience` is over; names of those that did not.
    pub fn join(&mut self, patience: Duration) -> Vec<&'static str> {
        let limit = self.clock.now() + Span::from_s(patience.as_secs_f64());
        while self.clock.now() < limit && self.tasks.iter().any(runs) {
            std::thread::sleep(Duration::from_millis(5));
        }
        let late = self.tasks.iter().filter(|task| runs(task)).map(|task| task.rule.name).collect();
        for task in self.tasks.iter_mut().filter(|task| !runs(task)) {
            if let Some(thread) = task.thread.take() {
                // A panic was told when it happened.
                let _ = thread.join();
            }
        }
        late
    }
}

fn runs(task: &Task) -> bool {
    task.thread.as_ref().is_some_and(|thread| !thread.is_finished())
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULE: TaskRule = TaskRule { name: "test", restart: Restart::EndsProcess };

    #[test]
    fn a_task_that_hangs_is_silent_and_one_that_panics_has_ended() {
        let clock = HostClock::start();
        let mut tasks = Supervisor::new(clock);
        let (sender, receiver) = std::sync::mpsc::channel::<()>();
        tasks
            .spawn(RULE, move |heart| {
                heart.beat();
                let _ = receiver.recv();
            })
            .expect("a thread");
        assert!(tasks.silent(Span::from_s(5.0)).is_empty());
        std::thread::sleep(Duration::from_millis(30));
        assert_eq!(tasks.silent(Span::from_ms(10.0)).first().map(|s| s.0), Some("test"));
        assert_eq!(tasks.join(Duration::from_millis(10)), ["test"]);
        assert!(tasks.ended().is_empty());
        drop(sender);
        assert!(tasks.join(Duration::from_secs(2)).is_empty());
    }
}
