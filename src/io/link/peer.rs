//! An admitted peer, and the end of its connection and session.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use quinn::{Connection, VarInt};

use super::tls::refusal;
use super::wire::WireError;

/// Codes with which a side closes a connection.
pub(super) mod close {
    /// A newer connection of the same peer took its place.
    pub const SUPERSEDED: u32 = 1;
    /// The program ends.
    pub const BYE: u32 = 2;
    /// The certificate is for another role.
    pub const WRONG_ROLE: u32 = 3;
    /// The certificate was revoked meanwhile.
    pub const REVOKED: u32 = 4;
    /// The peer sent something that is not a message of the link.
    pub const MALFORMED: u32 = 5;
    /// The peer exceeded a limit.
    pub const EXCESS: u32 = 6;
}

/// A peer with a valid certificate.
#[derive(Clone, Debug)]
pub struct Peer {
    /// Its name.
    pub name: String,
    /// The connection.
    pub connection: Connection,
    superseded: Arc<AtomicBool>,
}

impl Peer {
    /// The peer of this name at the other end of a connection.
    pub(super) fn new(name: String, connection: Connection) -> Self {
        Self { name, connection, superseded: Arc::default() }
    }

    /// Its present address; an IPv4 address as such, also on a dual-stack socket.
    pub(super) fn address(&self) -> SocketAddr {
        let address = self.connection.remote_address();
        SocketAddr::new(address.ip().to_canonical(), address.port())
    }

    /// Closes the connection because a newer one of the same peer took its place.
    pub(super) fn supersede(&self) {
        self.superseded.store(true, Ordering::Relaxed);
        self.connection.close(VarInt::from_u32(close::SUPERSEDED), b"a newer connection took over");
    }

    /// Whether a newer connection took its place, closed by us or by the other side. A close by us alone does not prove
    /// it: we also close sessions that ended for other reasons.
    pub(super) fn was_superseded(&self) -> bool {
        use quinn::ConnectionError as E;
        self.superseded.load(Ordering::Relaxed)
            || matches!(self.connection.close_reason(), Some(E::ApplicationClosed(said))
                if said.error_code == VarInt::from_u32(close::SUPERSEDED))
    }
}

/// How a session ended.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(super) struct Ended {
    /// The reason, as text.
    pub(super) why: String,
    /// Whether a certificate was the reason: under TLS 1.3 a caller learns only after its own half of the handshake
    /// that the other side refuses its certificate.
    pub(super) refused: bool,
}

impl Ended {
    /// Closes the connection of a session with this outcome.
    pub(super) fn conclude(connection: &Connection, outcome: Result<(), WireError>) -> Self {
        let reason = connection.close_reason().map(|reason| refusal(&reason));
        let malformed = matches!(outcome, Err(WireError::Malformed(_)));
        let said = outcome.err().map_or_else(|| "ended".into(), |e| e.to_string());
        let code = if malformed { close::MALFORMED } else { close::BYE };
        connection.close(VarInt::from_u32(code), said.as_bytes());
        let (why, refused) = reason.unwrap_or((said, false));
        Self { why, refused }
    }
}
