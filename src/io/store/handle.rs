//! The store's handle for the rest of the program: started once, takes items, never makes the caller wait.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use super::encode::{self, Work};
use super::flight_writer::SegmentLimits;
use super::frame_keeper::{FrameKeeper, Region};
use super::index::Index;
use super::keeper::{Keeper, Message};
use super::queue::{Entry, Queue};
use super::record::{RawRecord, STATE_TOPIC, Weight};
use super::recorder::{self, Recorder, Settings};
use super::segment::Head;
use super::status::{Recording, StoreNotice, StoreStatus};
use super::store_shared::StoreShared;
use super::volume::Volume;
use crate::config::StoreConfig;
use crate::io::clock::HostClock;
use crate::io::records::{self, Record};
use windhover_base::msg::{Event, EventBody, WarmState};
use windhover_base::time::{EARLIEST_UTC, UtcTime};

/// How long the link waits for the card to report the number of the run.
const WAIT_FOR_RUN: Duration = Duration::from_secs(5);

/// The running store.
#[derive(Debug)]
pub struct Store {
    handle: StoreHandle,
    writers: Vec<JoinHandle<()>>,
    keeper: Option<JoinHandle<()>>,
}

/// A handle on the store. No call waits for the card, except where documented.
#[derive(Clone, Debug)]
pub struct StoreHandle {
    intake: Arc<Queue<Work>>,
    shared: Arc<StoreShared>,
    keeper: std::sync::mpsc::SyncSender<Message>,
    region_margin_px: u32,
}

impl Store {
    /// Starts recording into a new flight, with notices for the operator through the receiver. `config_toml` is written
    /// to every segment.
    pub fn start(
        store: &StoreConfig,
        config_toml: String,
        clock: HostClock,
    ) -> (Self, Receiver<StoreNotice>) {
        Self::start_on(Volume::new(&store.path), store, config_toml, clock)
    }

    /// The same on a given volume.
    pub fn start_on(
        volume: Volume,
        store: &StoreConfig,
        config_toml: String,
        clock: HostClock,
    ) -> (Self, Receiver<StoreNotice>) {
        let (notices, received) = sync_channel(256);
        let (to_keeper, inbox) = sync_channel(256);
        let shared = Arc::new(StoreShared::new(notices));
        let half = (store.queue_mb as usize) << 19;
        let intake = Arc::new(Queue::new(half));
        let output: Arc<Queue<RawRecord>> = Arc::new(Queue::new(half));
        let frames = FrameKeeper::new(store);
        let limits = SegmentLimits {
            span_ns: (store.segment_s * 1e9) as u64,
            bytes: store.segment_mb << 20,
            frame_compression: frames.chunk_compression(),
        };
        let head = Head { config: config_toml, metadata: recorder::program_metadata(), time_ns: 0 };
        let settings = Settings { config: store.clone(), head, limits };
        let recorder = Recorder::new(volume.clone(), settings, clock, Arc::clone(&shared), to_keeper.clone());
        let keeper = Keeper::new(volume, store.clone(), clock, Arc::clone(&shared));
        let write = {
            let (intake, output) = (Arc::clone(&intake), Arc::clone(&output));
            spawn("store-write", move || recorder.run(&output, || intake.take_drops()))
        };
        let encode = {
            let (intake, shared) = (Arc::clone(&intake), Arc::clone(&shared));
            let work = move || encode::run(&intake, &output, &frames, &shared, || clock.now());
            spawn("store-encode", work)
        };
        let keeper = spawn("store-keep", move || keeper.run(&inbox));
        let handle =
            StoreHandle { intake, shared, keeper: to_keeper, region_margin_px: store.region_margin_px };
        (Self { handle, writers: encode.into_iter().chain(write).collect(), keeper }, received)
    }

    /// A further handle.
    pub fn handle(&self) -> StoreHandle {
        self.handle.clone()
    }

    /// Ends the flight properly: all items are written, the segment is closed. Items of other handles are lost from now
    /// on. Waits for the card, and at most a second for the index: its missing entries are added at the next start.
    pub fn stop(self) {
        let Self { handle, writers, keeper } = self;
        handle.intake.close();
        // A thread that panicked has reported it; the flight is sealed at the next start.
        writers.into_iter().for_each(|thread| drop(thread.join()));
        handle.shared.stop();
        // The keeper may be sealing or indexing: the rest is done at the next start, and nothing waits for it.
        for _ in 0..100 {
            if keeper.as_ref().is_none_or(JoinHandle::is_finished) {
                break;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Option<JoinHandle<()>> {
    std::thread::Builder::new().name(name.into()).spawn(work).ok()
}

impl StoreHandle {
    /// Stores an event.
    pub fn event(&self, event: &Event) {
        let Some(topic) = records::topic_of_event(&event.body) else { return };
        let (bytes, weight) = match &event.body {
            EventBody::Bytes { data, .. } => (data.len(), Weight::Small),
            EventBody::Frame(frame) => (frame.data.len(), Weight::Frame),
            EventBody::Warm(_) => (size_of::<WarmState>() + 1024, Weight::Small),
            _ => (0, Weight::Small),
        };
        let log_ns = encode::unsigned(event.t_recv);
        let value = Work::Event(event.clone());
        self.intake.push(Entry { value, bytes: bytes + 128, weight, topic: topic.into(), log_ns });
    }

    /// Stores a record. With a number it is also queued, under this run and that number, for ground stations; numbers
    /// count up by one.
    pub fn record(&self, record: Arc<Record>, number: Option<u32>) {
        let bytes = record.data.len() + 128;
        let (topic, log_ns) = (record.topic.clone(), encode::unsigned(record.log_time));
        let weight = Weight::of(record.schema);
        let value = Work::Record(record, number);
        self.intake.push(Entry { value, bytes, weight, topic, log_ns });
    }

    /// Stores a last known state under a name, for the next start: an opaque blob that should begin with a version. At
    /// most once a second.
    pub fn put_state(&self, name: &str, blob: Vec<u8>) {
        let bytes = blob.len() + 128;
        let value = Work::State(name.to_owned(), blob);
        self.intake.push(Entry { value, bytes, weight: Weight::Small, topic: STATE_TOPIC.into(), log_ns: 0 });
    }

    /// The last known state of a name, from this run or an earlier one; `None` where there is none, or
    /// the index does not answer within `wait`.
    pub fn state(&self, name: &str, wait: Duration) -> Option<Vec<u8>> {
        self.index_within(wait)?.state(name)
    }

    /// The index, once it answers; `None` where it does not within `wait`, or nothing is recorded.
    pub fn index_within(&self, wait: Duration) -> Option<Index> {
        self.wait_for(wait, || self.shared.index())
    }

    /// Waits for information from the card, as long as there is a card to record on.
    fn wait_for<T>(&self, wait: Duration, poll: impl Fn() -> Option<T>) -> Option<T> {
        const STEP: Duration = Duration::from_millis(10);
        for _ in 0..=wait.as_millis() / STEP.as_millis() {
            if let Some(answer) = poll() {
                return Some(answer);
            }
            if matches!(self.shared.status().recording, Recording::Stopped(_)) {
                return None;
            }
            std::thread::sleep(STEP);
        }
        None
    }

    /// The index, if it is open.
    pub fn index(&self) -> Option<Index> {
        self.shared.index()
    }

    /// Sets the start of the flight, once the receiver reported UTC; the flight is named by it. An impossible date is
    /// ignored.
    pub fn set_start(&self, start: UtcTime) -> bool {
        let believable = start >= EARLIEST_UTC;
        if believable {
            self.shared.set_start(start);
        }
        believable
    }

    /// Sets where vehicles are in the image (pixels of their detections), for `frames = "region"`; without any, whole
    /// frames are stored.
    pub fn watch(&self, pixels: impl IntoIterator<Item = (f64, f64)>) {
        self.shared.set_region(Region::around(pixels, self.region_margin_px));
    }

    /// State of the store.
    pub fn status(&self) -> StoreStatus {
        let mut status = self.shared.status().clone();
        status.waiting_bytes += self.intake.bytes() as u64;
        status
    }

    /// Identity of this run, under which numbered records are stored. Waits up to five seconds for the card; without
    /// one it is a number that no card has, and numbered records are not queued.
    pub fn run(&self) -> u32 {
        let session = self.wait_for(WAIT_FOR_RUN, || self.shared.session());
        session.unwrap_or_else(|| self.shared.settle_session(rand::random::<u32>() | 0x8000_0000))
    }

    /// A station has every number of a run below `through` on its disk.
    pub fn acknowledge(&self, station: &str, run: u32, through: u32) {
        // Lost where the keeper is behind: the station reports it again when it connects.
        let _ = self.keeper.try_send(Message::Cursor(station.to_owned(), run, through));
    }
}
