//! The context of every task of the daemon.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;

use crate::io::clock::HostClock;
use windhover_base::time::MonoTime;

use super::event_queue::EventQueue;
use super::presence::Presence;

/// The context of a task. Copies share the same parts.
#[derive(Clone)]
pub struct TaskContext {
    /// The clock.
    pub clock: HostClock,
    /// When the task graph started, before the first event.
    pub began: MonoTime,
    /// Requests the stop of the daemon.
    pub stop: CancellationToken,
    /// Which devices are up.
    pub presence: Presence,
    /// Where events go.
    pub events: Arc<EventQueue>,
}
