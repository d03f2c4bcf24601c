//! Events to a destination: datagrams, TCP, TLS.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::{TcpStream, UdpSocket};
use tokio::sync::broadcast;
use tokio::time::Instant;
use tokio_rustls::TlsConnector;

use super::CotTo;
use crate::app::events::OperatorEvent;

/// A server that accepts nothing for this time is connected again.
const PATIENCE: Duration = Duration::from_secs(10);
/// Pauses before a server is connected again, shortest and longest; each is twice the one before.
const PAUSES_S: (u64, u64) = (1, 30);
/// How many networks a datagram crosses; more than the local one needs a multicast router.
const HOPS: u32 = 1;

/// Sends events to one destination without end; a failure is reported once and the destination is tried again.
pub(super) async fn send(to: CotTo, tls: Option<TlsConnector>, events: broadcast::Sender<Arc<str>>) {
    let mut pause_s = PAUSES_S.0;
    let mut troubled = false;
    loop {
        let began = Instant::now();
        let ended = match (&to, &tls) {
            (CotTo::Udp(address), _) => datagrams(*address, events.subscribe(), &to, &mut troubled).await,
            (CotTo::Tcp(place), _) => called(place, None, &events, &to, &mut troubled).await,
            (CotTo::Tls(place), tls) => called(place, tls.as_ref(), &events, &to, &mut troubled).await,
        };
        let Err(error) = ended else { return };
        if !std::mem::replace(&mut troubled, true) {
            OperatorEvent::LinkFault.emit("cot", format!("{to}: {error}; tried again"));
        }
        if began.elapsed() > Duration::from_secs(PAUSES_S.1) {
            pause_s = PAUSES_S.0;
        }
        tokio::time::sleep(Duration::from_secs(pause_s)).await;
        pause_s = (2 * pause_s).min(PAUSES_S.1);
    }
}

fn is_up(to: &CotTo, troubled: &mut bool) {
    if std::mem::replace(troubled, false) {
        OperatorEvent::LinkUp.emit("cot", format!("{to} accepts reports again"));
    }
}

/// Sends one datagram for each event, until the events end.
async fn datagrams(
    address: SocketAddr,
    mut events: broadcast::Receiver<Arc<str>>,
    to: &CotTo,
    troubled: &mut bool,
) -> std::io::Result<()> {
    let any: SocketAddr = if address.is_ipv4() { ([0, 0, 0, 0], 0).into() } else { ([0u16; 8], 0).into() };
    let socket = UdpSocket::bind(any).await?;
    if address.is_ipv4() {
        socket.set_multicast_ttl_v4(HOPS)?;
    }
    while let Some(event) = next(&mut events).await {
        socket.send_to(event.as_bytes(), address).await?;
        is_up(to, troubled);
    }
    Ok(())
}

/// Sends events over a connection, until the events end.
async fn called(
    place: &str,
    tls: Option<&TlsConnector>,
    events: &broadcast::Sender<Arc<str>>,
    to: &CotTo,
    troubled: &mut bool,
) -> std::io::Result<()> {
    let stream = timed(TcpStream::connect(place)).await?;
    stream.set_nodelay(true)?;
    let events = events.subscribe();
    match tls {
        None => stream_events(stream, events, to, troubled).await,
        Some(tls) => {
            let host = place.rsplit_once(':').map_or(place, |(host, _)| host).trim_matches(['[', ']']);
            let name = ServerName::try_from(host.to_owned()).map_err(std::io::Error::other)?;
            let stream = timed(tls.connect(name, stream)).await?;
            stream_events(stream, events, to, troubled).await
        }
    }
}

async fn timed<T>(what: impl Future<Output = std::io::Result<T>>) -> std::io::Result<T> {
    tokio::time::timeout(PATIENCE, what).await.unwrap_or_else(|_| Err(std::io::ErrorKind::TimedOut.into()))
}

async fn stream_events(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    mut events: broadcast::Receiver<Arc<str>>,
    to: &CotTo,
    troubled: &mut bool,
) -> std::io::Result<()> {
    let mut ignored = [0; 4096];
    loop {
        tokio::select! {
            // Reports of others are ignored.
            said = stream.read(&mut ignored) => if said? == 0 {
                return Err(std::io::ErrorKind::ConnectionReset.into());
            },
            event = next(&mut events) => match event {
                Some(event) => {
                    timed(async {
                        stream.write_all(event.as_bytes()).await?;
                        stream.write_all(b"\n").await?;
                        stream.flush().await
                    })
                    .await?;
                    is_up(to, troubled);
                }
                None => return Ok(()),
            },
        }
    }
}

/// The next event; `None` when there are no more. Missed events are skipped.
async fn next(events: &mut broadcast::Receiver<Arc<str>>) -> Option<Arc<str>> {
    loop {
        match events.recv().await {
            Ok(event) => return Some(event),
            Err(broadcast::error::RecvError::Lagged(_)) => {}
            Err(broadcast::error::RecvError::Closed) => return None,
        }
    }
}
