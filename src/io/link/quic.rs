//! QUIC settings of the link: socket, packets, time-outs and connection ids.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use quinn::{AckFrequencyConfig, ServerConfig, TransportConfig, VarInt};
use ring::rand::SecureRandom as _;

use super::keys::KeyError;
use super::link_events::LinkError;
use super::sense::SenseFactory;
use super::tls::Identity;

/// How long a silent connection is kept: estimates flow on it as soon as a cut is over.
const IDLE: Duration = Duration::from_secs(300);
/// Sent when nothing else is: it keeps address translators open and announces a new address after roaming.
const KEEP_ALIVE: Duration = Duration::from_millis(900);

/// Connection ids of 8 random bytes: unlike keyed ones they do not depend on the process, so that resets reach the
/// peers of the previous process.
pub(super) struct RandomIds;

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

pub(super) fn bind(address: SocketAddr) -> Result<std::net::UdpSocket, LinkError> {
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

/// The peer is asked to acknowledge within this time: at 30 packets a second it would use its own 25 ms each time,
/// which looks like a queue in the path.
const ACK_DELAY: Duration = Duration::from_millis(5);

/// The server side: admits holders of a valid certificate.
pub(super) fn server_config(identity: &Identity) -> Result<ServerConfig, KeyError> {
    let mut config = ServerConfig::with_crypto(Arc::new(identity.server()?));
    config.transport_config(transport());
    config.max_incoming(64).incoming_buffer_size(16 << 10).incoming_buffer_size_total(256 << 10);
    Ok(config)
}

/// QUIC's transport settings: small buffers, packets that fit any path, nothing delayed.
pub(super) fn transport() -> Arc<TransportConfig> {
    let mut transport = TransportConfig::default();
    let mut acknowledge = AckFrequencyConfig::default();
    acknowledge.max_ack_delay(Some(ACK_DELAY));
    let idle = quinn::IdleTimeout::try_from(IDLE).expect("minutes fit into QUIC's 2^62 ms");
    transport
        .max_idle_timeout(Some(idle))
        .ack_frequency_config(Some(acknowledge))
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
