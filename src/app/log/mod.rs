//! The operator's log: one bounded queue, one thread that writes, and a level that can change.

mod bridge;
mod line;
mod sink;

pub use line::{Line, Value};

use std::collections::HashMap;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use super::events::{Event, Throttle};
use crate::config::{LogConfig, LogLevel};
use crate::io::clock::HostClock;
use sink::Sinks;
use windhover_base::time::MonoTime;

/// Lines that wait to be written; when one more comes it is dropped and counted, so that a terminal
/// or disk that stalls holds nobody up.
const WAITING: usize = 512;

enum Job {
    Write(Box<Line>),
    Reopen,
    End,
}

/// A handle on the log. Copies write to the same one.
#[derive(Clone)]
pub struct Log {
    queue: SyncSender<Job>,
    level: Arc<AtomicU8>,
    lost: Arc<std::sync::atomic::AtomicU64>,
    throttles: Arc<Mutex<HashMap<(Event, String), Throttle>>>,
    clock: HostClock,
}

/// Ends the log when dropped: everything said is written first.
pub struct LogThread {
    queue: SyncSender<Job>,
    thread: Option<JoinHandle<()>>,
}

/// Starts the log.
pub fn start(config: &LogConfig, clock: HostClock) -> (Log, LogThread) {
    let (queue, jobs) = sync_channel(WAITING);
    let sinks = Sinks::new(config);
    let thread = std::thread::Builder::new().name("log".into()).spawn(move || write(&jobs, sinks)).ok();
    let log = Log {
        queue: queue.clone(),
        level: Arc::new(AtomicU8::new(config.level as u8)),
        lost: Arc::default(),
        throttles: Arc::default(),
        clock,
    };
    bridge::install(log.clone());
    (log, LogThread { queue, thread })
}

fn write(jobs: &Receiver<Job>, mut sinks: Sinks) {
    while let Ok(job) = jobs.recv() {
        match job {
            Job::Write(line) => sinks.write(&line),
            Job::Reopen => sinks.reopen(),
            Job::End => return,
        }
    }
}

impl Drop for LogThread {
    fn drop(&mut self) {
        let _ = self.queue.send(Job::End);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Log {
    /// Whether lines of this severity are shown.
    pub fn shows(&self, level: LogLevel) -> bool {
        level as u8 <= self.level.load(Ordering::Relaxed)
    }

    /// From now on shows lines of this severity and graver.
    pub fn set_level(&self, level: LogLevel) {
        self.level.store(level as u8, Ordering::Relaxed);
    }

    /// Opens the log file anew.
    pub fn reopen(&self) {
        let _ = self.queue.try_send(Job::Reopen);
    }

    /// Lines lost because they came faster than they could be written.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Writes a line as it is.
    pub fn write(&self, line: Line) {
        if self.shows(line.level) && self.queue.try_send(Job::Write(Box::new(line))).is_err() {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Tells of an operator event now, unless its throttle holds it back; `about` is what it is about
    /// (a source, a task), throttled apart.
    pub fn tell(&self, event: Event, about: &str, message: impl Into<String>) {
        self.tell_with(event, about, message, |line| line);
    }

    /// As [`Self::tell`], with more fields.
    pub fn tell_with(
        &self,
        event: Event,
        about: &str,
        message: impl Into<String>,
        fields: impl FnOnce(Line) -> Line,
    ) {
        let about = about.to_owned();
        self.tell_keyed(self.clock.now(), event, about.clone(), |line| {
            let line = line.says(message);
            fields(if about.is_empty() { line } else { line.with("about", about) })
        });
    }

    /// Tells of an operator event at a time of its own; lines of the same event and `key`, which begins with what
    /// they are about, are throttled together.
    pub fn tell_keyed(&self, t: MonoTime, event: Event, key: String, fields: impl FnOnce(Line) -> Line) {
        let held = {
            let mut throttles = self.throttles.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(over) = event.ends() {
                throttles.retain(|(held, about), _| *held != over || !about.starts_with(&key));
            }
            let throttle = throttles.entry((event, key)).or_default();
            throttle.pass(t, event.throttle())
        };
        let Some(held) = held else { return };
        let mut line = fields(Line::new(t, event.level(), event.name()));
        if held > 0 {
            line = line.count("more_like_it", held);
        }
        self.write(line);
    }
}
