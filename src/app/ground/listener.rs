//! Admission of clients to a port of the station: a limited number at a time, and a silent client does not stay long.
//!
//! A client that has been answered keeps its place. A client that has not (a connection that only opened, or sends its
//! question slowly) is closed after [`ASKING`], and at once where places are needed. A failed accept (out of file
//! descriptors) ends nothing: it is reported and tried again.

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, Sleep};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

use crate::app::events::OperatorEvent;

/// Clients at a time; each costs a descriptor and some ten kilobytes.
const PLACES: usize = 128;
/// How long a client has for its question.
const ASKING: Duration = Duration::from_secs(10);
/// How long an answered client may stay without further traffic.
const STAYING: Duration = Duration::from_secs(120);
/// How long a listening client may stay without traffic: a year.
const LISTENING: Duration = Duration::from_secs(365 * 86_400);
/// Pause after a connection could not be accepted.
const PAUSE: Duration = Duration::from_millis(500);

/// One client's place.
#[derive(Debug)]
struct Place {
    answered: AtomicBool,
    leave: CancellationToken,
}

/// The taken places, in order of arrival.
#[derive(Clone, Debug, Default)]
struct Places(Arc<Mutex<VecDeque<Arc<Place>>>>);

impl Places {
    fn taken(&self) -> MutexGuard<'_, VecDeque<Arc<Place>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a place, if needed that of the client that has waited longest without an answer.
    fn take(&self) -> Option<Arc<Place>> {
        let mut taken = self.taken();
        if taken.len() >= PLACES {
            let silent = taken.iter().position(|place| !place.answered.load(Ordering::Relaxed))?;
            taken.remove(silent)?.leave.cancel();
        }
        let place = Arc::new(Place { answered: AtomicBool::new(false), leave: CancellationToken::new() });
        taken.push_back(Arc::clone(&place));
        Some(place)
    }
}

/// Accepts the clients of one port.
#[derive(Debug)]
pub(super) struct ClientListener {
    listener: TcpListener,
    /// What the port serves, for the operator.
    name: &'static str,
    places: Places,
}

impl ClientListener {
    /// Admits clients to `name`.
    pub(super) fn new(listener: TcpListener, name: &'static str) -> Self {
        Self { listener, name, places: Places::default() }
    }

    /// The next client that gets a place.
    pub(super) async fn next(&mut self) -> (ClientStream, SocketAddr) {
        loop {
            match self.listener.accept().await {
                Ok((stream, address)) => match self.places.take() {
                    Some(place) => return (ClientStream::new(stream, place, self.places.clone()), address),
                    None => self.tell(&format!("{address} is refused: {PLACES} clients are connected")),
                },
                Err(error) => {
                    self.tell(&format!("cannot accept a connection: {error}"));
                    tokio::time::sleep(PAUSE).await;
                }
            }
        }
    }

    fn tell(&self, words: &str) {
        OperatorEvent::LinkFault.emit(self.name, words);
    }
}

impl axum::serve::Listener for ClientListener {
    type Io = ClientStream;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (ClientStream, SocketAddr) {
        self.next().await
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

/// A client's connection. It fails when the client has to leave.
#[derive(Debug)]
pub(super) struct ClientStream {
    stream: TcpStream,
    place: Arc<Place>,
    places: Places,
    leave: Pin<Box<WaitForCancellationFutureOwned>>,
    limit: Pin<Box<Sleep>>,
}

impl ClientStream {
    fn new(stream: TcpStream, place: Arc<Place>, places: Places) -> Self {
        let leave = Box::pin(place.leave.clone().cancelled_owned());
        Self { stream, place, places, leave, limit: Box::pin(tokio::time::sleep(ASKING)) }
    }

    /// The client only listens, and may do so for as long as it takes what it is sent.
    pub(super) fn listens(&mut self) {
        self.stays(LISTENING);
    }

    fn stays(&mut self, long: Duration) {
        self.place.answered.store(true, Ordering::Relaxed);
        self.limit.as_mut().reset(Instant::now() + long);
    }

    /// Whether the client has to leave now.
    fn has_to_leave(&mut self, context: &mut Context<'_>) -> Option<io::Error> {
        if self.leave.as_mut().poll(context).is_ready() {
            return Some(io::Error::new(io::ErrorKind::ConnectionAborted, "the place is needed"));
        }
        let over = self.limit.as_mut().poll(context).is_ready();
        over.then(|| io::Error::new(io::ErrorKind::TimedOut, "nothing was received"))
    }
}

impl Drop for ClientStream {
    fn drop(&mut self) {
        self.places.taken().retain(|place| !Arc::ptr_eq(place, &self.place));
    }
}

impl AsyncRead for ClientStream {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        into: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let me = self.get_mut();
        if let Some(error) = me.has_to_leave(context) {
            return Poll::Ready(Err(error));
        }
        Pin::new(&mut me.stream).poll_read(context, into)
    }
}

impl AsyncWrite for ClientStream {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let me = self.get_mut();
        let written = Pin::new(&mut me.stream).poll_write(context, bytes);
        match written {
            Poll::Ready(Ok(_)) => me.stays(STAYING),
            // A client that stops reading holds a place as much as one that sends nothing.
            Poll::Pending => {
                if let Some(error) = me.has_to_leave(context) {
                    return Poll::Ready(Err(error));
                }
            }
            Poll::Ready(Err(_)) => {}
        }
        written
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    #[tokio::test]
    async fn who_says_nothing_makes_room_for_who_comes() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("an address");
        let mut listener = ClientListener::new(listener, "page");
        // Given all places taken by connections that are only opened.
        let (mut silent, mut inside) = (Vec::new(), Vec::new());
        for _ in 0..PLACES {
            silent.push(TcpStream::connect(address).await.expect("connected"));
            inside.push(listener.next().await.0);
        }
        // When the first is answered and one more comes, then the second has to leave, and the new one is admitted.
        inside[0].write_all(b"answer").await.expect("written");
        let mut late = TcpStream::connect(address).await.expect("connected");
        let (mut visitor, _) = listener.next().await;
        late.write_all(b"question").await.expect("written");
        let mut received = [0; 8];
        visitor.read_exact(&mut received).await.expect("asked");
        let left = inside[1].read(&mut received).await.expect_err("the place is given away");
        assert_eq!(left.kind(), io::ErrorKind::ConnectionAborted);
        silent[0].write_all(b"more").await.expect("written");
        assert_eq!(inside[0].read(&mut received).await.expect("still inside"), 4);
        // When clients leave, then their places are free.
        inside.clear();
        drop(visitor);
        assert!(listener.places.taken().is_empty());
    }
}
