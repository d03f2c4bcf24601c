//! The sled database beside the segments: an index over them, the back-fill queue and the last known state. Never the
//! only copy of anything: its content can be made again from the segments.
//!
//! `flush()` of sled 0.34 calls sync_file_range and no fsync, and loses acknowledged records in a power cut; with an
//! fsync of its `db` file after it none were lost (docs/storage.md). Opened on a full disk it leaves an empty
//! `snap.*.generating` that makes every later open fail.

use std::fs::File;
use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::sync::mpsc::RecvTimeoutError;
use std::time::Duration;

use serde::{Deserialize, Serialize};

/// Directory of the index under the store's path.
pub const INDEX: &str = "index";

/// Longest time for sled to open an index; a large one after a power cut takes some seconds.
const PATIENCE: Duration = Duration::from_secs(20);
/// Nice value of the thread that opens it, which may be abandoned.
const LEAST: i32 = 19;

/// Keys of back-fill records: this byte, run, number.
const BACKFILL: u8 = b'b';
/// Keys of ground stations' cursors: this byte, run, name.
const CURSOR: u8 = b'c';
/// Keys of last known states: this byte, name.
const STATE: u8 = b's';
/// Keys of segments: this byte, run, number of the segment.
const SEGMENT: u8 = b'f';
/// Keys of flight names: this byte, run.
const FLIGHT: u8 = b'r';

/// Why the index cannot be used now.
#[derive(Debug, thiserror::Error)]
pub enum IndexError {
    /// Another process has it open.
    #[error("the index {} is in use by another windhover", path.display())]
    InUse {
        /// Its directory.
        path: PathBuf,
    },
    /// It is damaged, or the card is.
    #[error("the index {} cannot be used: {reason}", path.display())]
    Unusable {
        /// Its directory.
        path: PathBuf,
        /// The error of sled or the system.
        reason: String,
    },
}

/// The index entry of a segment.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
pub struct SegmentEntry {
    /// Bytes of the file.
    pub bytes: u64,
    /// Messages in it.
    pub messages: u64,
    /// Log time of its first and last message, ns.
    pub span_ns: (u64, u64),
}

/// A record in the back-fill queue.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct QueuedRecord {
    /// Topic.
    pub topic: String,
    /// Name of its schema.
    pub schema: String,
    /// Log time, ns.
    pub log_ns: u64,
    /// Time of validity, ns.
    pub publish_ns: u64,
    /// The message.
    pub data: Vec<u8>,
}

impl QueuedRecord {
    fn to_bytes(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.data.len() + self.topic.len() + self.schema.len() + 18);
        out.push(self.topic.len().min(255) as u8);
        out.push(self.schema.len().min(255) as u8);
        out.extend_from_slice(&self.log_ns.to_le_bytes());
        out.extend_from_slice(&self.publish_ns.to_le_bytes());
        out.extend_from_slice(&self.topic.as_bytes()[..self.topic.len().min(255)]);
        out.extend_from_slice(&self.schema.as_bytes()[..self.schema.len().min(255)]);
        out.extend_from_slice(&self.data);
        out
    }

    fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (topic, schema) = (usize::from(*bytes.first()?), usize::from(*bytes.get(1)?));
        let number = |at: usize| Some(u64::from_le_bytes(bytes.get(at..at + 8)?.try_into().ok()?));
        let text = |at: usize, n: usize| String::from_utf8(bytes.get(at..at + n)?.to_vec()).ok();
        Some(Self {
            topic: text(18, topic)?,
            schema: text(18 + topic, schema)?,
            log_ns: number(2)?,
            publish_ns: number(10)?,
            data: bytes.get(18 + topic + schema..)?.to_vec(),
        })
    }
}

/// One change of the index.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Change {
    /// A record is queued for the ground: run, number.
    Queue(u32, u32, QueuedRecord),
    /// Records of a run below a number are no longer queued.
    Unqueue(u32, u32),
    /// A station has every number of a run below this.
    Cursor(String, u32, u32),
    /// A last known state.
    State(String, Vec<u8>),
    /// A segment was closed: run, number.
    Segment(u32, u32, SegmentEntry),
    /// A run's flight has this name.
    Flight(u32, String),
    /// A run's flight no longer exists.
    Forget(u32),
}

fn key(kind: u8, parts: &[&[u8]]) -> Vec<u8> {
    let mut key = vec![kind];
    parts.iter().for_each(|part| key.extend_from_slice(part));
    key
}

fn number(bytes: &[u8]) -> Option<u32> {
    Some(u32::from_be_bytes(bytes.get(..4)?.try_into().ok()?))
}

/// The open index. Copies share it.
#[derive(Clone, Debug)]
pub struct Index {
    db: sled::Db,
    dir: PathBuf,
}

impl Index {
    /// Opens the index in directory `dir`, or makes an empty one, and reads the entries that every start needs. A panic
    /// inside sled is an error, and so is an index that sled does not open within twenty seconds: its thread is
    /// abandoned with the lowest priority, and ends with the process.
    pub fn open(dir: &Path) -> Result<Self, IndexError> {
        let unusable = |reason: &str| IndexError::Unusable { path: dir.to_owned(), reason: reason.into() };
        let (done, opened) = std::sync::mpsc::sync_channel(1);
        let of = dir.to_owned();
        let work = move || {
            let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), LEAST);
            let index = Self::open_now(&of).and_then(|index| index.check().map(|()| index));
            // Where nothing waits any more, the opened index is closed again.
            let _ = done.send(index);
        };
        std::thread::Builder::new()
            .name("index".into())
            .spawn(work)
            .map_err(|error| unusable(&error.to_string()))?;
        match opened.recv_timeout(PATIENCE) {
            Ok(outcome) => outcome,
            Err(RecvTimeoutError::Timeout) => Err(unusable(&format!("it does not open within {PATIENCE:?}"))),
            Err(RecvTimeoutError::Disconnected) => Err(unusable("sled panicked")),
        }
    }

    /// Reads everything but the queue.
    fn check(&self) -> Result<(), IndexError> {
        let unusable = |reason: String| IndexError::Unusable { path: self.dir.clone(), reason };
        let work = || -> sled::Result<()> {
            for kind in [CURSOR, STATE, SEGMENT, FLIGHT] {
                // sled repeats the same error without end.
                self.db.range(vec![kind]..vec![kind + 1]).try_for_each(|item| item.map(drop))?;
            }
            Ok(())
        };
        match std::panic::catch_unwind(AssertUnwindSafe(work)) {
            Ok(read) => read.map_err(|error| unusable(error.to_string().replace(" backtrace ()", ""))),
            Err(_) => Err(unusable("sled panicked".into())),
        }
    }

    fn open_now(dir: &Path) -> Result<Self, IndexError> {
        let unusable = |reason: String| IndexError::Unusable { path: dir.to_owned(), reason };
        remove_half_snapshots(dir);
        let fresh = !dir.exists();
        let config = sled::Config::new()
            .path(dir)
            .cache_capacity(8 << 20)
            .segment_size(64 << 10)
            .flush_every_ms(None)
            .mode(sled::Mode::HighThroughput);
        let opened = std::panic::catch_unwind(AssertUnwindSafe(|| config.open()));
        let db = match opened {
            Ok(Ok(db)) => db,
            Ok(Err(e)) if e.to_string().contains("lock") => {
                return Err(IndexError::InUse { path: dir.to_owned() });
            }
            Ok(Err(e)) => return Err(unusable(e.to_string())),
            Err(_) => return Err(unusable("sled panicked".into())),
        };
        let index = Self { db, dir: dir.to_owned() };
        if fresh {
            index.sync_names().map_err(|e| unusable(e.to_string()))?;
        }
        Ok(index)
    }

    fn sync_names(&self) -> std::io::Result<()> {
        File::open(&self.dir)?.sync_all()?;
        self.dir.parent().map_or(Ok(()), |parent| File::open(parent)?.sync_all())
    }

    /// Applies changes as one batch; durable on return.
    pub fn apply(&self, changes: &[Change]) -> Result<(), IndexError> {
        let unusable = |reason: String| IndexError::Unusable { path: self.dir.clone(), reason };
        let work = || -> Result<(), String> {
            let mut batch = sled::Batch::default();
            for change in changes {
                self.put(&mut batch, change).map_err(|e| e.to_string())?;
            }
            self.db.apply_batch(batch).map_err(|e| e.to_string())?;
            self.db.flush().map_err(|e| e.to_string())?;
            // sled's flush ends in sync_file_range, which is no barrier: fsync through a second handle is one.
            File::open(self.dir.join("db")).and_then(|f| f.sync_all()).map_err(|e| e.to_string())
        };
        match std::panic::catch_unwind(AssertUnwindSafe(work)) {
            Ok(done) => done.map_err(unusable),
            Err(_) => Err(unusable("sled panicked".into())),
        }
    }

    fn put(&self, batch: &mut sled::Batch, change: &Change) -> sled::Result<()> {
        match change {
            Change::Queue(run, n, record) => {
                batch.insert(key(BACKFILL, &[&run.to_be_bytes(), &n.to_be_bytes()]), record.to_bytes());
            }
            Change::Unqueue(run, below) => {
                let from = key(BACKFILL, &[&run.to_be_bytes(), &[0; 4]]);
                let to = key(BACKFILL, &[&run.to_be_bytes(), &below.to_be_bytes()]);
                for item in self.db.range(from..to) {
                    batch.remove(item?.0);
                }
            }
            Change::Cursor(station, run, through) => {
                batch.insert(key(CURSOR, &[&run.to_be_bytes(), station.as_bytes()]), &through.to_be_bytes());
            }
            Change::State(name, blob) => batch.insert(key(STATE, &[name.as_bytes()]), &blob[..]),
            Change::Segment(run, n, entry) => {
                let value = serde_json::to_vec(entry).expect("numbers are valid JSON");
                batch.insert(key(SEGMENT, &[&run.to_be_bytes(), &n.to_be_bytes()]), value);
            }
            Change::Flight(run, name) => batch.insert(key(FLIGHT, &[&run.to_be_bytes()]), name.as_bytes()),
            Change::Forget(run) => {
                batch.remove(key(FLIGHT, &[&run.to_be_bytes()]));
                for item in self.db.scan_prefix(key(SEGMENT, &[&run.to_be_bytes()])) {
                    batch.remove(item?.0);
                }
            }
        }
        Ok(())
    }

    fn items(&self, from: Vec<u8>, to: Vec<u8>) -> impl Iterator<Item = (Vec<u8>, Vec<u8>)> {
        // Unreadable entries are treated as absent: the segments have them. sled repeats its error without end.
        self.db.range(from..to).map_while(Result::ok).map(|(k, v)| (k.to_vec(), v.to_vec()))
    }

    /// Queued records `first..end` of a run, ascending, as far as the card can be read. An entry that is not a record
    /// is left out.
    pub fn queued(
        &self,
        run: u32,
        first: u32,
        end: u32,
    ) -> impl Iterator<Item = sled::Result<(u32, QueuedRecord)>> {
        let from = key(BACKFILL, &[&run.to_be_bytes(), &first.to_be_bytes()]);
        let to = key(BACKFILL, &[&run.to_be_bytes(), &end.to_be_bytes()]);
        let parsed =
            |(k, v): (sled::IVec, sled::IVec)| Some((number(&k[5..])?, QueuedRecord::from_bytes(&v)?));
        self.db.range(from..to).filter_map(move |entry| entry.map(parsed).transpose())
    }

    /// Runs with queued records: run, least number, one more than the greatest.
    pub fn queued_runs(&self) -> Vec<(u32, u32, u32)> {
        let mut runs = Vec::new();
        let mut from = vec![BACKFILL];
        while let Some((k, _)) = self.items(from, vec![BACKFILL + 1]).next() {
            let (Some(run), Some(first)) = (number(&k[1..]), number(&k[5..])) else { break };
            let behind =
                run.checked_add(1).map_or(vec![BACKFILL + 1], |r| key(BACKFILL, &[&r.to_be_bytes()]));
            let last = self.db.range(k..behind.clone()).next_back().and_then(Result::ok);
            let last = last.and_then(|(k, _)| number(&k[5..]));
            runs.push((run, first, last.map_or(first, |n| n.saturating_add(1))));
            from = behind;
        }
        runs
    }

    /// A station's cursor in a run.
    pub fn cursor(&self, station: &str, run: u32) -> Option<u32> {
        let value = self.db.get(key(CURSOR, &[&run.to_be_bytes(), station.as_bytes()])).ok()??;
        number(&value)
    }

    /// All cursors of a run.
    pub fn cursors(&self, run: u32) -> Vec<(String, u32)> {
        let prefix = key(CURSOR, &[&run.to_be_bytes()]);
        let items = self.db.scan_prefix(prefix).map_while(Result::ok);
        items.filter_map(|(k, v)| Some((String::from_utf8(k[5..].to_vec()).ok()?, number(&v)?))).collect()
    }

    /// The last known state of a name.
    pub fn state(&self, name: &str) -> Option<Vec<u8>> {
        Some(self.db.get(key(STATE, &[name.as_bytes()])).ok()??.to_vec())
    }

    /// All segments in the index: (run, number) and entry.
    pub fn segments(&self) -> Vec<((u32, u32), SegmentEntry)> {
        let items = self.items(vec![SEGMENT], vec![SEGMENT + 1]);
        let parsed = items.filter_map(|(k, v)| {
            Some(((number(&k[1..])?, number(&k[5..])?), serde_json::from_slice(&v).ok()?))
        });
        parsed.collect()
    }

    /// Name of a run's flight.
    pub fn flight(&self, run: u32) -> Option<String> {
        let value = self.db.get(key(FLIGHT, &[&run.to_be_bytes()])).ok()??;
        String::from_utf8(value.to_vec()).ok()
    }

    /// All flights in the index.
    pub fn flights(&self) -> Vec<(u32, String)> {
        let items = self.items(vec![FLIGHT], vec![FLIGHT + 1]);
        items.filter_map(|(k, v)| Some((number(&k[1..])?, String::from_utf8(v).ok()?))).collect()
    }
}

/// Removes the file that sled leaves when it was opened on a full disk.
fn remove_half_snapshots(dir: &Path) {
    for entry in std::fs::read_dir(dir).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with("snap.") && name.ends_with(".generating") {
            // Where this fails the open fails too, and reports it.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// Moves an unusable index aside, and deletes the one that was moved before; returns its new place.
pub fn move_aside(dir: &Path) -> std::io::Result<PathBuf> {
    let aside = dir.with_extension("damaged");
    if aside.exists() {
        std::fs::remove_dir_all(&aside)?;
    }
    std::fs::rename(dir, &aside)?;
    Ok(aside)
}

#[cfg(test)]
mod tests {
    use rand::{Rng as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Reading a damaged index ends: sled repeats its errors without end.
    #[test]
    fn a_damaged_index_is_read_to_an_end() {
        let dir = tempfile::tempdir().expect("a folder");
        let whole = dir.path().join("whole");
        {
            let index = Index::open(&whole).expect("a new one");
            let entry = SegmentEntry { bytes: 1, messages: 2, span_ns: (3, 4) };
            let changes = (0..400).flat_map(|run| {
                [Change::Flight(run, format!("boot-{run}")), Change::Segment(run, 0, entry.clone())]
            });
            index.apply(&changes.collect::<Vec<_>>()).expect("durable");
        }
        let mut dice = ChaCha8Rng::seed_from_u64(7);
        for round in 0..12 {
            let copy = dir.path().join(format!("{round}"));
            std::fs::create_dir(&copy).expect("made");
            for file in whole.read_dir().expect("listed").flatten().filter(|file| file.path().is_file()) {
                let mut bytes = std::fs::read(file.path()).expect("read");
                let used = bytes.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
                for _ in 0..if file.file_name() == "conf" { 0 } else { used / 200 * round / 4 } {
                    bytes[dice.random_range(0..used)] = dice.random();
                }
                std::fs::write(copy.join(file.file_name()), bytes).expect("written");
            }
            match Index::open(&copy) {
                Ok(index) => {
                    let counts = (index.flights().len(), index.segments().len());
                    assert!(
                        counts.0 <= 400 && counts.1 <= 400 && (round > 0 || counts == (400, 400)),
                        "{counts:?}"
                    );
                }
                Err(IndexError::Unusable { .. }) => assert!(round > 0, "it was complete"),
                Err(other) => panic!("{other}"),
            }
        }
    }
}
