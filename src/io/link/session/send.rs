//! What a session sends: live datagrams, back-fill, thumbnails, in this order of priority.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use prost::Message as _;
use tokio::sync::watch;
use tokio::time::Instant;

use super::{JUDGE, Session, lock};
use crate::io::link::live::LiveQueue;
use crate::io::link::pace::Priority;
use crate::io::link::wire::{self, WireError};
use crate::io::proto::link::{self as pb, to_station};
use crate::io::records::{Record, Schema};

/// QUIC's short header, connection id, packet number, tag and frame header of one datagram, bytes.
const QUIC_OVERHEAD: f64 = 1.0 + 8.0 + 2.0 + 16.0 + 3.0;
/// Back-fill is written in portions that take this long on a slow path, so that live data never waits longer,
const PORTION_S: f64 = 0.03;
/// and on a path where a packet takes less, in portions of a packet
const PACKET: f64 = 1_100.0;
/// or of this duration.
const PORTION_FAST_S: f64 = 0.002;

/// The shortest wait: the resolution of the runtime's timer.
const TIMER: Duration = Duration::from_millis(1);

impl Session {
    /// The channel number of a record, and its announcement where the station has not received it on this path
    /// (`with_schema`: on the back-fill stream, where the schema is included unless the station has it).
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
    fn delay(&self, way: Priority) -> Duration {
        let now = Instant::now();
        let own = lock(&self.governor).delay(way, now);
        let ceiling = self.shared.ceiling.as_ref();
        let shared = ceiling.map_or(Duration::ZERO, |bucket| lock(bucket).delay(way, now));
        own.max(shared)
    }

    fn charge(&self, bytes: usize) {
        let packets = (bytes as f64 / PACKET).ceil().max(1.0);
        let cost = bytes as f64 + packets * (QUIC_OVERHEAD + self.headers);
        self.predicted.fetch_add(cost as u64, Ordering::Relaxed);
        self.charge_exactly(cost);
    }

    pub(super) fn charge_exactly(&self, cost: f64) {
        lock(&self.governor).charge(cost);
        if let Some(bucket) = &self.shared.ceiling {
            lock(bucket).charge(cost);
        }
    }

    /// Live datagrams: the newest of the most urgent records, whenever something may be sent.
    pub(super) async fn live(&self, mut news: watch::Receiver<u32>) -> Result<(), WireError> {
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
            let delay = self.delay(Priority::Live);
            if !delay.is_zero() {
                // A newer estimate may arrive meanwhile and replace the waiting one.
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

    /// Waits until no live record waits, the path answers, and something may be sent.
    async fn low_turn(&self) {
        loop {
            let cut = lock(&self.governor).is_cut();
            let delay = self.delay(Priority::Low);
            if !cut && delay.is_zero() && !self.live_waits.load(Ordering::Relaxed) {
                return;
            }
            tokio::time::sleep(delay.clamp(TIMER, JUDGE)).await;
        }
    }

    /// Bytes of one portion of back-fill or thumbnail.
    fn portion(&self) -> usize {
        let own = lock(&self.governor).rate();
        let rate = self.shared.ceiling.as_ref().map_or(own, |bucket| lock(bucket).rate().min(own));
        ((rate * PORTION_S).min(PACKET).max(rate * PORTION_FAST_S) as usize).clamp(200, 32 << 10)
    }

    /// Sends the station's missing records, on one stream with lower priority than all live data.
    pub(super) async fn backfill(&self) -> Result<(), WireError> {
        let ended = |e: String| WireError::Ended(e);
        let mut stream = self.connection.open_uni().await.map_err(|e| ended(e.to_string()))?;
        // The stream exists: it was just opened.
        let _ = stream.set_priority(-1);
        stream.write_all(&[wire::KIND_BACKFILL]).await.map_err(|e| ended(e.to_string()))?;
        loop {
            let next = lock(&self.wanted).first();
            let Some((run, first, end)) = next else {
                self.wanted_more.notified().await;
                continue;
            };
            self.low_turn().await;
            let found = match self.shared.read(run, first, end, self.portion()).await {
                Ok(found) => found,
                Err(unread) => {
                    self.unread.fetch_add(1, Ordering::Relaxed);
                    lock(&self.wanted).postpone(run, first, unread.end);
                    continue;
                }
            };
            let (bytes, done) = self.portion_of(run, first, end, &found);
            self.charge(bytes.len());
            stream.write_all(&bytes).await.map_err(|e| ended(e.to_string()))?;
            self.backfilled.fetch_add(found.len() as u64, Ordering::Relaxed);
            lock(&self.wanted).done(run, first, done);
        }
    }

    /// The messages that answer `first..end` as far as `found` goes, and the end of the answered range.
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
    pub(super) async fn thumbnails(&self, wanted: bool) -> Result<(), WireError> {
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
}
