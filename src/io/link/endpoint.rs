//! The UDP port of the link: admits peers with a valid certificate, and disconnects those that were revoked.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use quinn::{Connection, Endpoint, EndpointConfig, VarInt};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;

use super::keys::{Role, peer_of};
use super::link_events::{Events, LinkError, LinkEvent};
use super::peer::{Peer, close};
use super::quic::{RandomIds, bind, server_config};
use super::tls::{Identity, KeyFiles, peer_certificate, refusal};

/// Longest a handshake may take.
pub(super) const CALL: Duration = Duration::from_secs(4);
/// With more handshakes in progress than this, a caller must first prove its address.
const BUSY: usize = 8;
/// How often the key files are checked for changes.
const KEYS_WATCH: Duration = Duration::from_secs(5);
/// Longest wait at the end until the close has been sent to the peers.
const GOODBYE: Duration = Duration::from_millis(300);

/// One side's UDP port.
#[derive(Clone)]
pub struct LinkEndpoint {
    pub(super) endpoint: Endpoint,
    pub(super) role: Role,
    files: KeyFiles,
    /// Modification times of the files just before they were read.
    stamps: Vec<Option<std::time::SystemTime>>,
    identity: Arc<Mutex<Arc<Identity>>>,
    pub(super) events: Events,
    arrivals: mpsc::Sender<Peer>,
    open: Arc<Mutex<BTreeMap<usize, Connection>>>,
}

impl LinkEndpoint {
    /// Opens the port. Admitted peers come out of the receiver, for [`LinkEndpoint::run`].
    pub fn open(
        role: Role,
        files: &KeyFiles,
        listen: Option<SocketAddr>,
        events: Events,
    ) -> Result<(Self, mpsc::Receiver<Peer>), LinkError> {
        let stamps = stamps(files);
        let identity = Identity::load(files, role)?;
        let socket = match listen {
            Some(address) => bind(address)?,
            None => bind((Ipv6Addr::UNSPECIFIED, 0).into())
                .or_else(|_| bind((Ipv4Addr::UNSPECIFIED, 0).into()))?,
        };
        let mut config = EndpointConfig::new(Arc::new(identity.reset_key()));
        config.cid_generator(|| Box::new(RandomIds));
        let server = listen.map(|_| server_config(&identity)).transpose()?;
        let address = listen.unwrap_or_else(|| (Ipv6Addr::UNSPECIFIED, 0).into());
        let endpoint = Endpoint::new(config, server, socket, Arc::new(quinn::TokioRuntime))
            .map_err(|source| LinkError::Bind { address, source })?;
        let (arrivals, receiver) = mpsc::channel(16);
        let link_endpoint = Self {
            endpoint,
            role,
            files: files.clone(),
            stamps,
            identity: Arc::new(Mutex::new(Arc::new(identity))),
            events,
            arrivals,
            open: Arc::default(),
        };
        Ok((link_endpoint, receiver))
    }

    /// The local address of the port.
    pub fn local_addr(&self) -> std::io::Result<SocketAddr> {
        self.endpoint.local_addr()
    }

    pub(super) fn identity(&self) -> Arc<Identity> {
        Arc::clone(&self.identity.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Admits peers, connects to those of `dial` and watches the key files until `stop` is set (or its sender is gone);
    /// each admitted peer is passed to `welcome`, whose future is its session.
    pub(super) async fn run<F, S>(
        self,
        dial: Vec<String>,
        mut arrivals: mpsc::Receiver<Peer>,
        mut stop: watch::Receiver<bool>,
        mut welcome: F,
    ) where
        F: FnMut(Peer) -> S,
        S: Future<Output = ()> + Send + 'static,
    {
        let mut tasks = JoinSet::new();
        tasks.spawn(self.clone().listen());
        tasks.spawn(self.clone().watch_keys());
        for address in dial {
            tasks.spawn(self.clone().dial(address));
        }
        loop {
            tokio::select! {
                peer = arrivals.recv() => {
                    let Some(peer) = peer else { break };
                    tasks.spawn(welcome(peer));
                }
                _ = stop.wait_for(|stop| *stop) => break,
                Some(_) = tasks.join_next() => {}
            }
        }
        // Closes every connection and waits, briefly, until the close has been sent.
        self.endpoint.close(VarInt::from_u32(close::BYE), b"the program ends");
        let _ = tokio::time::timeout(GOODBYE, self.endpoint.wait_idle()).await;
    }

    /// Admits peers, until the port is closed.
    async fn listen(self) {
        // They end with this task, so the port is free at once when it is closed.
        let mut underway = JoinSet::new();
        while let Some(incoming) = self.endpoint.accept().await {
            while underway.try_join_next().is_some() {}
            if underway.len() >= BUSY && !incoming.remote_address_validated() && incoming.may_retry() {
                // Costs the caller a round trip and us nothing; forged addresses end here.
                let _ = incoming.retry();
                continue;
            }
            let link_endpoint = self.clone();
            underway.spawn(async move {
                let address = incoming.remote_address();
                let outcome = match incoming.accept() {
                    Ok(connecting) => match tokio::time::timeout(CALL, connecting).await {
                        Ok(outcome) => outcome,
                        Err(_) => Err(quinn::ConnectionError::TimedOut),
                    },
                    Err(e) => Err(e),
                };
                match outcome {
                    Ok(connection) => {
                        let _ = link_endpoint.greet(connection).await;
                    }
                    Err(e) => link_endpoint.events.refused(address, refusal(&e).0),
                }
            });
        }
    }

    /// Checks the role in the peer's certificate and passes the peer on.
    pub(super) async fn greet(&self, connection: Connection) -> Option<Peer> {
        let known = peer_certificate(&connection).and_then(|der| peer_of(&der));
        let name = match known {
            Some((role, name)) if role == self.role.peer() => name,
            _ => {
                connection.close(VarInt::from_u32(close::WRONG_ROLE), b"certificate of another role");
                let why = format!("refused: its certificate is not that of a {}", self.role.peer().name());
                self.events.refused(connection.remote_address(), why);
                return None;
            }
        };
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner).clone();
        open.retain(|_, c| c.close_reason().is_none());
        open.insert(connection.stable_id(), connection.clone());
        *self.open.lock().unwrap_or_else(PoisonError::into_inner) = open;
        let peer = Peer::new(name, connection);
        self.arrivals.send(peer.clone()).await.ok()?;
        Some(peer)
    }

    /// Reads the key files again when they change: a revoked peer is disconnected within seconds.
    async fn watch_keys(self) {
        let mut seen = self.stamps.clone();
        loop {
            tokio::time::sleep(KEYS_WATCH).await;
            let now = stamps(&self.files);
            if now == seen {
                continue;
            }
            seen = now;
            self.reload();
        }
    }

    /// Reads the key files again.
    fn reload(&self) {
        let loaded = Identity::load(&self.files, self.role).and_then(|identity| {
            let server = server_config(&identity)?;
            Ok((identity, server))
        });
        let (identity, server) = match loaded {
            Ok(loaded) => loaded,
            Err(e) => return self.events.tell(LinkEvent::KeysUnusable { why: e.to_string() }),
        };
        if self.endpoint.local_addr().is_ok() {
            self.endpoint.set_server_config(Some(server));
        }
        for connection in self.open.lock().unwrap_or_else(PoisonError::into_inner).values() {
            if peer_certificate(connection).is_none_or(|der| identity.is_revoked(&der)) {
                connection.close(VarInt::from_u32(close::REVOKED), b"certificate revoked");
                self.events.refused(connection.remote_address(), "certificate revoked".into());
            }
        }
        *self.identity.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(identity);
        self.events.tell(LinkEvent::KeysReloaded);
    }
}

fn stamps(files: &KeyFiles) -> Vec<Option<std::time::SystemTime>> {
    [Some(&files.authority), Some(&files.certificate), Some(&files.key), files.revoked.as_ref()]
        .into_iter()
        .map(|path| std::fs::metadata(path?).ok()?.modified().ok())
        .collect()
}
