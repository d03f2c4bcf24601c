//! A transport stream as UDP datagrams of seven packets, as players expect it.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::time::Duration;

use super::ts::PACKET;

/// Packets of a datagram: the most that fit into an Ethernet frame.
const TOGETHER: usize = 7;
/// Longest that a datagram waits for room in the socket.
const PATIENCE: Duration = Duration::from_millis(100);

/// Sends to some addresses, each by its own family's socket.
#[derive(Debug)]
pub struct StreamSender {
    lines: Vec<(SocketAddr, UdpSocket)>,
}

impl StreamSender {
    /// To these addresses.
    ///
    /// # Errors
    /// The system gives no socket.
    pub fn new(addresses: &[SocketAddr]) -> io::Result<Self> {
        let open = |address: &SocketAddr| {
            let any: SocketAddr = match address {
                SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
                SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
            };
            let socket = UdpSocket::bind(any)?;
            socket.set_write_timeout(Some(PATIENCE))?;
            Ok((*address, socket))
        };
        Ok(Self { lines: addresses.iter().map(open).collect::<io::Result<_>>()? })
    }

    /// Sends whole packets to every address. An address that fails does not delay the others, and gets nothing more of
    /// these packets.
    ///
    /// # Errors
    /// The last address that failed, and why.
    pub fn send(&self, packets: &[u8]) -> Result<(), (SocketAddr, io::Error)> {
        let mut failed = Ok(());
        for (address, socket) in &self.lines {
            let sent =
                packets.chunks(TOGETHER * PACKET).try_for_each(|d| socket.send_to(d, address).map(drop));
            match sent {
                // Nobody listens there yet: what loopback says of the datagram before.
                Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
                Err(error) => failed = Err((*address, error)),
                Ok(()) => {}
            }
        }
        failed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn datagrams_hold_seven_whole_packets_and_one_address_does_not_stop_another() {
        let near = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        near.set_read_timeout(Some(Duration::from_secs(20))).expect("a limit");
        let there = near.local_addr().expect("bound");
        // The limited broadcast address takes nothing from a socket that did not ask for it.
        let sender =
            StreamSender::new(&["255.255.255.255:9".parse().expect("an address"), there]).expect("sockets");
        let packets = vec![0x47; 9 * PACKET];
        let (address, _) = sender.send(&packets).expect_err("broadcast was not asked for");
        assert_eq!(address.port(), 9);
        let mut buffer = [0; 2_000];
        let sizes = [(); 2].map(|()| near.recv(&mut buffer).expect("a datagram"));
        assert_eq!(sizes, [7 * PACKET, 2 * PACKET]);
    }
}
