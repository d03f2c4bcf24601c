//! The link's events for the operator, and the errors of opening it.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::mpsc;

use super::keys::KeyError;
use super::peer::{Ended, Peer};

/// At most one refusal is reported in this time; the others are counted.
const REFUSALS: Duration = Duration::from_secs(1);

/// An event of the link for the operator.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum LinkEvent {
    /// A peer is connected.
    Up {
        /// Its name.
        peer: String,
        /// Its address.
        address: SocketAddr,
    },
    /// A peer is disconnected.
    Down {
        /// Its name.
        peer: String,
        /// The reason.
        why: String,
    },
    /// A peer was refused, or refused us.
    Refused {
        /// Its address.
        address: SocketAddr,
        /// The reason, as text.
        why: String,
        /// How many refusals since the last report were not reported.
        unreported: u64,
    },
    /// The key files changed and were read again.
    KeysReloaded,
    /// The key files changed and are not usable; the previous ones stay in use.
    KeysUnusable {
        /// What is wrong.
        why: String,
    },
    /// The name of a configured station does not resolve.
    Unresolved {
        /// As configured.
        address: String,
        /// The system's error.
        why: String,
    },
}

/// Why the link could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// Certificates or keys are not usable.
    #[error("link: {0}")]
    Keys(#[from] KeyError),
    /// The UDP port could not be opened.
    #[error("link: cannot listen on {address}: {source}; is another program using the port?")]
    Bind {
        /// The address.
        address: SocketAddr,
        /// The system's error.
        source: std::io::Error,
    },
}

/// Sends events to the operator; never waits.
#[derive(Clone, Debug)]
pub struct Events {
    sender: mpsc::Sender<LinkEvent>,
    refused: Arc<AtomicU64>,
    quiet: Arc<Mutex<(Option<tokio::time::Instant>, u64)>>,
}

impl Events {
    /// Events into a channel; they are dropped while it is full.
    pub fn new(sender: mpsc::Sender<LinkEvent>) -> Self {
        Self { sender, refused: Arc::default(), quiet: Arc::default() }
    }

    /// Reports an event.
    pub fn tell(&self, event: LinkEvent) {
        // A full channel means that hundreds of events are already waiting.
        let _ = self.sender.try_send(event);
    }

    /// Counts a refusal, and reports it unless another one was just reported.
    pub fn refused(&self, address: SocketAddr, why: String) {
        self.refused.fetch_add(1, Ordering::Relaxed);
        let mut quiet = self.quiet.lock().unwrap_or_else(PoisonError::into_inner);
        let now = tokio::time::Instant::now();
        if quiet.0.is_some_and(|last| now.saturating_duration_since(last) < REFUSALS) {
            quiet.1 += 1;
            return;
        }
        let unreported = std::mem::take(&mut quiet.1);
        quiet.0 = Some(now);
        self.tell(LinkEvent::Refused { address, why, unreported });
    }

    /// Reports the end of a session.
    pub(super) fn ended(&self, peer: &Peer, ended: Ended) {
        if ended.refused {
            self.refused(peer.address(), ended.why);
        } else {
            self.tell(LinkEvent::Down { peer: peer.name.clone(), why: ended.why });
        }
    }

    /// Number of refusals since the start.
    pub fn refusals(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }
}
