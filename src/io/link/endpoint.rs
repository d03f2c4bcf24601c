//! The UDP port of the link: lets peers in that show a certificate, calls others, and tells who came.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use quinn::{Connection, Endpoint, EndpointConfig, ServerConfig, TransportConfig, VarInt};
use ring::rand::SecureRandom as _;
use tokio::sync::mpsc;

use super::keys::{KeyError, Role, peer_of};
use super::sense::SenseFactory;
use super::tls::{Identity, KeyFiles, peer_certificate, refusal};
use super::wire::WireError;

/// A silent connection is kept this long: estimates flow on it the moment a cut is over.
const IDLE: Duration = Duration::from_secs(300);
/// Sent when nothing else is: keeps address translators open and tells of a new address after roaming.
const KEEP_ALIVE: Duration = Duration::from_millis(900);
/// Silence after which a caller tries a fresh connection beside the old one.
const SUSPICIOUS: Duration = Duration::from_millis(2_500);
/// Longest one call may take.
const CALL: Duration = Duration::from_secs(4);
/// Pause after another connection took over.
const YIELD: Duration = Duration::from_secs(30);
/// Pause between calls; it doubles, up to [`CALL`], while connections end young.
const PAUSE: Duration = Duration::from_millis(300);
/// A connection that ends before is young.
const YOUNG: Duration = Duration::from_secs(10);
/// Handshakes under way above which a caller must first prove its address.
const BUSY: usize = 8;
/// How often the key files are looked at.
const KEYS_WATCH: Duration = Duration::from_secs(5);
/// At most one refusal is reported in this time; the others are counted.
const REFUSALS: Duration = Duration::from_secs(1);

/// Reasons a side closes a connection with.
pub mod close {
    /// A newer connection of the same peer took its place.
    pub const SUPERSEDED: u32 = 1;
    /// The program ends.
    pub const BYE: u32 = 2;
    /// The certificate is for another role.
    pub const WRONG_ROLE: u32 = 3;
    /// The certificate was revoked meanwhile.
    pub const REVOKED: u32 = 4;
    /// The peer sent what is no message of the link.
    pub const MALFORMED: u32 = 5;
}

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

/// A peer that has shown its certificate.
#[derive(Clone, Debug)]
pub struct Peer {
    /// Its name.
    pub name: String,
    /// The connection.
    pub connection: Connection,
    superseded: Arc<AtomicBool>,
}

impl Peer {
    /// Closes the connection because a newer one of the same peer took its place.
    pub(super) fn supersede(&self) {
        self.superseded.store(true, Ordering::Relaxed);
        self.connection.close(VarInt::from_u32(close::SUPERSEDED), b"a newer connection took over");
    }

    /// Whether a newer connection took its place, by our doing or the other side's. A close of our own
    /// alone does not say so: a session that ended for any other reason is closed by us as well.
    fn was_superseded(&self) -> bool {
        use quinn::ConnectionError as E;
        self.superseded.load(Ordering::Relaxed)
            || matches!(self.connection.close_reason(), Some(E::ApplicationClosed(said))
                if said.error_code == VarInt::from_u32(close::SUPERSEDED))
    }
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
            self.refused(peer.connection.remote_address(), ended.why);
        } else {
            self.tell(LinkEvent::Down { peer: peer.name.clone(), why: ended.why });
        }
    }

    /// How many were refused since the start.
    pub fn refusals(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }
}

/// How a session came to its end.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(super) struct Ended {
    /// Why, in words.
    pub(super) why: String,
    /// Whether a certificate was the reason: under TLS 1.3 a caller learns only after its own half of the
    /// handshake that the other side does not like it.
    pub(super) refused: bool,
}

impl Ended {
    /// Closes the connection of a session that came out like this.
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

/// One side's UDP port.
#[derive(Clone)]
pub struct Door {
    endpoint: Endpoint,
    role: Role,
    files: KeyFiles,
    /// When the files were last written, as of just before they were read.
    stamps: Vec<Option<std::time::SystemTime>>,
    identity: Arc<Mutex<Arc<Identity>>>,
    events: Events,
    arrivals: mpsc::Sender<Peer>,
    open: Arc<Mutex<BTreeMap<usize, Connection>>>,
}

impl Door {
    /// Opens the port. Peers that got in come out of `arrivals`.
    pub fn open(
        role: Role,
        files: &KeyFiles,
        listen: Option<SocketAddr>,
        events: Events,
        arrivals: mpsc::Sender<Peer>,
    ) -> Result<Self, LinkError> {
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
        Ok(Self {
            endpoint,
            role,
            files: files.clone(),
            stamps,
            identity: Arc::new(Mutex::new(Arc::new(identity))),
            events,
            arrivals,
            open: Arc::default(),
        })
    }

    /// The name in its own certificate.
    pub fn name(&self) -> String {
        self.identity().name.clone()
    }

    /// The port it has.
    pub fn local_addr(&self) -> std::io::Result<SocketAddr> {
        self.endpoint.local_addr()
    }

    fn identity(&self) -> Arc<Identity> {
        Arc::clone(&self.identity.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Ends every connection and waits, briefly, until the peers were told.
    pub async fn shut(&self) {
        self.endpoint.close(VarInt::from_u32(close::BYE), b"the program ends");
        let _ = tokio::time::timeout(Duration::from_millis(300), self.endpoint.wait_idle()).await;
    }

    /// Lets peers in, until the port is closed.
    pub async fn listen(self) {
        // They end with this task: a port that is given up is free at once.
        let mut underway = tokio::task::JoinSet::new();
        while let Some(incoming) = self.endpoint.accept().await {
            while underway.try_join_next().is_some() {}
            if underway.len() >= BUSY && !incoming.remote_address_validated() && incoming.may_retry() {
                // Costs the caller a round trip and us nothing; forged addresses end here.
                let _ = incoming.retry();
                continue;
            }
            let door = self.clone();
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
                        let _ = door.greet(connection).await;
                    }
                    Err(e) => door.events.refused(address, refusal(&e).0),
                }
            });
        }
    }

    /// Calls a peer, and again whenever the connection is gone or silent, until the port is closed.
    pub async fn dial(self, address: String) {
        let mut current: Option<Peer> = None;
        let mut told_unresolved = false;
        let (mut pause, mut answered) = (PAUSE, tokio::time::Instant::now());
        // A call of ours beside a silent connection may have reached the peer though its answer did not
        // reach us: then it is this call that took over, and nobody else.
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
                        // Another way to the same peer, or another program with our certificate: taking
                        // over from it at once would go on without end.
                        tokio::time::sleep(YIELD).await;
                        current = None;
                    }
                }
            }
            match tokio::net::lookup_host(&address).await {
                Ok(found) => {
                    told_unresolved = false;
                    for candidate in found {
                        match self.call(candidate).await {
                            Called::Answered(peer) => {
                                current = Some(peer);
                                called_beside = false;
                                answered = tokio::time::Instant::now();
                                break;
                            }
                            Called::Refused => tokio::time::sleep(CALL).await,
                            Called::Unanswered => {}
                        }
                    }
                }
                Err(e) if !told_unresolved => {
                    told_unresolved = true;
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

    /// Checks the role in the peer's certificate and hands the peer on.
    async fn greet(&self, connection: Connection) -> Option<Peer> {
        let known = peer_certificate(&connection).and_then(|der| peer_of(&der));
        let name = match known {
            Some((role, name)) if role == self.role.peer() => name,
            _ => {
                connection.close(VarInt::from_u32(close::WRONG_ROLE), b"certificate of another role");
                let why = format!("refused: its certificate is not a {}'s", self.role.peer().name());
                self.events.refused(connection.remote_address(), why);
                return None;
            }
        };
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner).clone();
        open.retain(|_, c| c.close_reason().is_none());
        open.insert(connection.stable_id(), connection.clone());
        *self.open.lock().unwrap_or_else(PoisonError::into_inner) = open;
        let peer = Peer { name, connection, superseded: Arc::default() };
        self.arrivals.send(peer.clone()).await.ok()?;
        Some(peer)
    }

    /// Reads the key files again when they change: a revoked peer is out within seconds.
    pub async fn watch_keys(self) {
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
    pub fn reload(&self) {
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

/// Waits until a connection is closed, or nothing was heard on it for a while.
async fn watch(peer: &Peer) -> Watched {
    let connection = &peer.connection;
    let mut heard = connection.stats().udp_rx.datagrams;
    let mut since = tokio::time::Instant::now();
    loop {
        tokio::select! {
            reason = connection.closed() => {
                if peer.was_superseded() {
                    return Watched::Superseded;
                }
                if matches!(reason, quinn::ConnectionError::ConnectionClosed(_)) {
                    // Thrown out, most likely for the certificate: no use in hurrying.
                    tokio::time::sleep(CALL).await;
                }
                return Watched::Closed;
            }
            () = tokio::time::sleep(PAUSE) => {}
        }
        let now = connection.stats().udp_rx.datagrams;
        if now != heard {
            (heard, since) = (now, tokio::time::Instant::now());
        } else if since.elapsed() > SUSPICIOUS {
            return Watched::Silent;
        }
    }
}

/// Connection numbers of 8 random bytes: unlike the keyed ones they outlive the process, so that resets
/// reach the peers of the process before.
struct RandomIds;

impl quinn::ConnectionIdGenerator for RandomIds {
    fn generate_cid(&mut self) -> quinn::ConnectionId {
        let mut id = [0_u8; 8];
        ring::rand::SystemRandom::new().fill(&mut id).expect("the system gives random bytes");
        quinn::ConnectionId::new(&id)
    }

    fn cid_len(&self) -> usize {
        8
    }

    fn cid_lifetime(&self) -> Option<Duration> {
        None
    }
}

fn stamps(files: &KeyFiles) -> Vec<Option<std::time::SystemTime>> {
    [Some(&files.authority), Some(&files.certificate), Some(&files.key), files.revoked.as_ref()]
        .into_iter()
        .map(|path| std::fs::metadata(path?).ok()?.modified().ok())
        .collect()
}

fn bind(address: SocketAddr) -> Result<std::net::UdpSocket, LinkError> {
    use socket2::{Domain, Protocol, Socket, Type};
    let open = || -> std::io::Result<std::net::UdpSocket> {
        let socket = Socket::new(Domain::for_address(address), Type::DGRAM, Some(Protocol::UDP))?;
        if address.is_ipv6() && address.ip().is_unspecified() {
            socket.set_only_v6(false)?;
        }
        socket.bind(&address.into())?;
        Ok(socket.into())
    };
    open().map_err(|source| LinkError::Bind { address, source })
}

fn server_config(identity: &Identity) -> Result<ServerConfig, KeyError> {
    let mut config = ServerConfig::with_crypto(Arc::new(identity.server()?));
    config.transport_config(transport());
    config.max_incoming(64).incoming_buffer_size(16 << 10).incoming_buffer_size_total(256 << 10);
    Ok(config)
}

/// How QUIC behaves under the link: small buffers, packets that fit any path, nothing held back.
fn transport() -> Arc<TransportConfig> {
    let mut transport = TransportConfig::default();
    let idle = quinn::IdleTimeout::try_from(IDLE).expect("minutes fit into QUIC's 2^62 ms");
    transport
        .max_idle_timeout(Some(idle))
        .keep_alive_interval(Some(KEEP_ALIVE))
        .max_concurrent_bidi_streams(VarInt::from_u32(2))
        .max_concurrent_uni_streams(VarInt::from_u32(16))
        .initial_mtu(1200)
        // A probe for larger packets would cost a slow radio a quarter of a second.
        .mtu_discovery_config(None)
        .enable_segmentation_offload(false)
        .datagram_send_buffer_size(8 << 10)
        .datagram_receive_buffer_size(Some(256 << 10))
        .send_window(192 << 10)
        .congestion_controller_factory(Arc::new(SenseFactory));
    Arc::new(transport)
}
