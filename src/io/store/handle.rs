//! The store as the rest of the program sees it: started once, handed things, never waited for.

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

/// How long the link waits for the card to tell the number of the run.
const WAIT_FOR_RUN: Duration = Duration::from_secs(5);

/// The running store.
#[derive(Debug)]
pub struct Store {
    handle: StoreHandle,
    writers: Vec<JoinHandle<()>>,
    keeper: Option<JoinHandle<()>>,
}

/// What everybody holds. Nothing here waits for the card, except where it says so.
#[derive(Clone, Debug)]
pub struct StoreHandle {
    intake: Arc<Queue<Work>>,
    shared: Arc<StoreShared>,
    keeper: std::sync::mpsc::SyncSender<Message>,
    region_margin_px: u32,
}

impl Store {
    /// Starts recording into a new flight, and tells the operator through the receiver. `config_toml`
    /// goes into every segment.
    pub fn start(
        store: &StoreConfig,
        config_toml: String,
        clock: HostClock,
    ) -> (Self, Receiver<StoreNotice>) {
        Self::start_on(Volume::new(&store.path), store, config_toml, clock)
    }

    /// The same on a volume given.
    pub fn start_on(
        volume: Volume,
        store: &StoreConfig,
        config_toml: String,
        clock: HostClock,
    ) -> (Self, Receiver<StoreNotice>) {
        let (notices, heard) = sync_channel(256);
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
        (Self { handle, writers: encode.into_iter().chain(write).collect(), keeper }, heard)
    }

    /// A handle to give away.
    pub fn handle(&self) -> StoreHandle {
        self.handle.clone()
    }

    /// Ends the flight properly: everything handed in is written, the segment is closed. Handles left
    /// elsewhere lose what they hand in from now on. Waits for the card, and a second at most for the
    /// index: what it lacks is found at the next start.
    pub fn stop(self) {
        let Self { handle, writers, keeper } = self;
        handle.intake.close();
        // A thread that panicked has said so; the flight is sealed at the next start.
        writers.into_iter().for_each(|thread| drop(thread.join()));
        handle.shared.stop();
        // The keeper may be in the middle of sealing or indexing: what it leaves is found again, and
        // nothing waits for it.
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
    /// Keeps an event as it was heard.
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

    /// Keeps a record. With a number it also waits, under this run and that number, for ground
    /// stations; numbers count up by one.
    pub fn record(&self, record: Arc<Record>, number: Option<u32>) {
        let bytes = record.data.len() + 128;
        let (topic, log_ns) = (record.topic.clone(), encode::unsigned(record.log_time));
        let weight = Weight::of(record.schema);
        let value = Work::Record(record, number);
        self.intake.push(Entry { value, bytes, weight, topic, log_ns });
    }

    /// Keeps a last known state under a name, for the next start: an opaque blob that should begin
    /// with a version. Once a second or less.
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

    /// Waits for what the card is to tell, as long as there is one to record on.
    fn wait_for<T>(&self, wait: Duration, told: impl Fn() -> Option<T>) -> Option<T> {
        const STEP: Duration = Duration::from_millis(10);
        for _ in 0..=wait.as_millis() / STEP.as_millis() {
            if let Some(told) = told() {
                return Some(told);
            }
            if matches!(self.shared.status().recording, Recording::Stopped(_)) {
                return None;
            }
            std::thread::sleep(STEP);
        }
        None
    }

    /// The index, where it answers.
    pub fn index(&self) -> Option<Index> {
        self.shared.index()
    }

    /// Tells when the flight began, once the receiver told UTC; the flight gets its name from it. A
    /// date that cannot be is not believed.
    pub fn set_start(&self, start: UtcTime) -> bool {
        let believable = start >= EARLIEST_UTC;
        if believable {
            self.shared.set_start(start);
        }
        believable
    }

    /// Tells where vehicles are in the image (pixels of anything seen of them), for
    /// `frames = "region"`; nothing seen keeps whole frames.
    pub fn watch(&self, pixels: impl IntoIterator<Item = (f64, f64)>) {
        self.shared.set_region(Region::around(pixels, self.region_margin_px));
    }

    /// How the store does.
    pub fn status(&self) -> StoreStatus {
        let mut status = self.shared.status().clone();
        status.waiting_bytes += self.intake.bytes() as u64;
        status
    }

    /// Identity of this run, under which numbered records are kept. Waits for the card up to five
    /// seconds; without one it is a number that no card has, and numbered records are not queued.
    pub fn run(&self) -> u32 {
        let told = self.wait_for(WAIT_FOR_RUN, || self.shared.session());
        told.unwrap_or_else(|| self.shared.settle_session(rand::random::<u32>() | 0x8000_0000))
    }

    /// A station has every number of a run below `through` on its disk.
    pub fn acknowledge(&self, station: &str, run: u32, through: u32) {
        // Lost where the keeper is behind: the station says it again when it connects.
        let _ = self.keeper.try_send(Message::Cursor(station.to_owned(), run, through));
    }
}
