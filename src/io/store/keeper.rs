//! The keeper thread: all operations that may take long, so that recording never waits for them.
//!
//! It opens the index (or moves it aside and makes a new one), commits its changes, seals segments after a power cut,
//! updates the index to the content of the card, and deletes old flights.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use super::flight::{self, FLIGHTS, FlightInfo};
use super::flight_writer::FinishedSegment;
use super::index::{self, Change, INDEX, Index, IndexError, SegmentEntry};
use super::inspect;
use super::rebuild;
use super::retention;
use super::seal::{self, Sealing};
use super::status::{Recording, StoreNotice};
use super::store_shared::StoreShared;
use super::volume::{StoreResult, Volume};
use crate::config::StoreConfig;
use crate::io::clock::HostClock;
use windhover_base::time::{MonoTime, Span};

/// A message to the keeper.
#[derive(Debug)]
pub(super) enum Message {
    /// There is a card to record on; no flight has begun yet.
    CardFound,
    /// Changes from a durable segment.
    Changes(Vec<Change>),
    /// A segment is closed.
    SegmentDone {
        /// Run.
        session: u32,
        /// The segment.
        segment: FinishedSegment,
    },
    /// A flight began, or was renamed.
    Begun {
        /// Run.
        session: u32,
        /// Name of its directory.
        name: String,
    },
    /// The card is too full to record.
    NeedSpace,
    /// Queued records up to these are on the ground.
    Cursor(String, u32, u32),
}

/// Waiting work, one flight at a time.
#[derive(Debug)]
enum Task {
    Sweep,
    Look,
    Settle(String),
    Retain,
}

/// How often an index that cannot be opened is tried again.
const RETRY_INDEX: Span = Span::from_ns(5_000_000_000);

/// How often old flights are deleted.
const RETAIN_EVERY: Span = Span::from_ns(60_000_000_000);

/// Records are removed from the queue this many at a time.
const TRIM_STEP: u64 = 1_000;

pub(super) struct Keeper {
    volume: Volume,
    config: StoreConfig,
    clock: HostClock,
    shared: Arc<StoreShared>,
    index: Option<Index>,
    tried_at: Option<MonoTime>,
    retained_at: MonoTime,
    held: Vec<Change>,
    queued: u64,
    tasks: VecDeque<Task>,
    /// Whether there ever was a card.
    card_found: bool,
    present: Option<(u32, String)>,
    /// Whether the index was reported as complete since it was opened.
    complete: bool,
    /// The file system the index is on.
    device: Option<u64>,
}

impl Keeper {
    pub(super) fn new(
        volume: Volume,
        config: StoreConfig,
        clock: HostClock,
        shared: Arc<StoreShared>,
    ) -> Self {
        Self {
            volume,
            config,
            clock,
            shared,
            index: None,
            tried_at: None,
            retained_at: clock.now(),
            held: Vec::new(),
            queued: 0,
            tasks: VecDeque::new(),
            card_found: false,
            present: None,
            complete: false,
            device: None,
        }
    }

    /// Runs until the recorder is gone.
    pub(super) fn run(mut self, inbox: &Receiver<Message>) {
        loop {
            self.leave_lost_card();
            self.open_index();
            let wait = if self.tasks.is_empty() { 100 } else { 0 };
            match inbox.recv_timeout(Duration::from_millis(wait)) {
                Ok(message) => self.hear(message),
                // The recorder is gone before the store stops: no more messages come.
                Err(_) if self.shared.is_stopping() => break,
                Err(RecvTimeoutError::Timeout) => self.step(),
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        self.apply();
        self.shared.set_index(None);
    }

    fn hear(&mut self, message: Message) {
        match message {
            Message::CardFound => self.card_found = true,
            Message::Changes(changes) => {
                self.queued += changes.iter().filter(|c| matches!(c, Change::Queue(..))).count() as u64;
                self.held.extend(changes);
                self.trim();
                self.apply();
            }
            Message::SegmentDone { session, segment } => {
                self.held.push(Change::Segment(session, segment.number, entry_of(&segment)));
            }
            Message::Begun { session, name } => {
                let first = self.present.is_none();
                self.held.push(Change::Flight(session, name.clone()));
                self.present = Some((session, name));
                if first {
                    self.tasks.push_back(Task::Sweep);
                    self.tasks.push_back(Task::Look);
                }
            }
            Message::NeedSpace => {
                if !self.tasks.iter().any(|t| matches!(t, Task::Retain)) {
                    self.tasks.push_front(Task::Retain);
                }
            }
            Message::Cursor(station, run, through) => {
                self.held.push(Change::Cursor(station, run, through));
            }
        }
    }

    /// Limits the queue to its number of records; the oldest are removed a thousand at a time.
    fn trim(&mut self) {
        let Some(index) = &self.index else { return };
        if self.queued <= self.config.backfill_records + TRIM_STEP {
            return;
        }
        if let Some((run, first, end)) = index.queued_runs().first().copied() {
            let below = end.min(first.saturating_add(TRIM_STEP as u32));
            self.held.push(Change::Unqueue(run, below));
            self.queued = self.queued.saturating_sub(u64::from(below - first));
        }
    }

    fn apply(&mut self) {
        let Some(index) = &self.index else {
            // Without an index only the newest are held; the segments have all of them.
            let excess = self.held.len().saturating_sub(20_000);
            self.held.drain(..excess);
            return;
        };
        if self.held.is_empty() {
            return;
        }
        match index.apply(&self.held) {
            Ok(()) => self.held.clear(),
            Err(error) => {
                self.shared.notice(StoreNotice::Failed { reason: error.to_string() });
                self.close_index();
            }
        }
    }

    fn close_index(&mut self) {
        self.index = None;
        self.shared.set_index(None);
        self.tried_at = Some(self.clock.now());
    }

    /// An open index keeps a removed card busy, and is of no use.
    fn leave_lost_card(&mut self) {
        if self.index.is_some() && self.volume.device().ok() != self.device {
            self.close_index();
        }
    }

    /// Opens the index once the card is there, before there is a flight: the state of an earlier run is needed at once,
    /// and a flight begins with several waits for the card. An unusable index is moved aside and made again.
    fn open_index(&mut self) {
        let now = self.clock.now();
        let waiting = self.tried_at.is_some_and(|tried| now - tried < RETRY_INDEX);
        let stopped = matches!(self.shared.status().recording, Recording::Stopped(_));
        if self.index.is_some() || !self.card_found || waiting || stopped {
            return;
        }
        self.tried_at = Some(now);
        self.device = self.volume.device().ok();
        let dir = self.volume.path(INDEX);
        let opened = match Index::open(&dir) {
            Err(error @ IndexError::Unusable { .. }) => {
                self.shared.notice(StoreNotice::IndexRebuilding { reason: error.to_string() });
                match index::move_aside(&dir) {
                    Ok(_) => Index::open(&dir),
                    Err(_) => Err(error),
                }
            }
            other => other,
        };
        match opened {
            Ok(index) => {
                self.queued = index.queued_runs().iter().map(|(_, first, end)| u64::from(end - first)).sum();
                self.shared.set_index(Some(index.clone()));
                self.index = Some(index);
                self.complete = false;
                // Without a current flight it is not known which one must not be touched.
                if self.present.is_some() {
                    self.tasks.push_back(Task::Look);
                }
                self.apply();
            }
            Err(error) => self.shared.notice(StoreNotice::Failed { reason: error.to_string() }),
        }
    }

    /// One piece of work; a failure is reported, and the work is tried again at the next start.
    fn step(&mut self) {
        let now = self.clock.now();
        if now - self.retained_at >= RETAIN_EVERY {
            self.retained_at = now;
            self.tasks.push_back(Task::Retain);
        }
        let done = match self.tasks.pop_front() {
            None => return,
            Some(Task::Sweep) => flight::sweep(&self.volume),
            Some(Task::Look) => self.look(),
            Some(Task::Settle(name)) => self.settle(&name),
            Some(Task::Retain) => self.retain(),
        };
        if let Err(error) = done {
            self.shared.notice(StoreNotice::Failed { reason: error.to_string() });
        }
        if self.tasks.is_empty() && self.present.is_some() && !self.complete {
            self.apply();
            if let Some(index) = &self.index {
                self.shared.notice(StoreNotice::IndexReady { flights: index.flights().len() });
                self.complete = true;
            }
        }
    }

    /// Whether this is the current flight. Its number decides, whatever its present name.
    fn is_present(&self, name: &str) -> bool {
        self.present.as_ref().is_some_and(|(session, present)| {
            present == name || flight::session_of(&self.volume.path(FLIGHTS).join(name)) == Some(*session)
        })
    }

    /// Compares the directories with the index: flights that are incomplete in the index (a card may have been too slow
    /// at the end for the last segment), or were not closed, are settled one by one, newest first; entries of deleted
    /// flights are removed.
    fn look(&mut self) -> StoreResult<()> {
        let root = self.volume.root().to_owned();
        let known = self.index.as_ref().map_or(Vec::new(), Index::flights);
        let mut on_card = flight::flight_names(&root)?;
        on_card.retain(|name| !self.is_present(name));
        on_card.sort_by_cached_key(|name| std::cmp::Reverse(retention::age_order(&root, name)));
        for (run, name) in &known {
            let present = self.present.as_ref().is_some_and(|(session, _)| session == run);
            if !on_card.contains(name) && !present {
                self.held.push(Change::Forget(*run));
            }
        }
        let mut segments = BTreeMap::new();
        for ((run, _), _) in self.index.as_ref().map_or(Vec::new(), Index::segments) {
            *segments.entry(run).or_insert(0) += 1;
        }
        for name in on_card {
            let dir = root.join(FLIGHTS).join(&name);
            let closed = dir.join(flight::FLIGHT_FILE).exists();
            let whole = |run| segments.get(run).copied().unwrap_or(0) >= flight::segment_names(&dir).len();
            let indexed =
                self.index.is_none() || known.iter().any(|(run, known)| *known == name && whole(run));
            if !closed || !indexed {
                self.tasks.push_back(Task::Settle(name));
            }
        }
        Ok(())
    }

    /// Seals a flight's segments, writes its `flight.json`, adds it to the index.
    fn settle(&mut self, name: &str) -> StoreResult<()> {
        if self.is_present(name) || !self.volume.path(&format!("{FLIGHTS}/{name}")).is_dir() {
            return Ok(());
        }
        let closed = self.volume.path(&format!("{FLIGHTS}/{name}/{}", flight::FLIGHT_FILE)).exists();
        if !closed {
            let shared = Arc::clone(&self.shared);
            let sealed = settle_flight(&self.volume, name, false, |segment, sealing| {
                let what = describe(sealing);
                shared.notice(StoreNotice::Sealed { segment: segment.into(), what });
            })?;
            if sealed.is_none() {
                return Ok(());
            }
        }
        if let Some(index) = self.index.clone() {
            let room = self.config.backfill_records.saturating_sub(self.queued);
            self.queued += rebuild::index_flight(self.volume.root(), name, &index, room)?;
        }
        Ok(())
    }

    fn retain(&mut self) -> StoreResult<()> {
        let present = self.present.as_ref().map(|(session, _)| *session);
        let start = self.shared.start();
        let deleted = retention::make_room(&self.volume, &self.config, present, start)?;
        for (info, reason) in deleted {
            self.held.push(Change::Forget(info.session));
            self.shared.notice(StoreNotice::Deleted { flight: info.name, reason });
        }
        if let Ok((free, total)) = self.volume.space()
            && free < retention::wanted_free(&self.config, total)
        {
            self.shared.notice(StoreNotice::AlmostFull { free_mb: free >> 20 });
        }
        Ok(())
    }
}

fn entry_of(segment: &FinishedSegment) -> SegmentEntry {
    let first = segment.topics.values().map(|t| t.first_ns).min().unwrap_or(0);
    let last = segment.topics.values().map(|t| t.last_ns).max().unwrap_or(0);
    let messages = segment.topics.values().map(|t| t.count).sum();
    SegmentEntry { bytes: segment.bytes, messages, span_ns: (first, last) }
}

/// The result of sealing, as text.
pub fn describe(sealing: &Sealing) -> String {
    match sealing {
        Sealing::Whole => "whole".into(),
        Sealing::Closed { chunks, cut_bytes } => {
            format!("was cut off; {chunks} chunks kept, {cut_bytes} bytes after them discarded")
        }
        Sealing::Rewritten { chunks, lost_bytes } => {
            format!("had gaps; {chunks} chunks kept, {lost_bytes} bytes discarded")
        }
        Sealing::Removed => "had no complete chunk and was removed".into(),
    }
}

/// Seals all segments of a flight and writes its `flight.json`; a flight without any remaining segment is removed
/// (`None`). `report` is called for every segment that was not complete.
pub fn settle_flight(
    volume: &Volume,
    name: &str,
    deep: bool,
    mut report: impl FnMut(&str, &Sealing),
) -> StoreResult<Option<FlightInfo>> {
    let dir = format!("{FLIGHTS}/{name}");
    let mut repaired = 0;
    for segment in flight::segment_names(&volume.path(&dir)) {
        let sealing = seal::seal_segment(volume, &dir, &segment, deep)?;
        if sealing != Sealing::Whole {
            repaired += 1;
            report(&format!("{name}/{segment}"), &sealing);
        }
    }
    if flight::segment_names(&volume.path(&dir)).is_empty() {
        flight::delete(volume, name)?;
        return Ok(None);
    }
    let path = volume.path(&dir);
    let before = inspect::glance(volume.root(), name)?.repaired;
    let mut info = flight::summarize(&path)?;
    info.repaired = before + repaired;
    flight::write_info(volume, name, &info)?;
    Ok(Some(info))
}
