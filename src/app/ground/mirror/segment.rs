//! One segment of a mirrored flight: an open MCAP file, and the numbers that it holds.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::BufWriter;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions};

use super::{MirrorError, RUN_FILE, UNDATED, io_error, segments};
use crate::io::link::{Arrival, Channel, RangeSet};
use crate::io::proto::schema_of_package;
use windhover_base::time::MonoTime;

/// Most channels of a segment, and most bytes of their schemas; a payload has some tens of channels.
const CHANNELS: usize = 2_048;
const SCHEMA_BYTES: usize = 16 << 20;

/// A file that is being written.
pub(super) struct Segment {
    path: PathBuf,
    writer: mcap::Writer<BufWriter<File>>,
    /// The same file, to sync it and to check whether it still exists.
    file: File,
    channels: HashMap<(String, String), u16>,
    schema_bytes: usize,
    pub(super) bytes: u64,
    /// When it was last written to, by the mirror's count of writes.
    pub(super) turn: u64,
    pub(super) unsynced: RangeSet,
    /// Numbers that are on the disk.
    synced: RangeSet,
}

impl Segment {
    /// A flight that began without a date gets the name that it has on the card; one that has a date keeps its name.
    pub(super) fn rename_flight(&mut self, name: &str) -> Result<(), MirrorError> {
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

    pub(super) fn create(dir: &Path, run: u32) -> Result<Self, MirrorError> {
        std::fs::create_dir_all(dir).map_err(io_error(dir))?;
        let run_file = dir.join(RUN_FILE);
        std::fs::write(&run_file, format!("{run:08x}\n")).map_err(io_error(&run_file))?;
        let next = segments(dir).iter().filter_map(|p| p.file_stem()?.to_str()?.parse::<u32>().ok()).max();
        let path = dir.join(format!("{:06}.mcap", next.map_or(0, |last| last + 1)));
        let file = File::create_new(&path).map_err(io_error(&path))?;
        // The names must be as durable as the content of the file.
        for durable in [dir, dir.parent().unwrap_or(dir)] {
            File::open(durable).and_then(|d| d.sync_all()).map_err(io_error(durable))?;
        }
        let failed = |source| MirrorError::Mcap { path: path.clone(), source };
        let handle = file.try_clone().map_err(io_error(&path))?;
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
        Ok(Self {
            path,
            writer,
            file: handle,
            channels: HashMap::new(),
            schema_bytes: 0,
            bytes: 0,
            turn: 0,
            unsynced: RangeSet::new(),
            synced: RangeSet::new(),
        })
    }

    pub(super) fn write(&mut self, arrival: &Arrival) -> Result<(), MirrorError> {
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
        self.schema_bytes += channel.schema.len();
        if self.channels.len() >= CHANNELS || self.schema_bytes > SCHEMA_BYTES {
            return Err(MirrorError::Overfull { path: self.path.clone() });
        }
        let schema_id = self.writer.add_schema(&channel.schema_name, "protobuf", &schema).map_err(failed)?;
        let id = self
            .writer
            .add_channel(schema_id, &channel.topic, "protobuf", &BTreeMap::new())
            .map_err(|source| MirrorError::Mcap { path: self.path.clone(), source })?;
        self.channels.insert(key, id);
        Ok(id)
    }

    /// Writes everything through to the disk.
    pub(super) fn sync(&mut self) -> Result<RangeSet, MirrorError> {
        self.writer.flush().map_err(|source| MirrorError::Mcap { path: self.path.clone(), source })?;
        self.settle()
    }

    /// Ends the file.
    pub(super) fn finish(mut self) -> Result<RangeSet, MirrorError> {
        let finished = self.writer.finish();
        finished.map_err(|source| MirrorError::Mcap { path: self.path.clone(), source })?;
        self.settle()
    }

    /// What was handed to the system is now on the disk, under the segment's name; returns what is new there.
    fn settle(&mut self) -> Result<RangeSet, MirrorError> {
        self.file.sync_data().map_err(io_error(&self.path))?;
        if !self.is_there() {
            return Err(MirrorError::Removed { path: self.path.clone() });
        }
        let numbers = std::mem::take(&mut self.unsynced);
        self.synced.union(&numbers);
        Ok(numbers)
    }

    /// Whether the file still has its name.
    fn is_there(&self) -> bool {
        let identity = |there: std::fs::Metadata| (there.dev(), there.ino());
        let named = self.path.symlink_metadata().map(identity);
        named.is_ok_and(|named| self.file.metadata().is_ok_and(|file| identity(file) == named))
    }

    /// Abandons a file that failed: returns the numbers that it does not hold, because they never reached the disk or
    /// the file is gone. A file that never held anything is removed.
    pub(super) fn give_up(self) -> RangeSet {
        let there = self.is_there();
        let mut lost = self.unsynced;
        if !there {
            lost.union(&self.synced);
        } else if self.synced.is_empty() {
            // Where it cannot be removed, it stays as an empty segment.
            let _ = std::fs::remove_file(&self.path);
        }
        lost
    }
}

fn unsigned(t: MonoTime) -> u64 {
    u64::try_from(t.ns()).unwrap_or(0)
}
