//! What a station received, on its disk: the payload's flights as MCAP segments, each record once.
//!
//! A flight is the directory `PAYLOAD/FLIGHT/` with segments `000000.mcap`, …; a record's number in its run
//! is the MCAP message's sequence, so that a restarted station knows from the files alone what it has.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions};
use prost::Message as _;

use crate::io::link::{Arrival, Channel, RangeSet};
use crate::io::mcap_read::{McapReader, RawMessage};
use crate::io::proto::{schema_of_package, windhover as wh};
use crate::io::store::flight::is_flight_name;
use windhover_base::time::MonoTime;

/// File in a flight's directory that tells which run it is of.
pub(super) const RUN_FILE: &str = "run";
/// The word of health messages that names the flight on the payload's card.
const FLIGHT_WORD: &str = "flight";
/// How the name of a flight without a date begins.
const UNDATED: &str = "boot-";
/// A segment ends at this many bytes of messages.
const SEGMENT_BYTES: u64 = 64 << 20;

/// Why something could not be kept.
#[derive(Debug, thiserror::Error)]
pub enum MirrorError {
    /// The system refused.
    #[error("cannot write {}: {source}", path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The MCAP writer refused.
    #[error("cannot write {}: {source}", path.display())]
    Mcap {
        /// The file.
        path: PathBuf,
        /// What it said.
        source: mcap::McapError,
    },
}

/// Numbers of a payload's run that are on disk now.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct OnDisk {
    /// Name of the payload.
    pub payload: String,
    /// The run.
    pub run: u32,
    /// The numbers.
    pub numbers: RangeSet,
}

struct Segment {
    path: PathBuf,
    writer: mcap::Writer<BufWriter<File>>,
    channels: HashMap<(String, String), u16>,
    bytes: u64,
    unsynced: RangeSet,
}

/// Writes what arrives under one directory.
pub struct Mirror {
    root: PathBuf,
    open: BTreeMap<(String, u32), Segment>,
}

fn io_error(path: &Path) -> impl FnOnce(std::io::Error) -> MirrorError + '_ {
    move |source| MirrorError::Io { path: path.to_owned(), source }
}

impl Mirror {
    /// Under `root`, which is made when needed.
    pub fn at(root: impl Into<PathBuf>) -> Result<Self, MirrorError> {
        let root = root.into();
        std::fs::create_dir_all(&root).map_err(io_error(&root))?;
        Ok(Self { root, open: BTreeMap::new() })
    }

    /// Keeps a record; it is on disk after the next [`Mirror::sync`].
    pub fn keep(&mut self, arrival: &Arrival) -> Result<(), MirrorError> {
        let key = (arrival.payload.to_string(), arrival.run);
        if !self.open.contains_key(&key) {
            let dir = flight_dir(&self.root, &arrival.payload, &arrival.flight, arrival.run);
            self.open.insert(key.clone(), Segment::create(&dir, arrival.run)?);
        }
        let segment = self.open.get_mut(&key).expect("inserted above when it was not there");
        if arrival.channel.schema_name == "windhover.Health"
            && let Some(name) = dated_name(&arrival.data)
        {
            segment.rename_flight(&name)?;
        }
        segment.write(arrival)
    }

    /// Brings everything to the disk, ends segments that are long enough, and tells what is new on disk.
    pub fn sync(&mut self) -> Result<Vec<OnDisk>, MirrorError> {
        let mut done = Vec::new();
        for ((payload, run), segment) in &mut self.open {
            if segment.unsynced.is_empty() {
                continue;
            }
            segment.sync()?;
            let numbers = std::mem::take(&mut segment.unsynced);
            done.push(OnDisk { payload: payload.clone(), run: *run, numbers });
        }
        let full: Vec<_> =
            self.open.iter().filter(|(_, s)| s.bytes >= SEGMENT_BYTES).map(|(k, _)| k.clone()).collect();
        for key in full {
            if let Some(segment) = self.open.remove(&key) {
                segment.finish()?;
            }
        }
        Ok(done)
    }

    /// Ends every segment.
    pub fn finish(mut self) -> Result<Vec<OnDisk>, MirrorError> {
        let done = self.sync()?;
        for segment in std::mem::take(&mut self.open).into_values() {
            segment.finish()?;
        }
        Ok(done)
    }
}

/// The name that the payload gave its flight since it knows the date, as its health tells it.
fn dated_name(health: &[u8]) -> Option<String> {
    let health = wh::Health::decode(health).ok()?;
    let name = health.words.get(FLIGHT_WORD)?;
    // A name of somebody else's making becomes a directory here: only a flight's is one.
    (is_flight_name(name) && !name.starts_with(UNDATED)).then(|| name.clone())
}

impl Segment {
    /// A flight that began without a date gets its name as it has on the card; one that has a date keeps it.
    fn rename_flight(&mut self, name: &str) -> Result<(), MirrorError> {
        let (Some(dir), Some(file)) = (self.path.parent().map(Path::to_owned), self.path.file_name()) else {
            return Ok(());
        };
        let undated =
            dir.file_name().is_some_and(|dir| dir.as_encoded_bytes().starts_with(UNDATED.as_bytes()));
        let Some(payload) = dir.parent().filter(|_| undated) else { return Ok(()) };
        let names = std::iter::once(name.to_owned()).chain((2..).map(|n| format!("{name}-{n}")));
        let mut free = names.map(|name| payload.join(name)).filter(|dir| !dir.exists());
        let dated = free.next().expect("some number is free");
        std::fs::rename(&dir, &dated).map_err(io_error(&dir))?;
        File::open(payload).and_then(|d| d.sync_all()).map_err(io_error(payload))?;
        self.path = dated.join(file);
        Ok(())
    }

    fn create(dir: &Path, run: u32) -> Result<Self, MirrorError> {
        std::fs::create_dir_all(dir).map_err(io_error(dir))?;
        let run_file = dir.join(RUN_FILE);
        std::fs::write(&run_file, format!("{run:08x}\n")).map_err(io_error(&run_file))?;
        let next = segments(dir).iter().filter_map(|p| p.file_stem()?.to_str()?.parse::<u32>().ok()).max();
        let path = dir.join(format!("{:06}.mcap", next.map_or(0, |last| last + 1)));
        let file = File::create_new(&path).map_err(io_error(&path))?;
        // The names must be as durable as what is in the file.
        for durable in [dir, dir.parent().unwrap_or(dir)] {
            File::open(durable).and_then(|d| d.sync_all()).map_err(io_error(durable))?;
        }
        let failed = |source| MirrorError::Mcap { path: path.clone(), source };
        let mut writer = WriteOptions::new()
            .compression(Some(Compression::Lz4))
            .compression_threads(0)
            .chunk_size(None)
            .library(concat!("windhover ", env!("CARGO_PKG_VERSION")))
            .create(BufWriter::new(file))
            .map_err(failed)?;
        let metadata = BTreeMap::from([("run".to_owned(), format!("{run:08x}"))]);
        let link = mcap::records::Metadata { name: "windhover.link".into(), metadata };
        writer.write_metadata(&link).map_err(failed)?;
        Ok(Self { path, writer, channels: HashMap::new(), bytes: 0, unsynced: RangeSet::new() })
    }

    fn write(&mut self, arrival: &Arrival) -> Result<(), MirrorError> {
        let channel_id = self.channel(&arrival.channel)?;
        let header = MessageHeader {
            channel_id,
            sequence: arrival.number,
            log_time: unsigned(arrival.log_time),
            publish_time: unsigned(arrival.publish_time),
        };
        let written = self.writer.write_to_known_channel(&header, &arrival.data);
        written.map_err(|source| MirrorError::Mcap { path: self.path.clone(), source })?;
        self.bytes += arrival.data.len() as u64 + 32;
        self.unsynced.insert(arrival.number);
        Ok(())
    }

    fn channel(&mut self, channel: &Channel) -> Result<u16, MirrorError> {
        let key = (channel.topic.clone(), channel.schema_name.clone());
        if let Some(id) = self.channels.get(&key) {
            return Ok(*id);
        }
        let failed = |source| MirrorError::Mcap { path: self.path.clone(), source };
        let schema = match (&channel.schema[..], channel.schema_name.split_once('.')) {
            ([], Some((package, _))) => schema_of_package(package),
            (schema, _) => schema.to_vec(),
        };
        let schema_id = self.writer.add_schema(&channel.schema_name, "protobuf", &schema).map_err(failed)?;
        let id = self
            .writer
            .add_channel(schema_id, &channel.topic, "protobuf", &BTreeMap::new())
            .map_err(|source| MirrorError::Mcap { path: self.path.clone(), source })?;
        self.channels.insert(key, id);
        Ok(id)
    }

    fn sync(&mut self) -> Result<(), MirrorError> {
        self.writer.flush().map_err(|source| MirrorError::Mcap { path: self.path.clone(), source })?;
        let file = File::options().append(true).open(&self.path).map_err(io_error(&self.path))?;
        file.sync_data().map_err(io_error(&self.path))
    }

    fn finish(mut self) -> Result<(), MirrorError> {
        let finished = self.writer.finish();
        finished.map_err(|source| MirrorError::Mcap { path: self.path.clone(), source })?;
        let file = File::options().append(true).open(&self.path).map_err(io_error(&self.path))?;
        file.sync_data().map_err(io_error(&self.path))
    }
}

fn unsigned(t: MonoTime) -> u64 {
    u64::try_from(t.ns()).unwrap_or(0)
}

pub(super) fn segments(dir: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let mut files: Vec<_> =
        entries.map(|entry| entry.path()).filter(|p| p.extension().is_some_and(|e| e == "mcap")).collect();
    files.sort();
    files
}

/// The directory of a run: the one that has it, whatever its name has become; else named after its flight, with -2, -3, …
/// where another run has that name already.
fn flight_dir(root: &Path, payload: &str, flight: &str, run: u32) -> PathBuf {
    let payload = root.join(payload);
    let entries = std::fs::read_dir(&payload).into_iter().flatten().flatten();
    let has_run = |dir: &PathBuf| {
        let text = std::fs::read_to_string(dir.join(RUN_FILE));
        text.is_ok_and(|text| text.trim() == format!("{run:08x}"))
    };
    if let Some(dir) = entries.map(|entry| entry.path()).find(has_run) {
        return dir;
    }
    let names = std::iter::once(flight.to_owned()).chain((2..).map(|n| format!("{flight}-{n}")));
    let of_run = |dir: &PathBuf| match std::fs::read_to_string(dir.join(RUN_FILE)) {
        Ok(text) => text.trim() == format!("{run:08x}"),
        Err(_) => !dir.exists() || segments(dir).is_empty(),
    };
    let mut dirs = names.map(|name| payload.join(name));
    dirs.find(of_run).expect("some number is free")
}

/// Messages of a flight's directory, as far as they are on the disk: of a segment that is being written, or was
/// cut off, every whole chunk.
pub(super) fn messages(dir: &Path) -> impl Iterator<Item = RawMessage> {
    McapReader::open(dir).into_iter().flatten()
}

/// Numbers of a run that the files of earlier lives hold.
pub fn recall(root: &Path, payload: &str, flight: &str, run: u32) -> RangeSet {
    let mut numbers = RangeSet::new();
    for message in messages(&flight_dir(root, payload, flight, run)) {
        numbers.insert(message.sequence);
    }
    numbers
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn a_flight_gets_the_date_that_it_has_on_the_card() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        mirror.keep(&arrival(7, 0)).expect("kept");
        // Names that are no flight's become no directory, whoever says them.
        for name in ["boot-1", "../../elsewhere", "20261118T150405Z"] {
            let words = [(FLIGHT_WORD.to_owned(), name.to_owned())].into();
            let data = wh::Health { words, ..Default::default() }.encode_to_vec();
            let channel = Channel {
                topic: "/health".into(),
                schema_name: "windhover.Health".into(),
                schema: Vec::new(),
            };
            let health = Arrival { channel: Arc::new(channel), data, ..arrival(7, 1) };
            mirror.keep(&health).expect("kept");
        }
        mirror.keep(&arrival(7, 2)).expect("kept");
        mirror.finish().expect("finished");
        let names: Vec<_> = std::fs::read_dir(dir.path().join("alpha"))
            .expect("a directory")
            .map(|entry| entry.expect("an entry").file_name())
            .collect();
        assert_eq!(names, ["20261118T150405Z"]);
        // The payload goes on calling it by the name it began with.
        assert_eq!(recall(dir.path(), "alpha", "boot-1", 7).len(), 3);
        let mut again = Mirror::at(dir.path()).expect("a mirror");
        again.keep(&arrival(7, 3)).expect("kept");
        again.finish().expect("finished");
        assert_eq!(segments(&dir.path().join("alpha/20261118T150405Z")).len(), 2);
    }

    fn arrival(run: u32, number: u32) -> Arrival {
        Arrival {
            payload: "alpha".into(),
            run,
            flight: "boot-1".into(),
            number,
            channel: Arc::new(Channel {
                topic: "/target/ugv/state".into(),
                schema_name: "windhover.TargetState".into(),
                schema: Vec::new(),
            }),
            log_time: MonoTime::from_ns(i64::from(number) * 1_000_000),
            publish_time: MonoTime::from_ns(i64::from(number) * 1_000_000),
            data: vec![8, 1],
            live: true,
            arrived: tokio::time::Instant::now(),
        }
    }

    #[test]
    fn what_was_synced_is_known_after_a_restart_even_without_an_end() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        for number in [0, 1, 2, 5] {
            mirror.keep(&arrival(7, number)).expect("kept");
        }
        let done = mirror.sync().expect("synced");
        assert_eq!(done[0].numbers.iter().collect::<Vec<_>>(), [(0, 3), (5, 6)]);
        mirror.keep(&arrival(7, 9)).expect("kept, never synced");
        // As after a kill: neither an end nor what was not synced.
        std::mem::forget(mirror);
        let known = recall(dir.path(), "alpha", "boot-1", 7);
        assert_eq!(known.iter().collect::<Vec<_>>(), [(0, 3), (5, 6)]);
        let mut again = Mirror::at(dir.path()).expect("a mirror");
        again.keep(&arrival(7, 3)).expect("kept");
        again.finish().expect("finished");
        assert_eq!(recall(dir.path(), "alpha", "boot-1", 7).len(), 5);
        assert_eq!(segments(&dir.path().join("alpha/boot-1")).len(), 2);
    }

    #[test]
    fn another_run_of_the_same_name_gets_a_directory_of_its_own() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut mirror = Mirror::at(dir.path()).expect("a mirror");
        mirror.keep(&arrival(1, 0)).expect("kept");
        mirror.keep(&arrival(2, 0)).expect("kept");
        mirror.finish().expect("finished");
        assert!(dir.path().join("alpha/boot-1-2/000000.mcap").exists());
        assert!(recall(dir.path(), "alpha", "boot-1", 3).is_empty());
        assert_eq!(recall(dir.path(), "alpha", "boot-1", 2).len(), 1);
    }
}
