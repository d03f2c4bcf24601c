//! Connecting to peers: until they answer, and again whenever the connection is lost or silent.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::endpoint::{CALL, LinkEndpoint};
use super::link_events::LinkEvent;
use super::peer::Peer;
use super::quic::transport;
use super::tls::refusal;

/// Silence after which a second connection is tried beside the first.
const SUSPICIOUS: Duration = Duration::from_millis(2_500);
/// Pause after another connection took over.
const YIELD: Duration = Duration::from_secs(30);
/// Pause between attempts; it doubles, up to [`CALL`], while connections end early.
const PAUSE: Duration = Duration::from_millis(300);
/// A connection that ends within this time ended early.
const YOUNG: Duration = Duration::from_secs(10);

impl LinkEndpoint {
    /// Connects to a peer, and again whenever the connection is lost or silent, until the port is closed.
    pub(super) async fn dial(self, address: String) {
        let mut current: Option<Peer> = None;
        let mut unresolved_reported = false;
        let (mut pause, mut answered) = (PAUSE, Instant::now());
        // An attempt beside a silent connection may have reached the peer although its answer did not reach us: then it
        // is this attempt that took over.
        let mut called_beside = false;
        loop {
            if let Some(peer) = &current {
                match watch(peer).await {
                    Watched::Closed => {
                        let young = answered.elapsed() < YOUNG;
                        pause = if young { (2 * pause).min(CALL) } else { PAUSE };
                        current = None;
                    }
                    Watched::Silent => called_beside = true,
                    Watched::Superseded if called_beside => current = None,
                    Watched::Superseded => {
                        // Another path to the same peer, or another program with our certificate: to take over from it
                        // at once would repeat without end.
                        tokio::time::sleep(YIELD).await;
                        current = None;
                    }
                }
            }
            match tokio::net::lookup_host(&address).await {
                Ok(found) => {
                    unresolved_reported = false;
                    for candidate in found {
                        match self.call(candidate).await {
                            Called::Answered(peer) => {
                                current = Some(peer);
                                called_beside = false;
                                answered = Instant::now();
                                break;
                            }
                            Called::Refused => tokio::time::sleep(CALL).await,
                            Called::Unanswered => {}
                        }
                    }
                }
                Err(e) if !unresolved_reported => {
                    unresolved_reported = true;
                    let why = e.to_string();
                    self.events.tell(LinkEvent::Unresolved { address: address.clone(), why });
                }
                Err(_) => {}
            }
            tokio::time::sleep(pause).await;
        }
    }

    async fn call(&self, address: SocketAddr) -> Called {
        let Ok(client) = self.identity().client() else { return Called::Refused };
        let mut config = quinn::ClientConfig::new(Arc::new(client));
        config.transport_config(transport());
        let name = self.role.peer().server_name();
        let Ok(connecting) = self.endpoint.connect_with(config, address, &name) else {
            return Called::Unanswered;
        };
        match tokio::time::timeout(CALL, connecting).await {
            Ok(Ok(connection)) => match self.greet(connection).await {
                Some(peer) => Called::Answered(peer),
                None => Called::Refused,
            },
            Ok(Err(e)) => {
                let (why, certificate) = refusal(&e);
                if !certificate {
                    return Called::Unanswered;
                }
                self.events.refused(address, why);
                Called::Refused
            }
            Err(_) => Called::Unanswered,
        }
    }
}

enum Called {
    Answered(Peer),
    Refused,
    Unanswered,
}

enum Watched {
    Closed,
    Silent,
    Superseded,
}

/// Waits until a connection is closed or has been silent for a while.
async fn watch(peer: &Peer) -> Watched {
    let connection = &peer.connection;
    let mut datagrams = connection.stats().udp_rx.datagrams;
    let mut since = Instant::now();
    loop {
        tokio::select! {
            reason = connection.closed() => {
                if peer.was_superseded() {
                    return Watched::Superseded;
                }
                if matches!(reason, quinn::ConnectionError::ConnectionClosed(_)) {
                    // The peer refused us, most likely for the certificate: a quick retry does not help.
                    tokio::time::sleep(CALL).await;
                }
                return Watched::Closed;
            }
            () = tokio::time::sleep(PAUSE) => {}
        }
        let now = connection.stats().udp_rx.datagrams;
        if now != datagrams {
            (datagrams, since) = (now, Instant::now());
        } else if since.elapsed() > SUSPICIOUS {
            return Watched::Silent;
        }
    }
}
