//! A line that is not a serial line: a receiver or compass over TCP or UDP, or gpsd.

use std::io::ErrorKind;
use std::net::SocketAddr;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpStream, UdpSocket, lookup_host};
use tokio::time::timeout;

use super::unplugged;
use crate::io::device::{Fault, FaultKind};

/// Longest time to connect.
const CONNECTING: Duration = Duration::from_secs(5);
/// After this silence of a peer the connection is made again.
const SILENT: Duration = Duration::from_secs(30);
/// Longest time until bytes are accepted.
const WRITING: Duration = Duration::from_secs(1);
/// gpsd's first message, and the request to it: the sentences of its devices.
const GPSD_HELLO: &[u8] = br#"{"class":"VERSION""#;
const GPSD_WATCH: &[u8] = b"?WATCH={\"enable\":true,\"json\":false,\"nmea\":true};\n";

/// A device on the network.
#[derive(Debug)]
pub(super) enum Network {
    /// Connected to a server; whether nothing was received yet.
    Tcp(TcpStream, bool),
    /// Bound to a port of this machine.
    Udp(UdpSocket),
}

/// Whether this names a device on the network.
pub(super) fn is_network(device: &str) -> bool {
    device.starts_with("tcp://") || device.starts_with("udp://")
}

impl Network {
    /// `tcp://HOST:PORT` connects, `udp://ADDRESS:PORT` listens.
    pub(super) async fn open(device: &str) -> Result<Self, Fault> {
        let fault = |error: std::io::Error| refused(device, &error);
        if let Some(host) = device.strip_prefix("tcp://") {
            let connecting = timeout(CONNECTING, TcpStream::connect(host)).await;
            let stream = connecting.unwrap_or_else(|_| Err(ErrorKind::TimedOut.into())).map_err(fault)?;
            stream.set_nodelay(true).map_err(fault)?;
            return Ok(Self::Tcp(stream, true));
        }
        let host = device.trim_start_matches("udp://");
        let addresses: Vec<SocketAddr> = lookup_host(host).await.map_err(fault)?.collect();
        Ok(Self::Udp(UdpSocket::bind(&addresses[..]).await.map_err(fault)?))
    }

    /// Waits for bytes and reads them; returns how many. Nothing is lost where the future is dropped.
    pub(super) async fn read(&mut self, device: &str, buffer: &mut [u8]) -> Result<usize, Fault> {
        let lost = |error: std::io::Error| refused(device, &error);
        match self {
            Self::Tcp(stream, is_new) => {
                let Ok(read) = timeout(SILENT, stream.read(buffer)).await else {
                    let words = format!("nothing was received for {} s; reconnecting", SILENT.as_secs());
                    return Err(Fault::new(FaultKind::Frozen, device, words));
                };
                match read.map_err(lost)? {
                    0 => Err(unplugged(device)),
                    count => {
                        if std::mem::take(is_new) && buffer[..count].starts_with(GPSD_HELLO) {
                            stream.write_all(GPSD_WATCH).await.map_err(lost)?;
                        }
                        Ok(count)
                    }
                }
            }
            Self::Udp(socket) => loop {
                match socket.recv(buffer).await {
                    Ok(0) => {}
                    Ok(count) => return Ok(count),
                    // An error for an earlier datagram, from a peer that does not exist.
                    Err(error) if error.kind() == ErrorKind::ConnectionRefused => {}
                    Err(error) => return Err(lost(error)),
                }
            },
        }
    }

    /// Writes bytes to a server; a listening port has no peer to write to.
    pub(super) async fn write(&mut self, device: &str, bytes: &[u8]) -> Result<(), Fault> {
        let Self::Tcp(stream, _) = self else { return Ok(()) };
        match timeout(WRITING, stream.write_all(bytes)).await {
            Ok(Ok(())) => Ok(()),
            _ => Err(unplugged(device)),
        }
    }
}

fn refused(device: &str, error: &std::io::Error) -> Fault {
    let (kind, words) = match error.kind() {
        ErrorKind::ConnectionRefused => {
            (FaultKind::Missing, "no program listens there; is its server running?")
        }
        ErrorKind::TimedOut | ErrorKind::HostUnreachable | ErrorKind::NetworkUnreachable => {
            (FaultKind::Missing, "there is no answer; is the network up?")
        }
        ErrorKind::AddrInUse => (FaultKind::Busy, "another program listens on this port; stop that program"),
        ErrorKind::AddrNotAvailable => {
            (FaultKind::Unsuitable, "is not an address of this machine; use udp://0.0.0.0:PORT")
        }
        ErrorKind::ConnectionReset | ErrorKind::BrokenPipe => return unplugged(device),
        _ => return Fault::new(FaultKind::Failed, device, error.to_string()),
    };
    Fault::new(kind, device, words)
}
