//! What the link tells the operator, and why it could not be opened.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::mpsc;

use super::keys::KeyError;
use super::peer::{Ended, Peer};

/// At most one refusal is reported in this time; the others are counted.
const REFUSALS: Duration = Duration::from_secs(1);

/// What the operator may want to know about the link.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum LinkEvent {
    /// A peer is connected.
    Up {
        /// Its name.
        peer: String,
        /// Where it is.
        address: SocketAddr,
    },
    /// A peer is gone.
    Down {
        /// Its name.
        peer: String,
        /// Why.
        why: String,
    },
    /// Somebody was not let in, or would not let us in.
    Refused {
        /// Where.
        address: SocketAddr,
        /// Why, in words.
        why: String,
        /// How many refusals were not reported one by one since the last.
        unreported: u64,
    },
    /// The key files changed and were read again.
    KeysReloaded,
    /// The key files changed and are not usable; the old ones stay in force.
    KeysUnusable {
        /// What is wrong.
        why: String,
    },
    /// A station to be called has no address.
    Unresolved {
        /// As configured.
        address: String,
        /// What the system said.
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
        /// What the system said.
        source: std::io::Error,
    },
}

/// Sends events to the operator without ever waiting.
#[derive(Clone, Debug)]
pub struct Events {
    sender: mpsc::Sender<LinkEvent>,
    refused: Arc<AtomicU64>,
    quiet: Arc<Mutex<(Option<tokio::time::Instant>, u64)>>,
}

impl Events {
    /// Into a channel; what does not fit is left out.
    pub fn new(sender: mpsc::Sender<LinkEvent>) -> Self {
        Self { sender, refused: Arc::default(), quiet: Arc::default() }
    }

    /// Reports.
    pub fn tell(&self, event: LinkEvent) {
        // The operator's channel being full means hundreds of events are waiting already.
        let _ = self.sender.try_send(event);
    }

    /// Counts a refusal, and reports it unless another was reported just now.
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

    /// How many were refused since the start.
    pub fn refusals(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }
}
