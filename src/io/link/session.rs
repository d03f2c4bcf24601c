//! The payload's side of one connection: live datagrams, back-fill, thumbnails, control.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use prost::Message as _;
use quinn::{Connection, SendStream};
use tokio::sync::{Notify, mpsc, watch};
use tokio::time::Instant;

use super::endpoint::{Ended, Peer};
use super::live::LiveQueue;
use super::pace::Governor;
use super::payload::{Shared, StationStatus};
use super::ranges::RangeSet;
use super::sense::Sense;
use super::wire::{self, MINOR, Reader, WireError};
use crate::io::proto::link::{self as pb, to_payload, to_station};
use crate::io::records::{Record, Schema};

/// Longest a greeting may take.
const GREETING: Duration = Duration::from_secs(20);
/// How often the path is judged.
const JUDGE: Duration = Duration::from_millis(100);
/// QUIC's short header, connection id, packet number, tag and frame header of one datagram, bytes.
const QUIC_OVERHEAD: f64 = 1.0 + 8.0 + 2.0 + 16.0 + 3.0;
/// Ranges a station may ask for at once; more would only be sent again.
const WANT_LIMIT: usize = 1_024;
/// Back-fill is written in portions that take the path this long, so that live data never waits longer.
const PORTION_S: f64 = 0.03;

/// What the tasks of a session share.
pub(super) struct Session {
    shared: Arc<Shared>,
    connection: Connection,
    governor: Mutex<Governor>,
    wanted: Mutex<Wanted>,
    wanted_more: Notify,
    live_waits: AtomicBool,
    table: Mutex<Table>,
    control: mpsc::Sender<pb::ToStation>,
    live: AtomicU64,
    thinned: AtomicU64,
    backfilled: AtomicU64,
    predicted: AtomicU64,
    name: String,
    /// IP and UDP headers of one packet, bytes.
    headers: f64,
}

/// What the station asked for, and what already went on a stream of this connection (which QUIC delivers).
#[derive(Default)]
struct Wanted {
    open: BTreeMap<u32, RangeSet>,
    sent: BTreeMap<u32, RangeSet>,
}

impl Wanted {
    /// Replaces what was asked for.
    fn replace(&mut self, ranges: &[pb::Range]) {
        self.open.clear();
        for range in ranges.iter().take(WANT_LIMIT) {
            let sent = self.sent.entry(range.run).or_default();
            let open = self.open.entry(range.run).or_default();
            for (first, end) in sent.missing(range.first, range.end) {
                open.insert_range(first, end);
            }
        }
    }

    /// The first range still to be sent.
    fn first(&self) -> Option<(u32, u32, u32)> {
        self.open.iter().find_map(|(run, set)| set.iter().next().map(|(first, end)| (*run, first, end)))
    }

    fn done(&mut self, run: u32, first: u32, end: u32) {
        if let Some(open) = self.open.get_mut(&run) {
            open.remove_range(first, end);
        }
        self.sent.entry(run).or_default().insert_range(first, end);
    }

    fn count(&self) -> u64 {
        self.open.values().map(RangeSet::len).sum()
    }
}

/// Channel numbers of this connection.
#[derive(Default)]
struct Table {
    numbers: BTreeMap<(String, &'static str), (u32, bool)>,
    known: Vec<u64>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Serves a station until the connection ends; tells why it did. `up` is called when both have greeted.
pub(super) async fn serve(shared: &Arc<Shared>, peer: &Peer, up: impl Fn()) -> Ended {
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

/// The control stream is opened by whoever called; both sides greet at once.
async fn greet(shared: &Arc<Shared>, connection: &Connection) -> Result<Greeted, WireError> {
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
    shared: &Arc<Shared>,
    peer: &Peer,
    control_out: SendStream,
    control_in: Reader,
    hello: pb::StationHello,
) -> Result<(), WireError> {
    let (control, control_queue) = mpsc::channel(64);
    let address = peer.connection.remote_address();
    let mapped = matches!(address.ip(), std::net::IpAddr::V6(ip) if ip.to_ipv4_mapped().is_none());
    let session = Session {
        shared: Arc::clone(shared),
        connection: peer.connection.clone(),
        governor: Mutex::new(Governor::new(Instant::now())),
        wanted: Mutex::default(),
        wanted_more: Notify::new(),
        live_waits: AtomicBool::new(false),
        table: Mutex::new(Table { known: hello.known_schemas, ..Table::default() }),
        control,
        live: AtomicU64::new(0),
        thinned: AtomicU64::new(0),
        backfilled: AtomicU64::new(0),
        predicted: AtomicU64::new(0),
        name: peer.name.clone(),
        headers: if mapped { 48.0 } else { 28.0 },
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
    /// The channel number of a record, and its announcement where the station has not had it on this path
    /// (`with_schema`: on the back-fill stream, where the schema goes along unless the station has it).
    fn channel(&self, record: &Record, with_schema: bool) -> (u32, Option<pb::Channel>) {
        let key = (record.topic.to_string(), record.schema.name());
        let mut table = lock(&self.table);
        let next = table.numbers.len() as u32 + 1;
        let (id, had_schema) = *table.numbers.entry(key.clone()).or_insert((next, false));
        let fresh = id == next;
        if !(fresh || (with_schema && !had_schema)) {
            return (id, None);
        }
        let schema = record.schema.descriptor();
        let schema_hash = wire::schema_hash(&schema);
        let known = table.known.contains(&schema_hash);
        table.numbers.insert(key, (id, with_schema));
        let schema = if with_schema && !known { schema } else { Vec::new() };
        let (topic, schema_name) = (record.topic.to_string(), Schema::name(record.schema).into());
        (id, Some(pb::Channel { id, topic, schema_name, schema_hash, schema }))
    }

    fn encode(&self, run: u32, number: u32, channel: u32, record: &Record) -> pb::Record {
        pb::Record {
            number,
            channel,
            log_time_ns: record.log_time.ns(),
            true_before_ns: (record.log_time - record.publish_time).ns(),
            data: record.data.clone(),
            run,
        }
    }

    /// Time until something may be sent.
    fn delay(&self) -> Duration {
        let now = Instant::now();
        let own = lock(&self.governor).delay(now);
        let shared = self.shared.ceiling.as_ref().map_or(Duration::ZERO, |bucket| lock(bucket).delay(now));
        own.max(shared)
    }

    fn charge(&self, bytes: usize) {
        let packets = (bytes as f64 / 1_100.0).ceil().max(1.0);
        let cost = bytes as f64 + packets * (QUIC_OVERHEAD + self.headers);
        self.predicted.fetch_add(cost as u64, Ordering::Relaxed);
        self.charge_exactly(cost);
    }

    fn charge_exactly(&self, cost: f64) {
        lock(&self.governor).charge(cost);
        if let Some(bucket) = &self.shared.ceiling {
            lock(bucket).charge(cost);
        }
    }

    /// Judges the path, accounts for what was sent beyond what was foreseen, tells how it does.
    async fn judge(&self) -> Result<(), WireError> {
        let sent = |stats: &quinn::ConnectionStats| {
            stats.udp_tx.bytes as f64 + stats.udp_tx.datagrams as f64 * self.headers
        };
        // The handshake counts under the ceiling; as to the path, it is over.
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
                wanted: lock(&self.wanted).count(),
            });
        }
    }

    /// Live datagrams: the newest of what is most urgent, whenever something may be sent.
    async fn live(&self, mut news: watch::Receiver<u32>) -> Result<(), WireError> {
        let mut queue = LiveQueue::default();
        let mut seen = self.shared.recent.end().saturating_sub(64);
        loop {
            let end = *news.borrow_and_update();
            for number in seen..end {
                if let Some(record) = self.shared.recent.get(number) {
                    queue.push(number, record);
                }
            }
            seen = seen.max(end);
            self.thinned.store(queue.thinned(), Ordering::Relaxed);
            self.live_waits.store(!queue.is_empty(), Ordering::Relaxed);
            let changed = news.changed();
            if queue.is_empty() {
                changed.await.map_err(|_| WireError::Ended("the program ends".into()))?;
                continue;
            }
            let delay = self.delay();
            if !delay.is_zero() {
                // A newer estimate may come meanwhile and take the place of the one that waits.
                let _ = tokio::time::timeout(delay, changed).await;
                continue;
            }
            if let Some(waiting) = queue.pop() {
                self.send_live(waiting.number, &waiting.record).await?;
            }
        }
    }

    async fn send_live(&self, number: u32, record: &Record) -> Result<(), WireError> {
        let (channel, announcement) = self.channel(record, false);
        if let Some(channel) = announcement {
            let body = Some(to_station::Body::Channel(channel));
            self.control
                .send(pb::ToStation { body })
                .await
                .map_err(|_| WireError::Ended("the control stream ended".into()))?;
        }
        let record = self.encode(self.shared.recent.run(), number, channel, record);
        let bytes = pb::Live { records: vec![record] }.encode_to_vec();
        if self.connection.max_datagram_size().is_none_or(|most| bytes.len() > most) {
            // Too long for a packet: the station misses its number and gets it on a stream.
            return Ok(());
        }
        self.charge(bytes.len());
        self.live.fetch_add(1, Ordering::Relaxed);
        match self.connection.send_datagram(bytes.into()) {
            Ok(()) | Err(quinn::SendDatagramError::TooLarge) => Ok(()),
            Err(e) => Err(WireError::Ended(e.to_string())),
        }
    }

    /// Waits until nothing live waits, the path answers, and something may be sent.
    async fn low_turn(&self) {
        loop {
            let cut = lock(&self.governor).is_cut();
            let delay = self.delay();
            if !cut && delay.is_zero() && !self.live_waits.load(Ordering::Relaxed) {
                return;
            }
            tokio::time::sleep(delay.clamp(Duration::from_millis(2), JUDGE)).await;
        }
    }

    /// Bytes of one portion of back-fill or thumbnail.
    fn portion(&self) -> usize {
        let own = lock(&self.governor).rate();
        ((own * PORTION_S) as usize).clamp(200, 32 << 10)
    }

    /// Sends again what the station misses, on one stream below all live data.
    async fn backfill(&self) -> Result<(), WireError> {
        let ended = |e: String| WireError::Ended(e);
        let mut stream = self.connection.open_uni().await.map_err(|e| ended(e.to_string()))?;
        // The stream cannot be gone: it was opened just now.
        let _ = stream.set_priority(-1);
        stream.write_all(&[wire::KIND_BACKFILL]).await.map_err(|e| ended(e.to_string()))?;
        loop {
            let next = lock(&self.wanted).first();
            let Some((run, first, end)) = next else {
                self.wanted_more.notified().await;
                continue;
            };
            self.low_turn().await;
            let found = self.shared.read(run, first, end, self.portion()).await;
            let (bytes, done) = self.portion_of(run, first, end, &found);
            self.charge(bytes.len());
            stream.write_all(&bytes).await.map_err(|e| ended(e.to_string()))?;
            self.backfilled.fetch_add(found.len() as u64, Ordering::Relaxed);
            lock(&self.wanted).done(run, first, done);
        }
    }

    /// The messages that answer `first..end` as far as `found` goes, and the end of what they answer.
    fn portion_of(&self, run: u32, first: u32, end: u32, found: &[(u32, Arc<Record>)]) -> (Vec<u8>, u32) {
        let mut bytes = Vec::new();
        let mut put = |body| bytes.extend(pb::Backfill { body: Some(body) }.encode_length_delimited_to_vec());
        let gone = |first, end| pb::backfill::Body::Gone(pb::Range { run, first, end });
        let mut at = first;
        for (number, record) in found {
            if at < *number {
                put(gone(at, *number));
            }
            let (channel, announcement) = self.channel(record, true);
            if let Some(channel) = announcement {
                put(pb::backfill::Body::Channel(channel));
            }
            put(pb::backfill::Body::Record(self.encode(run, *number, channel, record)));
            at = number + 1;
        }
        if found.is_empty() {
            put(gone(first, end));
            at = end;
        }
        (bytes, at)
    }

    /// Thumbnails, in portions like back-fill.
    async fn thumbnails(&self, wanted: bool) -> Result<(), WireError> {
        let (Some(interval), true) = (self.shared.thumbnails, wanted) else {
            return std::future::pending().await;
        };
        let ended = |e: String| WireError::Ended(e);
        let mut pictures = self.shared.picture.subscribe();
        loop {
            pictures.changed().await.map_err(|_| ended("the program ends".into()))?;
            self.low_turn().await;
            let Some(picture) = pictures.borrow_and_update().clone() else { continue };
            let width = self.shared.thumbnail_width;
            let made = tokio::task::spawn_blocking(move || picture.thumbnail(width)).await;
            let Ok(Some(thumbnail)) = made else { continue };
            let bytes = thumbnail.encode_to_vec();
            let mut stream = self.connection.open_uni().await.map_err(|e| ended(e.to_string()))?;
            let _ = stream.set_priority(-2);
            stream.write_all(&[wire::KIND_THUMBNAIL]).await.map_err(|e| ended(e.to_string()))?;
            let mut at = 0;
            while at < bytes.len() {
                self.low_turn().await;
                let part = &bytes[at..(at + self.portion()).min(bytes.len())];
                self.charge(part.len());
                stream.write_all(part).await.map_err(|e| ended(e.to_string()))?;
                at += part.len();
            }
            let _ = stream.finish();
            tokio::time::sleep(interval).await;
        }
    }

    /// What the station says.
    async fn listen(&self, mut control: Reader) -> Result<(), WireError> {
        while let Some(message) = control.next::<pb::ToPayload>().await? {
            match message.body {
                Some(to_payload::Body::Want(want)) => {
                    lock(&self.wanted).replace(&want.ranges);
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

    /// The control stream to the station: channel numbers, and once a second how far the run is.
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
