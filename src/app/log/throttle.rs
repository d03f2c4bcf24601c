//! The layer that suppresses lines that come too often about the same subject.

use std::cell::Cell;
use std::collections::HashMap;
use std::fmt::Debug;
use std::sync::{Mutex, PoisonError};

use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::layer::{Context, Layer};

use crate::app::events::OperatorEvent;
use crate::io::clock::HostClock;
use windhover_base::time::{MonoTime, Span};

/// What is throttled together: the same event about the same subject, with the same cause.
#[derive(Clone, PartialEq, Eq, Hash, Debug)]
struct Key {
    event: OperatorEvent,
    /// Source, target, task or peer; empty where the subject is the daemon.
    about: String,
    /// Kind of a device's fault; empty elsewhere.
    fault: String,
}

/// An event that passed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Passed {
    /// Its time, the same for every sink.
    pub(super) t: MonoTime,
    /// How many similar events were suppressed since the last that passed.
    pub(super) held: u64,
}

thread_local! {
    /// The operator event that this thread is emitting: sinks are called after the throttle, on the same thread.
    static PASSED: Cell<Option<Passed>> = const { Cell::new(None) };
}

/// The operator event that this thread is emitting; `None` where nothing is throttled.
pub(super) fn passed() -> Option<Passed> {
    PASSED.get()
}

/// Suppresses events by the throttles of their rows.
pub(super) struct Throttle {
    clock: HostClock,
    gates: Mutex<HashMap<Key, Gate>>,
}

impl Throttle {
    /// A throttle that has passed nothing yet.
    pub(super) fn new(clock: HostClock) -> Self {
        Self { clock, gates: Mutex::default() }
    }

    /// Decides at `t` about an event; `None` where it is suppressed.
    fn judge(&self, key: Key, t: MonoTime) -> Option<Passed> {
        let mut gates = self.gates.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(over) = key.event.ends() {
            gates.retain(|gate, _| gate.event != over || gate.about != key.about);
        }
        let every = key.event.throttle();
        if every == Span::ZERO {
            return Some(Passed { t, held: 0 });
        }
        let held = gates.entry(key).or_default().pass(t, every)?;
        Some(Passed { t, held })
    }
}

impl<S: Subscriber> Layer<S> for Throttle {
    fn event_enabled(&self, event: &Event<'_>, _: Context<'_, S>) -> bool {
        let Some(row) = OperatorEvent::of(event.metadata()) else { return true };
        let mut subject = Subject::default();
        event.record(&mut subject);
        let t = subject.t.unwrap_or_else(|| self.clock.now());
        let passed = self.judge(Key { event: row, about: subject.about, fault: subject.fault }, t);
        PASSED.set(passed);
        passed.is_some()
    }
}

/// The subject of an event.
#[derive(Default)]
struct Subject {
    t: Option<MonoTime>,
    about: String,
    fault: String,
}

impl Visit for Subject {
    fn record_i64(&mut self, field: &Field, value: i64) {
        if field.name() == "t_ns" {
            self.t = Some(MonoTime::from_ns(value));
        }
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        match field.name() {
            "about" => value.clone_into(&mut self.about),
            "fault" => value.clone_into(&mut self.fault),
            _ => {}
        }
    }

    fn record_debug(&mut self, _: &Field, _: &dyn Debug) {}
}

/// When the last line passed, and how many were suppressed since.
#[derive(Clone, Copy, Debug, Default)]
struct Gate {
    last: Option<MonoTime>,
    held: u64,
}

impl Gate {
    /// Whether a line may pass at `t`: returns how many were suppressed since the last that did; `None` where this one
    /// is suppressed too.
    fn pass(&mut self, t: MonoTime, every: Span) -> Option<u64> {
        if self.last.is_some_and(|last| t - last < every) {
            self.held += 1;
            return None;
        }
        self.last = Some(t);
        Some(std::mem::take(&mut self.held))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: f64) -> MonoTime {
        MonoTime::from_ns(0) + Span::from_ms(ms)
    }

    fn key(event: OperatorEvent, about: &str, fault: &str) -> Key {
        Key { event, about: about.into(), fault: fault.into() }
    }

    #[test]
    fn what_is_held_back_is_counted() {
        let throttle = Throttle::new(HostClock::start());
        let held = |ms| {
            let key = key(OperatorEvent::FrameUnusable, "camera", "");
            throttle.judge(key, at(ms)).map(|passed| passed.held)
        };
        assert_eq!(held(0.0), Some(0));
        assert_eq!(held(100.0), None);
        assert_eq!(held(4_900.0), None);
        assert_eq!(held(5_000.0), Some(2));
        assert_eq!(held(10_000.0), Some(0));
    }

    #[test]
    fn sources_and_faults_are_throttled_apart_and_a_device_that_comes_up_ends_all_its_faults() {
        let throttle = Throttle::new(HostClock::start());
        let down =
            |about, fault, ms| throttle.judge(key(OperatorEvent::DeviceDown, about, fault), at(ms)).is_some();
        assert!(down("gps", "missing", 0.0) && down("gps", "busy", 1.0) && down("gps2", "missing", 2.0));
        assert!(!down("gps", "missing", 3.0) && !down("gps", "busy", 4.0));
        assert!(throttle.judge(key(OperatorEvent::DeviceUp, "gps", ""), at(5.0)).is_some());
        assert!(down("gps", "missing", 6.0) && down("gps", "busy", 7.0));
        assert!(!down("gps2", "missing", 8.0), "the fault of another device continues");
    }
}
