//! The writer thread: records from the queue to the card, durable once a second.
//!
//! It is the only one that waits for the card. When the card is full, gone, read-only or broken, recording stops with a
//! notice. What cannot be written is counted and recorded as a dropout, and recording is tried again every few seconds.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, TrySendError};
use std::time::Duration;

use super::encode::{parse_state, unsigned};
use super::flight_writer::{self, FlightWriter, SegmentLimits};
use super::index::{Change, QueuedRecord};
use super::inspect::RecorderLock;
use super::keeper::Message;
use super::queue::{Drops, Popped, Queue};
use super::record::{ChannelDef, DROPOUT_TOPIC, RawRecord, STATE_TOPIC, Weight};
use super::segment::Head;
use super::status::{Durations, Recording, StoreNotice};
use super::store_shared::StoreShared;
use super::volume::{StoreError, StoreResult, Volume, device_of};
use crate::config::StoreConfig;
use crate::io::clock::HostClock;
use windhover_base::time::{MonoTime, Span};

/// How often everything is made durable.
const COMMIT_EVERY: Span = Span::from_ns(1_000_000_000);

/// How long to wait before the card is tried again after an error.
const RETRY_EVERY: Span = Span::from_ns(2_000_000_000);

/// Recording continues when this much more than the minimum is free.
const RESUME_MARGIN_BYTES: u64 = 16 << 20;

/// Most changes that are held for an index that does not answer; the segments have them too.
const MAX_CHANGES: usize = 20_000;

/// The recorder's settings.
#[derive(Clone, Debug)]
pub(super) struct Settings {
    pub(super) config: StoreConfig,
    pub(super) head: Head,
    pub(super) limits: SegmentLimits,
}

pub(super) struct Recorder {
    volume: Volume,
    settings: Settings,
    clock: HostClock,
    shared: Arc<StoreShared>,
    keeper: SyncSender<Message>,
    flight: Option<FlightWriter>,
    trouble: Option<String>,
    retry_at: MonoTime,
    /// Log time of the newest record taken, ns.
    newest_ns: Option<u64>,
    missed: Drops,
    uncommitted: Drops,
    changes: Vec<Change>,
    committed: Durations,
    dropouts: Arc<ChannelDef>,
    lock: Option<RecorderLock>,
    /// The file system recorded to.
    device: Option<u64>,
}

impl Recorder {
    pub(super) fn new(
        volume: Volume,
        settings: Settings,
        clock: HostClock,
        shared: Arc<StoreShared>,
        keeper: SyncSender<Message>,
    ) -> Self {
        Self {
            volume,
            settings,
            clock,
            shared,
            keeper,
            flight: None,
            trouble: None,
            retry_at: clock.now(),
            newest_ns: None,
            missed: Drops::default(),
            uncommitted: Drops::default(),
            changes: Vec::new(),
            committed: Durations::default(),
            dropouts: ChannelDef::json(DROPOUT_TOPIC),
            lock: None,
            device: None,
        }
    }

    /// Runs until the queue is closed and empty, then ends the flight. `upstream` reports messages that were dropped
    /// before the queue.
    pub(super) fn run(mut self, queue: &Queue<RawRecord>, upstream: impl Fn() -> Drops) {
        self.attempt();
        let mut due = self.clock.now() + COMMIT_EVERY;
        loop {
            let left = (due - self.clock.now()).ns().max(0) as u64;
            match queue.pop(Duration::from_nanos(left)) {
                Popped::Entry(entry) => self.take(&entry.value),
                Popped::Nothing => {}
                Popped::Closed => break,
            }
            if self.clock.now() >= due {
                let mut drops = queue.take_drops();
                drops.join(upstream());
                self.tick(drops, queue.bytes() as u64);
                due = self.clock.now() + COMMIT_EVERY;
            }
        }
        let mut drops = queue.take_drops();
        drops.join(upstream());
        self.tick(drops, 0);
        self.end();
    }

    fn is_open(&self) -> bool {
        self.flight.as_ref().is_some_and(FlightWriter::is_open)
    }

    fn take(&mut self, record: &RawRecord) {
        self.newest_ns = self.newest_ns.max(Some(record.log_ns));
        if !self.is_open() {
            self.missed.add(&record.channel.topic, record.data.len(), record.log_ns);
            return;
        }
        self.note_change(record);
        self.uncommitted.add(&record.channel.topic, record.data.len(), record.log_ns);
        let pushed = self.flight.as_mut().map_or(Ok(()), |flight| flight.push(record));
        if let Err(error) = pushed {
            self.fail(&error);
        }
    }

    /// The index entry of a record once it is durable.
    fn note_change(&mut self, record: &RawRecord) {
        let Some(session) = self.flight.as_ref().map(FlightWriter::session) else { return };
        if record.channel.backfill && self.shared.session() == Some(session) {
            let queued = QueuedRecord {
                topic: record.channel.topic.clone(),
                schema: record.channel.schema_name.clone(),
                log_ns: record.log_ns,
                publish_ns: record.publish_ns,
                data: record.data.to_vec(),
            };
            self.changes.push(Change::Queue(session, record.sequence, queued));
        } else if record.channel.topic == STATE_TOPIC
            && let Some((name, blob)) = parse_state(&record.data)
        {
            self.changes.push(Change::State(name, blob));
        }
    }

    fn tick(&mut self, drops: Drops, waiting: u64) {
        self.missed.join(drops);
        let now = self.clock.now();
        let space = self.volume.space().ok();
        if self.is_open() {
            self.commit(now, space.map(|(free, _)| free));
        } else if now >= self.retry_at {
            self.attempt();
        }
        self.rename();
        let mut status = self.shared.status();
        status.free_mb = space.map(|(free, _)| free >> 20);
        status.waiting_bytes = waiting;
        status.fsync_p99_ms = self.committed.p99();
        status.fsync_max_ms = self.committed.max();
        status.flight = self.flight.as_ref().map_or_else(String::new, |f| f.name().to_owned());
        status.recording = match &self.trouble {
            Some(reason) => Recording::Stopped(reason.clone()),
            None if self.is_open() => Recording::On,
            None => Recording::Starting,
        };
    }

    fn commit(&mut self, now: MonoTime, free: Option<u64>) {
        if self.missed.count() > 0 {
            self.record_dropout(now);
        }
        if let Err(error) = self.same_card() {
            return self.fail(&error);
        }
        let Some(flight) = &mut self.flight else { return };
        let result = flight.commit(unsigned(now));
        let after = self.clock.now();
        self.committed.add((after - now).ms());
        match result {
            Err(error) => return self.fail(&error),
            Ok(finished) => {
                self.uncommitted = Drops::default();
                let session = flight.session();
                let mut status = self.shared.status();
                status.bytes_written = flight.bytes();
                status.last_commit_ns = after.ns();
                drop(status);
                self.send_changes();
                if let Some(segment) = finished {
                    self.send(Message::SegmentDone { session, segment });
                }
            }
        }
        let floor = self.settings.config.free_floor_mb << 20;
        if free.is_some_and(|free| free < floor) {
            self.pause_for_space(floor);
        }
    }

    /// An open file survives the unmounting of its card: what is then written to it is lost.
    fn same_card(&self) -> StoreResult<()> {
        if Some(self.volume.device()?) == self.device {
            return Ok(());
        }
        let gone = std::io::Error::other("the card was removed or exchanged");
        Err(StoreError::new("continue recording to", self.volume.root(), gone))
    }

    fn pause_for_space(&mut self, floor: u64) {
        let paused = self.flight.as_mut().map_or(Ok(None), FlightWriter::pause);
        if let Err(error) = paused {
            return self.fail(&error);
        }
        let path = self.volume.root().display().to_string();
        self.stop(format!(
            "{path} has less than {} MB free; delete flights or move them off the card",
            floor >> 20
        ));
        self.send(Message::NeedSpace);
    }

    /// Reports why nothing is recorded, once.
    fn stop(&mut self, reason: String) {
        self.retry_at = self.clock.now() + RETRY_EVERY;
        self.shared.status().recording = Recording::Stopped(reason.clone());
        if self.trouble.as_ref() != Some(&reason) {
            self.shared.notice(StoreNotice::Stopped { reason: reason.clone() });
        }
        self.trouble = Some(reason);
    }

    fn fail(&mut self, error: &StoreError) {
        self.changes.clear();
        self.missed.join(std::mem::take(&mut self.uncommitted));
        if let Some(flight) = &mut self.flight {
            flight.abandon_segment();
        }
        if error.is_full() {
            self.send(Message::NeedSpace);
        }
        self.stop(error.to_string());
    }

    /// Tries to record: begins the flight, or continues it.
    fn attempt(&mut self) {
        let begins = self.flight.is_none();
        match self.try_open() {
            Ok(()) => {
                let flight = self.flight.as_ref().map_or_else(String::new, |f| f.name().to_owned());
                let mut status = self.shared.status();
                status.recording = Recording::On;
                status.flight.clone_from(&flight);
                drop(status);
                self.shared.notice(match self.trouble.take() {
                    Some(_) => StoreNotice::Resumed { flight },
                    None => StoreNotice::Started { flight },
                });
                // Notified afterwards: the index's notices follow from this.
                if let (true, Some(flight)) = (begins, &self.flight) {
                    let (session, name) = (flight.session(), flight.name().to_owned());
                    self.send(Message::Begun { session, name });
                }
            }
            Err(error) => self.stop(error.to_string()),
        }
    }

    fn try_open(&mut self) -> StoreResult<()> {
        if self.device.is_some() && self.volume.device().ok() != self.device {
            // An open file, also the lock's, keeps a removed card busy.
            self.lock = None;
        }
        if self.settings.config.require_mount {
            require_mount(&self.volume)?;
        }
        let (free, _) = self.volume.space()?;
        let needed = (self.settings.config.free_floor_mb << 20)
            + if self.trouble.is_some() { RESUME_MARGIN_BYTES } else { 0 };
        if free < needed {
            self.send(Message::NeedSpace);
            let full = std::io::Error::from(std::io::ErrorKind::StorageFull);
            return Err(StoreError::new("keep a reserve on", self.volume.root(), full));
        }
        // The lock on a removed card has no effect: it is acquired again.
        self.lock = None;
        self.lock = Some(RecorderLock::acquire(self.volume.root())?);
        self.device = Some(self.volume.device()?);
        self.send(Message::CardFound);
        let now_ns = unsigned(self.clock.now());
        let start = self.shared.start();
        if let Some(flight) = &mut self.flight {
            return flight.resume(now_ns, start);
        }
        let session = flight_writer::next_session(&self.volume)?;
        let run = self.shared.settle_session(session);
        let mut head = Head { time_ns: now_ns, ..self.settings.head.clone() };
        head.metadata.insert("run".into(), run.to_string());
        let flight = FlightWriter::begin(&self.volume, session, start, head, self.settings.limits)?;
        self.flight = Some(flight);
        Ok(())
    }

    /// Names the flight by its date once the receiver has reported it.
    fn rename(&mut self) {
        let (Some(start), Some(flight)) = (self.shared.start(), &mut self.flight) else { return };
        let from = flight.name().to_owned();
        match flight.set_start(start) {
            Ok(true) => {
                let (session, to) = (flight.session(), flight.name().to_owned());
                self.shared.notice(StoreNotice::Named { from, to: to.clone() });
                self.send(Message::Begun { session, name: to });
            }
            Ok(false) => {}
            Err(error) => self.shared.notice(StoreNotice::Failed { reason: error.to_string() }),
        }
    }

    /// Records the losses in the segment, where readers find them.
    fn record_dropout(&mut self, now: MonoTime) {
        let missed = std::mem::take(&mut self.missed);
        let (messages, bytes) = (missed.count(), missed.bytes);
        let (from_ns, to_ns) = missed.span_ns.unwrap_or_default();
        let losses = serde_json::json!({
            "from_ns": from_ns,
            "to_ns": to_ns,
            "bytes": bytes,
            "messages": missed.messages,
            "reason": self.trouble.as_deref().unwrap_or("the card did not keep up"),
        });
        // At its place in time among the others, not before waiting records.
        let at = self.newest_ns.unwrap_or(unsigned(now));
        self.take(&RawRecord {
            channel: Arc::clone(&self.dropouts),
            log_ns: at,
            publish_ns: at,
            sequence: 0,
            data: losses.to_string().into_bytes().into(),
            weight: Weight::Small,
        });
        self.shared.notice(StoreNotice::Dropout { messages, bytes });
        let mut status = self.shared.status();
        status.dropouts += 1;
        status.dropped_messages += messages;
    }

    fn send_changes(&mut self) {
        if self.changes.is_empty() {
            return;
        }
        // Sent, or there is no keeper any more; only a keeper that is behind is tried again.
        let sent = self.keeper.try_send(Message::Changes(std::mem::take(&mut self.changes)));
        if let Err(TrySendError::Full(Message::Changes(held))) = sent {
            self.changes = held;
            let excess = self.changes.len().saturating_sub(MAX_CHANGES);
            self.changes.drain(..excess);
        }
    }

    /// A message that the keeper misses concerns data that it finds on the card.
    fn send(&self, message: Message) {
        let _ = self.keeper.try_send(message);
    }

    fn end(&mut self) {
        self.shared.status().unwritten.clone_from(&self.trouble);
        let Some(flight) = &mut self.flight else {
            self.shared.status().unwritten.get_or_insert("no flight was begun".into());
            return;
        };
        let session = flight.session();
        let finished = flight.finish();
        self.shared.status().bytes_written = flight.bytes();
        match finished {
            Ok(Some(segment)) => self.send(Message::SegmentDone { session, segment }),
            Ok(None) => {}
            Err(error) => {
                self.shared.status().unwritten.get_or_insert(error.to_string());
                self.shared.notice(StoreNotice::Failed { reason: error.to_string() });
            }
        }
        self.shared.status().recording = Recording::Off;
    }
}

/// An empty mount point is a directory of the system disk: recording there would fill that.
fn require_mount(volume: &Volume) -> StoreResult<()> {
    let root = volume.root();
    let parent = root.parent().unwrap_or(root);
    if volume.device()? == device_of(parent)? {
        let missing = std::io::Error::other("nothing is mounted there (the data card is missing?)");
        return Err(StoreError::new("record to", root, missing));
    }
    Ok(())
}

/// Metadata that this program writes to every segment.
pub(super) fn program_metadata() -> BTreeMap<String, String> {
    BTreeMap::from([
        ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("magnetic_model".to_owned(), "WMM2025".to_owned()),
    ])
}
