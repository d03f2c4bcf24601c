//! The station's side of one connection: datagrams and streams in, requests and acknowledgements out.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use prost::Message as _;
use quinn::{Connection, RecvStream, SendStream, VarInt};
use tokio::time::Instant;

use super::peer::{Ended, Peer};
use super::station_shared::{Arrival, Channel, FromPayload, PayloadState, StationShared, lock};
use super::wire::{self, MINOR, Reader, THUMBNAIL_LIMIT, WireError};
use crate::io::proto::{
    link::{self as pb, to_payload, to_station},
    schema_of_package,
};
use windhover_base::time::{MonoTime, Span};

/// Longest a greeting may take.
const GREETING: Duration = Duration::from_secs(20);
/// How often missing numbers are checked.
const LOOK: Duration = Duration::from_millis(250);
/// A request is repeated after this time even when nothing changed.
const ASK_AGAIN: Duration = Duration::from_secs(4);
/// Most channel numbers of a payload.
const CHANNELS: usize = 1_024;
/// Bytes of all schemas of a payload; those of this program take some tens of kilobytes.
const SCHEMA_BYTES: usize = 8 << 20;
/// Longest topic or schema name, bytes.
const NAME_LIMIT: usize = 256;

struct Receiver {
    shared: Arc<StationShared>,
    state: Arc<PayloadState>,
    connection: Connection,
    payload: Arc<str>,
    channels: Mutex<BTreeMap<u32, Arc<Channel>>>,
    flights: Mutex<BTreeMap<u32, Arc<str>>>,
}

/// Receives from a payload until the connection ends; returns the reason. `up` is called when both sides have greeted.
pub(super) async fn receive(
    shared: &Arc<StationShared>,
    state: &Arc<PayloadState>,
    peer: &Peer,
    up: impl Fn(),
) -> Ended {
    let receiver = Receiver {
        shared: Arc::clone(shared),
        state: Arc::clone(state),
        connection: peer.connection.clone(),
        payload: peer.name.as_str().into(),
        channels: Mutex::default(),
        flights: Mutex::default(),
    };
    let outcome = match tokio::time::timeout(GREETING, receiver.greet()).await {
        Ok(Ok((control_out, control_in))) => {
            up();
            tokio::select! {
                outcome = receiver.datagrams() => outcome,
                outcome = receiver.streams() => outcome,
                outcome = receiver.listen(control_in) => outcome,
                outcome = receiver.speak(control_out) => outcome,
            }
        }
        Ok(Err(e)) => Err(e),
        Err(_) => Err(WireError::Ended("no greeting".into())),
    };
    Ended::conclude(&peer.connection, outcome)
}

/// Schemas that this program has: its own and Foxglove's.
fn known_schemas() -> Vec<u64> {
    ["windhover", "foxglove"].map(|package| wire::schema_hash(&schema_of_package(package))).to_vec()
}

impl Receiver {
    async fn greet(&self) -> Result<(SendStream, Reader), WireError> {
        let ended = |e: quinn::ConnectionError| WireError::Ended(e.to_string());
        let (mut out, input) = match self.connection.side() {
            quinn::Side::Client => self.connection.open_bi().await.map_err(ended)?,
            quinn::Side::Server => self.connection.accept_bi().await.map_err(ended)?,
        };
        let hello = pb::StationHello {
            minor: MINOR,
            software: concat!("windhover ", env!("CARGO_PKG_VERSION")).into(),
            known_schemas: known_schemas(),
            thumbnails: self.shared.thumbnails,
        };
        wire::write(&mut out, &pb::ToPayload { body: Some(to_payload::Body::Hello(hello)) }).await?;
        let mut input = Reader::new(input);
        match input.next::<pb::ToStation>().await? {
            Some(pb::ToStation { body: Some(to_station::Body::Hello(hello)) }) => {
                lock(&self.state.status).software = hello.software.chars().take(64).collect();
                for extent in &hello.extents {
                    self.announce(extent);
                }
                Ok((out, input))
            }
            Some(_) => Err(WireError::Malformed("the payload did not greet first".into())),
            None => Err(WireError::Ended("the payload left".into())),
        }
    }

    fn announce(&self, extent: &pb::Extent) {
        // The name of a flight becomes a directory: other names are refused.
        if !is_flight_name(&extent.flight) || extent.first > extent.end {
            return;
        }
        let recall = |flight: &str, run| (self.shared.recall)(&self.payload, flight, run);
        let known = {
            let mut received = lock(&self.state.received);
            received.announce(extent, recall);
            received.flight(extent.run).is_some()
        };
        if !known {
            return;
        }
        lock(&self.flights).entry(extent.run).or_insert_with(|| extent.flight.as_str().into());
    }

    fn learn(&self, channel: pb::Channel) {
        let mut channels = lock(&self.channels);
        let fits = channel.topic.len() <= NAME_LIMIT && channel.schema_name.len() <= NAME_LIMIT;
        if !fits || (channels.len() >= CHANNELS && !channels.contains_key(&channel.id)) {
            return;
        }
        let pb::Channel { id, topic, schema_name, schema, .. } = channel;
        let known = channels.get(&id).is_some_and(|c| c.topic == topic && !c.schema.is_empty());
        let all: usize = channels.values().map(|channel| channel.schema.len()).sum();
        if !known && all + schema.len() <= SCHEMA_BYTES {
            channels.insert(id, Arc::new(Channel { topic, schema_name, schema }));
        }
    }

    /// Passes a record on if it is new. Its channel must be known: numbers of unknown channels are not taken, and are
    /// so requested again.
    async fn take(&self, record: pb::Record, live: bool) -> Result<(), WireError> {
        let arrived = Instant::now();
        *lock(&self.state.last_received) = arrived;
        let Some(channel) = lock(&self.channels).get(&record.channel).cloned() else { return Ok(()) };
        let Some(flight) = lock(&self.flights).get(&record.run).cloned() else { return Ok(()) };
        if !lock(&self.state.received).take(record.run, record.number) {
            return Ok(());
        }
        lock(&self.state.status).live += u64::from(live);
        let log_time = MonoTime::from_ns(record.log_time_ns);
        let arrival = Arrival {
            payload: Arc::clone(&self.payload),
            run: record.run,
            flight,
            number: record.number,
            channel,
            log_time,
            publish_time: log_time - Span::from_ns(record.true_before_ns),
            data: record.data,
            live,
            arrived,
        };
        let sent = self.shared.records.send(FromPayload::Record(arrival)).await;
        sent.map_err(|_| WireError::Ended("the program ends".into()))
    }

    async fn datagrams(&self) -> Result<(), WireError> {
        loop {
            let bytes = self.connection.read_datagram().await.map_err(|e| WireError::Ended(e.to_string()))?;
            // An unknown kind of datagram is from a newer version, not an error.
            let Ok(live) = pb::Live::decode(bytes) else { continue };
            for record in live.records {
                self.take(record, true).await?;
            }
        }
    }

    async fn streams(&self) -> Result<(), WireError> {
        let mut open = futures_util::stream::FuturesUnordered::new();
        loop {
            use futures_util::StreamExt as _;
            tokio::select! {
                stream = self.connection.accept_uni() => {
                    let stream = stream.map_err(|e| WireError::Ended(e.to_string()))?;
                    open.push(self.stream(stream));
                }
                Some(done) = open.next() => done?,
            }
        }
    }

    async fn stream(&self, mut stream: RecvStream) -> Result<(), WireError> {
        let mut kind = [0];
        if stream.read_exact(&mut kind).await.is_err() {
            return Ok(());
        }
        match kind[0] {
            wire::KIND_BACKFILL => self.backfill(Reader::new(stream)).await,
            wire::KIND_THUMBNAIL => {
                let Ok(bytes) = stream.read_to_end(THUMBNAIL_LIMIT).await else { return Ok(()) };
                if let Ok(thumbnail) = pb::Thumbnail::decode(&bytes[..]) {
                    let payload = Arc::clone(&self.payload);
                    // A thumbnail is dropped rather than waited for.
                    let _ = self.shared.records.try_send(FromPayload::Thumbnail { payload, thumbnail });
                }
                Ok(())
            }
            _ => {
                // The stream of a newer payload: it is asked not to send it.
                let _ = stream.stop(VarInt::from_u32(0));
                Ok(())
            }
        }
    }

    async fn backfill(&self, mut reader: Reader) -> Result<(), WireError> {
        while let Some(message) = reader.next::<pb::Backfill>().await? {
            match message.body {
                Some(pb::backfill::Body::Channel(channel)) => self.learn(channel),
                Some(pb::backfill::Body::Record(record)) => self.take(record, false).await?,
                Some(pb::backfill::Body::Gone(range)) => lock(&self.state.received).gone(&range),
                None => {}
            }
        }
        Ok(())
    }

    async fn listen(&self, mut control: Reader) -> Result<(), WireError> {
        while let Some(message) = control.next::<pb::ToStation>().await? {
            match message.body {
                Some(to_station::Body::Channel(channel)) => self.learn(channel),
                Some(to_station::Body::Head(head)) => self.announce(&head),
                Some(to_station::Body::Hello(_)) | None => {}
            }
        }
        Ok(())
    }

    /// Requests missing numbers and acknowledges those on disk.
    async fn speak(&self, mut out: SendStream) -> Result<(), WireError> {
        let mut asked = pb::Want::default();
        let mut asked_at = Instant::now();
        let mut reported = pb::Stored::default();
        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                _ = look.tick() => {
                    if self.shared.holding.load(Ordering::Relaxed) {
                        continue;
                    }
                    let want = lock(&self.state.received).want();
                    let again = asked_at.elapsed() > ASK_AGAIN && !want.ranges.is_empty();
                    if is_news(&asked, &want) || again {
                        let body = Some(to_payload::Body::Want(want.clone()));
                        wire::write(&mut out, &pb::ToPayload { body }).await?;
                        (asked, asked_at) = (want, Instant::now());
                    }
                }
                () = self.state.stored.notified() => {
                    let stored = lock(&self.state.received).stored_message();
                    if stored != reported {
                        let body = Some(to_payload::Body::Stored(stored.clone()));
                        wire::write(&mut out, &pb::ToPayload { body }).await?;
                        reported = stored;
                    }
                }
            }
        }
    }
}

/// Whether a new request is useful: a number is missing that was not requested, unless most of a long request is still
/// to come.
fn is_news(asked: &pb::Want, want: &pb::Want) -> bool {
    let held =
        |r: &pb::Range| asked.ranges.iter().any(|a| a.run == r.run && a.first <= r.first && r.end <= a.end);
    let fresh = want.ranges.iter().filter(|r| !held(r)).count();
    let rest = want.ranges.len() - fresh;
    fresh > 0 && (rest < 16 || 2 * fresh > rest)
}

/// The names of flights: a compact UTC time, or `boot-N`, with an optional `-N`.
fn is_flight_name(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    (1..=64).contains(&name.len()) && name.chars().all(allowed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_could_leave_the_directory_are_refused() {
        assert!(is_flight_name("20261118T150405Z-2") && is_flight_name("boot-12"));
        for bad in ["", ".", "..", "a/b", "/etc", "a\0b", "ä", &"x".repeat(65)] {
            assert!(!is_flight_name(bad), "{bad:?}");
        }
    }

    #[test]
    fn a_request_is_repeated_only_when_it_changed_enough() {
        let want = |ranges: &[(u32, u32)]| pb::Want {
            ranges: ranges.iter().map(|&(first, end)| pb::Range { run: 1, first, end }).collect(),
        };
        let asked = want(&[(0, 10), (20, 30)]);
        assert!(!is_news(&asked, &want(&[(5, 10), (20, 30)])), "part of it came");
        assert!(is_news(&asked, &want(&[(20, 30), (40, 41)])), "something new is missing");
        assert!(!is_news(&asked, &want(&[])));
    }
}
