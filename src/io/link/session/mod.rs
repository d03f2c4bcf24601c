//! The payload's side of one connection: greeting, control, assessment of its path.

mod send;
mod wanted;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use quinn::{Connection, SendStream};
use tokio::sync::{Notify, mpsc};
use tokio::time::Instant;

use super::governor::Governor;
use super::payload_shared::{PayloadShared, StationStatus};
use super::peer::{Ended, Peer};
use super::sense::Sense;
use super::wire::{self, MINOR, Reader, WireError};
use crate::io::proto::link::{self as pb, to_payload, to_station};
use wanted::Wanted;

/// Longest a greeting may take.
const GREETING: Duration = Duration::from_secs(20);
/// How often the path is assessed.
const JUDGE: Duration = Duration::from_millis(100);

/// What the tasks of a session share.
pub(super) struct Session {
    shared: Arc<PayloadShared>,
    connection: Connection,
    governor: Mutex<Governor>,
    wanted: Mutex<Wanted>,
    wanted_more: Notify,
    live_waits: AtomicBool,
    table: Mutex<ChannelTable>,
    control: mpsc::Sender<pb::ToStation>,
    live: AtomicU64,
    thinned: AtomicU64,
    backfilled: AtomicU64,
    unread: AtomicU64,
    predicted: AtomicU64,
    name: String,
    /// IP and UDP headers of one packet, bytes.
    headers: f64,
}

/// Channel numbers of this connection.
#[derive(Default)]
struct ChannelTable {
    numbers: BTreeMap<(String, &'static str), (u32, bool)>,
    known: Vec<u64>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Serves a station until the connection ends; returns the reason. `up` is called when both sides have greeted.
pub(super) async fn serve(shared: &Arc<PayloadShared>, peer: &Peer, up: impl Fn()) -> Ended {
    let connection = peer.connection.clone();
    let outcome = match tokio::time::timeout(GREETING, greet(shared, &connection)).await {
        Ok(Ok((control_out, control_in, hello))) => {
            up();
            run(shared, peer, control_out, control_in, hello).await
        }
        Ok(Err(e)) => Err(e),
        Err(_) => Err(WireError::Ended("no greeting".into())),
    };
    Ended::conclude(&connection, outcome)
}

type Greeted = (SendStream, Reader, pb::StationHello);

/// The control stream is opened by the side that connected; both sides greet at once.
async fn greet(shared: &Arc<PayloadShared>, connection: &Connection) -> Result<Greeted, WireError> {
    let ended = |e: quinn::ConnectionError| WireError::Ended(e.to_string());
    let (mut out, input) = match connection.side() {
        quinn::Side::Client => connection.open_bi().await.map_err(ended)?,
        quinn::Side::Server => connection.accept_bi().await.map_err(ended)?,
    };
    let hello = pb::PayloadHello {
        minor: MINOR,
        software: concat!("windhover ", env!("CARGO_PKG_VERSION")).into(),
        run: shared.recent.run(),
        extents: shared.extents().into_iter().map(extent).collect(),
    };
    wire::write(&mut out, &pb::ToStation { body: Some(to_station::Body::Hello(hello)) }).await?;
    let mut input = Reader::new(input);
    match input.next::<pb::ToPayload>().await? {
        Some(pb::ToPayload { body: Some(to_payload::Body::Hello(hello)) }) => Ok((out, input, hello)),
        Some(_) => Err(WireError::Malformed("the station did not greet first".into())),
        None => Err(WireError::Ended("the station left".into())),
    }
}

fn extent(e: super::backlog::Extent) -> pb::Extent {
    pb::Extent { run: e.run, flight: e.flight, first: e.first, end: e.end }
}

async fn run(
    shared: &Arc<PayloadShared>,
    peer: &Peer,
    control_out: SendStream,
    control_in: Reader,
    hello: pb::StationHello,
) -> Result<(), WireError> {
    let (control, control_queue) = mpsc::channel(64);
    let address = peer.connection.remote_address();
    let mapped = matches!(address.ip(), std::net::IpAddr::V6(ip) if ip.to_ipv4_mapped().is_none());
    let headers = if mapped { 48.0 } else { 28.0 };
    let session = Session {
        shared: Arc::clone(shared),
        connection: peer.connection.clone(),
        governor: Mutex::new(Governor::new(headers, Instant::now())),
        wanted: Mutex::default(),
        wanted_more: Notify::new(),
        live_waits: AtomicBool::new(false),
        table: Mutex::new(ChannelTable { known: hello.known_schemas, ..ChannelTable::default() }),
        control,
        live: AtomicU64::new(0),
        thinned: AtomicU64::new(0),
        backfilled: AtomicU64::new(0),
        unread: AtomicU64::new(0),
        predicted: AtomicU64::new(0),
        name: peer.name.clone(),
        headers,
    };
    let news = shared.news();
    tokio::select! {
        outcome = session.live(news) => outcome,
        outcome = session.backfill() => outcome,
        outcome = session.thumbnails(hello.thumbnails) => outcome,
        outcome = session.listen(control_in) => outcome,
        outcome = session.speak(control_out, control_queue) => outcome,
        outcome = session.judge() => outcome,
    }
}

impl Session {
    /// Assesses the path, accounts for bytes sent beyond the estimate, publishes the state.
    async fn judge(&self) -> Result<(), WireError> {
        let sent = |stats: &quinn::ConnectionStats| {
            stats.udp_tx.bytes as f64 + stats.udp_tx.datagrams as f64 * self.headers
        };
        // The handshake counts under the ceiling; for the path it is over.
        let mut accounted = sent(&self.connection.stats());
        if let Some(bucket) = &self.shared.ceiling {
            lock(bucket).charge(accounted);
        }
        loop {
            tokio::time::sleep(JUDGE).await;
            let noted = Sense::of(&self.connection).map(|sense| sense.take()).unwrap_or_default();
            let sent = sent(&self.connection.stats());
            let foreseen = self.predicted.swap(0, Ordering::Relaxed) as f64;
            let extra = sent - accounted - foreseen;
            if extra > 0.0 {
                self.charge_exactly(extra);
            }
            accounted = sent.max(accounted + foreseen);
            let (rate, cut) = {
                let mut governor = lock(&self.governor);
                governor.update(noted, Instant::now());
                (governor.rate(), governor.is_cut())
            };
            self.shared.note_status(StationStatus {
                name: self.name.clone(),
                hears_us: !cut,
                rtt_ms: self.connection.rtt().as_secs_f64() * 1e3,
                rate_kbps: rate * 8e-3,
                live: self.live.load(Ordering::Relaxed),
                thinned: self.thinned.load(Ordering::Relaxed),
                backfilled: self.backfilled.load(Ordering::Relaxed),
                unread: self.unread.load(Ordering::Relaxed),
                wanted: lock(&self.wanted).count(),
            });
        }
    }

    /// Handles the station's messages.
    async fn listen(&self, mut control: Reader) -> Result<(), WireError> {
        while let Some(message) = control.next::<pb::ToPayload>().await? {
            match message.body {
                Some(to_payload::Body::Want(want)) => {
                    let there = self.shared.extents();
                    lock(&self.wanted).replace(&want.ranges, &there);
                    self.wanted_more.notify_one();
                }
                Some(to_payload::Body::Stored(stored)) => self.acknowledge(&stored.ranges),
                Some(to_payload::Body::Hello(_)) | None => {}
            }
        }
        Ok(())
    }

    /// Moves the station's cursor in the store: to the end of the range that holds the first number.
    fn acknowledge(&self, ranges: &[pb::Range]) {
        let Some(deep) = &self.shared.deep else { return };
        for extent in self.shared.extents() {
            let through = ranges
                .iter()
                .filter(|r| r.run == extent.run && r.first <= extent.first && r.end > extent.first)
                .map(|r| r.end.min(extent.end))
                .max();
            if let Some(through) = through {
                deep.acknowledge(&self.name, extent.run, through);
            }
        }
    }

    /// The control stream to the station: channel numbers, and once a second the state of the run.
    async fn speak(
        &self,
        mut out: SendStream,
        mut queue: mpsc::Receiver<pb::ToStation>,
    ) -> Result<(), WireError> {
        let mut tick = tokio::time::interval(Duration::from_secs(1));
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        loop {
            let message = tokio::select! {
                message = queue.recv() => match message {
                    Some(message) => message,
                    None => return Ok(()),
                },
                _ = tick.tick() => {
                    let recent = &self.shared.recent;
                    let head = self.shared.extents().into_iter().find(|e| e.run == recent.run());
                    let Some(head) = head else { continue };
                    pb::ToStation { body: Some(to_station::Body::Head(extent(head))) }
                }
            };
            wire::write(&mut out, &message).await?;
        }
    }
}
