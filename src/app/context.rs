//! What every task of the daemon is given.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;

use crate::io::clock::HostClock;
use windhover_base::time::MonoTime;

use super::event_queue::EventQueue;
use super::presence::Presence;

/// What every task is given. Copies share the same parts.
#[derive(Clone)]
pub struct TaskContext {
    /// The clock.
    pub clock: HostClock,
    /// When the graph started: before the first event.
    pub began: MonoTime,
    /// Asks for the end.
    pub stop: CancellationToken,
    /// Which parts are up.
    pub presence: Presence,
    /// Where events go.
    pub events: Arc<EventQueue>,
}
