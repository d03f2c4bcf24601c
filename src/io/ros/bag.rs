//! A bag in the form of rosbag2: one MCAP file of profile `ros2`, and `metadata.yaml` beside it.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions};

use super::{RosRecord, RosType};
use crate::io::mcap_write::WriteError;
use crate::io::new_file::NewFile;
use windhover_base::time::MonoTime;

const DATA: &str = "flight_0.mcap";
const METADATA: &str = "metadata.yaml";
/// The generator, in both files.
const LIBRARY: &str = concat!("windhover ", env!("CARGO_PKG_VERSION"), " rosbag2");
const METADATA_MARK: &str = "# made by windhover";

/// The files of a bag, each with the text that identifies it near its start.
pub const FILES: [(&str, &str); 2] = [(DATA, "rosbag2"), (METADATA, METADATA_MARK)];

/// The quality of service of constant messages: kept for late subscribers. The times are ROS's value for "not limited".
const LATCHED: &str = "\
- history: keep_last
  depth: 1
  reliability: reliable
  durability: transient_local
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
";

/// A topic of the bag.
struct Topic {
    channel: u16,
    kind: RosType,
    qos: &'static str,
    messages: u32,
}

/// A bag being written; both files get their names when it is finished.
pub struct Bag {
    out: PathBuf,
    writer: mcap::Writer<BufWriter<NewFile>>,
    topics: BTreeMap<String, Topic>,
    span: Option<(MonoTime, MonoTime)>,
}

impl Bag {
    /// Creates a bag in the directory `out`.
    ///
    /// # Errors
    /// Its file cannot be created.
    pub fn create(out: &Path) -> Result<Self, WriteError> {
        let path = out.join(DATA);
        let file = NewFile::create(&path).map_err(|source| WriteError::Io { path, source })?;
        let options = WriteOptions::new()
            .profile("ros2")
            .library(LIBRARY)
            .compression(Some(Compression::Lz4))
            .compression_threads(0)
            .chunk_size(Some(1 << 20));
        let writer = options.create(BufWriter::with_capacity(1 << 16, file))?;
        Ok(Self { out: out.to_owned(), writer, topics: BTreeMap::new(), span: None })
    }

    /// Messages in it.
    pub fn messages(&self) -> u64 {
        self.topics.values().map(|topic| u64::from(topic.messages)).sum()
    }

    /// Writes a message.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&mut self, record: &RosRecord) -> Result<(), WriteError> {
        let topic = match self.topics.get_mut(&record.topic) {
            Some(topic) => topic,
            None => {
                let topic = add_topic(&mut self.writer, record)?;
                self.topics.entry(record.topic.clone()).or_insert(topic)
            }
        };
        let unsigned = |t: MonoTime| u64::try_from(t.ns()).unwrap_or(0);
        let header = MessageHeader {
            channel_id: topic.channel,
            sequence: topic.messages,
            log_time: unsigned(record.log_time),
            publish_time: unsigned(record.publish_time),
        };
        topic.messages += 1;
        let (first, last) = self.span.unwrap_or((record.log_time, record.log_time));
        self.span = Some((first.min(record.log_time), last.max(record.log_time)));
        Ok(self.writer.write_to_known_channel(&header, &record.data)?)
    }

    /// Ends the bag; returns its files.
    ///
    /// # Errors
    /// The rest cannot be written.
    pub fn finish(mut self) -> Result<Vec<PathBuf>, WriteError> {
        let metadata = self.metadata();
        let (data, description) = (self.out.join(DATA), self.out.join(METADATA));
        self.writer.finish()?;
        let failed = |path: &Path, source| WriteError::Io { path: path.to_owned(), source };
        let file =
            self.writer.into_inner().into_inner().map_err(|error| failed(&data, error.into_error()))?;
        file.finish().map_err(|source| failed(&data, source))?;
        NewFile::write(&description, metadata.as_bytes()).map_err(|source| failed(&description, source))?;
        Ok(vec![data, description])
    }

    /// `metadata.yaml`, version 9 (`rosbag2_storage`, Jazzy).
    fn metadata(&self) -> String {
        let (first, last) = self.span.unwrap_or_default();
        let (start, duration, count) = (first.ns(), (last - first).ns(), self.messages());
        let mut yaml = format!(
            "{METADATA_MARK}\nrosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  \
             duration:\n    nanoseconds: {duration}\n  starting_time:\n    nanoseconds_since_epoch: {start}\n  \
             message_count: {count}\n  topics_with_message_count:\n"
        );
        for (name, topic) in &self.topics {
            let qos = match topic.qos {
                "" => " []".to_owned(),
                some => some.lines().fold(String::new(), |all, line| all + "\n          " + line),
            };
            // Writing into a String cannot fail.
            let _ = write!(
                yaml,
                "    - topic_metadata:\n        name: {name}\n        type: {}\n        \
                 serialization_format: cdr\n        offered_qos_profiles:{qos}\n        \
                 type_description_hash: {}\n      message_count: {}\n",
                topic.kind.name(),
                topic.kind.hash(),
                topic.messages
            );
        }
        yaml + &format!(
            "  compression_format: \"\"\n  compression_mode: \"\"\n  relative_file_paths:\n    - {DATA}\n  \
             files:\n    - path: {DATA}\n      starting_time:\n        nanoseconds_since_epoch: {start}\n      \
             duration:\n        nanoseconds: {duration}\n      message_count: {count}\n  \
             custom_data: ~\n  ros_distro: jazzy\n"
        )
    }
}

fn add_topic(writer: &mut mcap::Writer<BufWriter<NewFile>>, record: &RosRecord) -> Result<Topic, WriteError> {
    let kind = record.kind;
    let schema = writer.add_schema(kind.name(), "ros2msg", kind.definition().as_bytes())?;
    let qos = if record.is_latched() { LATCHED } else { "" };
    let metadata = BTreeMap::from([
        ("offered_qos_profiles".to_owned(), qos.to_owned()),
        ("topic_type_hash".to_owned(), kind.hash().to_owned()),
    ]);
    let channel = writer.add_channel(schema, &record.topic, "cdr", &metadata)?;
    Ok(Topic { channel, kind, qos, messages: 0 })
}
