//! Replay: a recording through the pipeline that runs in flight.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use super::config_file;
use super::sink::Outlets;
use super::sinks::FlightFile;
use crate::config::{Config, ConfigError};
use crate::io::capture::{CaptureItem, CaptureReader, attached_config};
use crate::io::clock::HostClock;
use crate::io::mcap_read::ReadError;
use crate::io::mcap_write::WriteError;
use crate::io::records::OutputEncoder;
use crate::pipeline::Pipeline;
use crate::pixels::{self, DecodedFrame, FrameFault};
use windhover_base::msg::{EventBody, Output, TimedOutput};
use windhover_base::time::{MonoTime, Span};

/// Events that are read, and frames that are decoded, ahead of the pipeline.
const AHEAD: usize = 16;
/// Bytes of their pixels: sixteen 4K frames, or one of any size.
const AHEAD_BYTES: usize = 256 << 20;

/// Why a recording could not be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The recording could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The flight could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// No configuration anywhere.
    #[error("{} has no configuration attached: give one with --config FILE", path.display())]
    NoConfig {
        /// The recording.
        path: PathBuf,
    },
    /// The attached configuration is wrong.
    #[error("the configuration attached to {}: {source}", path.display())]
    BadConfig {
        /// The recording.
        path: PathBuf,
        /// What is wrong with it.
        source: ConfigError,
    },
    /// The recording has no usable messages.
    #[error("{} holds no serial bytes and no frames", path.display())]
    Nothing {
        /// The recording.
        path: PathBuf,
    },
}

/// A step of a replay, for progress displays.
pub enum ReplayStep<'a> {
    /// An output of the pipeline.
    Output(&'a Output),
    /// Bytes of the recording that are processed, and in total.
    Progress(u64, u64),
    /// Damage found in the recording.
    Warning(&'a str),
}

/// The result of a replay.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct ReplaySummary {
    /// Events replayed.
    pub events: u64,
    /// Frames among them.
    pub frames: u64,
    /// Length of the recording.
    pub recorded: Span,
    /// How long the replay took.
    pub took: Span,
}

/// The configuration attached to a recording.
pub fn config_of(recording: &Path) -> Result<Config, ReplayError> {
    let text =
        attached_config(recording)?.ok_or_else(|| ReplayError::NoConfig { path: recording.to_owned() })?;
    Config::parse(&text).map_err(|source| ReplayError::BadConfig { path: recording.to_owned(), source })
}

/// Replays a recording; writes a flight to `out` where it is given; with `realtime`, at the pace of the recording.
pub fn replay(
    recording: &Path,
    config: &Config,
    out: Option<&Path>,
    realtime: bool,
    watch: &mut dyn FnMut(ReplayStep<'_>),
) -> Result<ReplaySummary, ReplayError> {
    let reader = CaptureReader::open(recording)?;
    let mut run = ReplayRun::new(recording, config, out, realtime);
    let want_rgb = run.pipeline.wants_rgb();
    let (sender, receiver) = sync_channel(AHEAD);
    let room = Room::new();
    thread::scope(|scope| {
        let taker = RoomGuard(&room);
        scope.spawn(|| read_ahead(reader, want_rgb, sender, &room));
        // By value: a flight that cannot be written also ends the reader, which waits for room.
        run.all(receiver, taker, watch)
    })?;
    if run.summary.events == 0 {
        return Err(ReplayError::Nothing { path: recording.to_owned() });
    }
    run.summary.took = run.clock.now() - run.started;
    Ok(run.summary)
}

/// Bytes of decoded frames that wait for the pipeline: reading ahead is bounded by bytes as well as by number.
struct Room {
    /// Bytes that wait; `None` when the taker has ended.
    taken: Mutex<Option<usize>>,
    freed: Condvar,
}

impl Room {
    fn new() -> Self {
        Self { taken: Mutex::new(Some(0)), freed: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, Option<usize>> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until there is room for this many bytes; a single frame always has room, whatever its size.
    fn take(&self, bytes: usize) {
        let full = |taken: &mut Option<usize>| {
            taken.is_some_and(|taken| taken > 0 && taken.saturating_add(bytes) > AHEAD_BYTES)
        };
        let mut taken = self.freed.wait_while(self.lock(), full).unwrap_or_else(PoisonError::into_inner);
        *taken = taken.map(|taken| taken.saturating_add(bytes));
    }

    fn give(&self, bytes: usize) {
        let mut taken = self.lock();
        *taken = taken.map(|taken| taken.saturating_sub(bytes));
        drop(taken);
        self.freed.notify_one();
    }
}

/// Releases the reader, which may wait for room, when the taker ends.
struct RoomGuard<'a>(&'a Room);

impl Drop for RoomGuard<'_> {
    fn drop(&mut self) {
        *self.0.lock() = None;
        self.0.freed.notify_all();
    }
}

/// Bytes of a frame's pixels.
fn bytes_of(prepared: Option<&Result<DecodedFrame, FrameFault>>) -> usize {
    let Some(Ok(frame)) = prepared else { return 0 };
    let (width, height) = (frame.gray.width, frame.gray.height);
    width * height * if frame.rgb.is_some() { 4 } else { 1 }
}

/// What the reading thread passes on.
enum Ahead {
    Item(Box<CaptureItem>, Option<Result<DecodedFrame, FrameFault>>, (u64, u64)),
    Warning(String),
}

/// Reads and decodes ahead; the pipeline's thread sees items in order, however fast this thread is.
fn read_ahead(mut reader: CaptureReader, want_rgb: bool, sender: SyncSender<Ahead>, room: &Room) {
    while let Some(item) = reader.next() {
        let prepared = match item.event.as_ref().map(|e| &e.body) {
            Some(EventBody::Frame(frame)) => Some(pixels::decode(frame, want_rgb)),
            _ => None,
        };
        room.take(bytes_of(prepared.as_ref()));
        let warnings = reader.take_warnings().into_iter().map(Ahead::Warning);
        let progress = reader.progress();
        let item = std::iter::once(Ahead::Item(Box::new(item), prepared, progress));
        for ahead in warnings.chain(item) {
            if sender.send(ahead).is_err() {
                return;
            }
        }
    }
    for warning in reader.take_warnings() {
        if sender.send(Ahead::Warning(warning)).is_err() {
            return;
        }
    }
}

struct ReplayRun {
    pipeline: Pipeline,
    outlets: Outlets<FlightFile>,
    outputs: Vec<TimedOutput>,
    summary: ReplaySummary,
    clock: HostClock,
    started: MonoTime,
    pace: Option<Pace>,
    first: Option<MonoTime>,
}

impl ReplayRun {
    fn new(recording: &Path, config: &Config, out: Option<&Path>, realtime: bool) -> Self {
        let clock = HostClock::start();
        // A configuration that passed its checks can be written as TOML.
        let text = config.to_toml().unwrap_or_default();
        let file = out.map(|path| FlightFile::new(path.to_owned(), text, config.camera.clone()));
        Self {
            pipeline: Pipeline::with_terrain(config.into(), config_file::terrain_of(config, recording)),
            outlets: Outlets::new(OutputEncoder::new(&config.target), file.into_iter().collect()),
            outputs: Vec::new(),
            summary: ReplaySummary::default(),
            clock,
            started: clock.now(),
            pace: realtime.then(Pace::default),
            first: None,
        }
    }

    fn all(
        &mut self,
        receiver: Receiver<Ahead>,
        taker: RoomGuard<'_>,
        watch: &mut dyn FnMut(ReplayStep<'_>),
    ) -> Result<(), ReplayError> {
        for ahead in receiver {
            let (item, prepared, (done, total)) = match ahead {
                Ahead::Warning(words) => {
                    watch(ReplayStep::Warning(&words));
                    continue;
                }
                Ahead::Item(item, prepared, progress) => (item, prepared, progress),
            };
            taker.0.give(bytes_of(prepared.as_ref()));
            let t = item.raw.log_time;
            watch(ReplayStep::Progress(done, total));
            self.outlets.sinks.iter_mut().try_for_each(|file| file.copy(&item.raw))?;
            let Some(event) = item.event else { continue };
            if let Some(pace) = &mut self.pace {
                pace.wait_until(t, &self.clock);
            }
            self.count(t, &event.body);
            self.pipeline.handle_prepared(&event, prepared, &mut self.outputs);
            self.deliver(watch)?;
        }
        self.pipeline.finish(&mut self.outputs);
        self.deliver(watch)?;
        self.outlets.sinks.drain(..).try_for_each(FlightFile::finish)?;
        Ok(())
    }

    fn count(&mut self, t: MonoTime, body: &EventBody) {
        let first = *self.first.get_or_insert(t);
        self.summary.recorded = t - first;
        self.summary.events += 1;
        self.summary.frames += u64::from(matches!(body, EventBody::Frame(_)));
    }

    fn deliver(&mut self, watch: &mut dyn FnMut(ReplayStep<'_>)) -> Result<(), ReplayError> {
        for timed in self.outputs.drain(..) {
            watch(ReplayStep::Output(&timed.output));
            self.outlets.output(&timed);
        }
        self.outlets.sinks.iter_mut().try_for_each(FlightFile::check)?;
        Ok(())
    }
}

/// Holds a replay at the pace of the recording.
#[derive(Default)]
struct Pace {
    behind: Option<Span>,
}

impl Pace {
    /// Longest single wait: longer gaps of the recording are shortened.
    const LONGEST: Span = Span::from_ns(2_000_000_000);

    fn wait_until(&mut self, recorded: MonoTime, clock: &HostClock) {
        let now = clock.now();
        let behind = *self.behind.get_or_insert(now - recorded);
        let wait = (recorded + behind) - now;
        if wait > Self::LONGEST || wait < -Self::LONGEST {
            self.behind = Some(now - recorded);
        } else if wait > Span::ZERO {
            thread::sleep(Duration::from_nanos(wait.ns().unsigned_abs()));
        }
    }
}
