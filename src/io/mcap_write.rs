//! Writing MCAP files: channels and schemas are registered at their first use, one chunk a second.

use std::collections::{BTreeMap, HashMap};
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::MessageHeader;
use mcap::{Attachment, Compression, WriteOptions};

use super::mcap_definitions::{ChannelInfo, SchemaInfo};
use super::new_file::NewFile;
use super::records::Record;
use windhover_base::time::{MonoTime, Span};

/// Name of the configuration's attachment.
pub const CONFIG_ATTACHMENT: &str = "config.toml";

/// Channel metadata key for the origin of messages that are not what a device sent.
pub const MADE_OF_KEY: &str = "windhover.made_of";

/// Why a recording could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The system's refusal.
    #[error("cannot write {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The MCAP writer refused.
    #[error("cannot write the recording: {0}")]
    Mcap(#[from] mcap::McapError),
}

/// The kinds of commands that make recordings.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Maker {
    /// One that makes captures: `simulate`, `import`.
    Capture,
    /// `replay`.
    Replay,
    /// `refine`.
    Refine,
}

impl Maker {
    const fn library(self) -> &'static str {
        match self {
            Self::Capture => concat!("windhover ", env!("CARGO_PKG_VERSION"), " capture"),
            Self::Replay => concat!("windhover ", env!("CARGO_PKG_VERSION"), " replay"),
            Self::Refine => concat!("windhover ", env!("CARGO_PKG_VERSION"), " refine"),
        }
    }

    /// The marks near the start of a file that it made, in any version.
    pub const fn marks(self) -> [&'static str; 2] {
        match self {
            Self::Capture => ["windhover ", " capture"],
            Self::Replay => ["windhover ", " replay"],
            Self::Refine => ["windhover ", " refine"],
        }
    }
}

/// Writes one MCAP file of [`Record`]s.
pub struct McapWriter<W: Write + Seek> {
    writer: mcap::Writer<W>,
    channels: HashMap<(String, String), u16>,
    sequence: u32,
    chunk_began: Option<MonoTime>,
    made_of: HashMap<String, String>,
}

/// A recording being written, which gets its name when it is complete.
pub type McapFile = McapWriter<BufWriter<NewFile>>;

impl McapFile {
    /// Creates a file with its configuration attached.
    pub fn create(path: &Path, maker: Maker, config_toml: &str, began: MonoTime) -> Result<Self, WriteError> {
        let failed = |source| WriteError::Io { path: path.to_owned(), source };
        let file = NewFile::create(path).map_err(failed)?;
        Self::new(BufWriter::with_capacity(1 << 16, file), maker, config_toml, began)
    }

    /// Ends the recording and gives it its name, which errors contain.
    pub fn close(self, path: &Path) -> Result<(), WriteError> {
        let failed = |source| WriteError::Io { path: path.to_owned(), source };
        let file = self.finish()?.into_inner().map_err(|error| failed(error.into_error()))?;
        file.finish().map_err(failed)
    }
}

impl<W: Write + Seek> McapWriter<W> {
    /// Starts a recording on any seekable output. `config_toml` becomes the attachment [`CONFIG_ATTACHMENT`] unless it
    /// is empty; versions go into the metadata record `windhover`.
    pub fn new(output: W, maker: Maker, config_toml: &str, began: MonoTime) -> Result<Self, WriteError> {
        let options = WriteOptions::new()
            .compression(Some(Compression::Lz4))
            .compression_threads(0)
            .chunk_size(None)
            .library(maker.library());
        let mut writer = options.create(output)?;
        let t = unsigned(began);
        if !config_toml.is_empty() {
            writer.attach(&Attachment {
                log_time: t,
                create_time: t,
                name: CONFIG_ATTACHMENT.into(),
                media_type: "application/toml".into(),
                data: config_toml.as_bytes().into(),
            })?;
        }
        let mut versions = BTreeMap::new();
        versions.insert("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned());
        versions.insert("magnetic_model".to_owned(), "WMM2025".to_owned());
        writer.write_metadata(&mcap::records::Metadata { name: "windhover".into(), metadata: versions })?;
        Ok(Self { writer, channels: HashMap::new(), sequence: 0, chunk_began: None, made_of: HashMap::new() })
    }

    /// States in a topic's channel the origin of its messages, where they are not what a device sent. To be called
    /// before the first of them.
    pub fn made_of(&mut self, topic: &str, text: &str) {
        self.made_of.insert(topic.to_owned(), text.to_owned());
    }

    /// Writes a record; closes the chunk when its log time is a second past the chunk's first.
    pub fn write(&mut self, record: &Record) -> Result<(), WriteError> {
        let key = (record.topic.as_ref(), record.schema.name());
        let made_of =
            self.made_of.get(record.topic.as_ref()).map(|text| (MADE_OF_KEY.to_owned(), text.clone()));
        let channel = self.channel(key, || ChannelInfo {
            topic: record.topic.to_string(),
            message_encoding: "protobuf".into(),
            schema: Arc::new(SchemaInfo {
                name: record.schema.name().into(),
                encoding: "protobuf".into(),
                data: record.schema.descriptor(),
            }),
            metadata: made_of.into_iter().collect(),
        })?;
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        let header = header(channel, sequence, record.log_time, record.publish_time);
        self.write_message(&header, record.log_time, &record.data)
    }

    /// Writes a message of another recording unchanged, with its sequence number and its channel's metadata.
    pub fn copy(&mut self, message: &super::mcap_read::RawMessage) -> Result<(), WriteError> {
        let key = (message.channel.topic.as_str(), message.channel.schema.name.as_str());
        let channel = self.channel(key, || (*message.channel).clone())?;
        let header = header(channel, message.sequence, message.log_time, message.publish_time);
        self.write_message(&header, message.log_time, &message.data)
    }

    fn channel(&mut self, key: (&str, &str), info: impl FnOnce() -> ChannelInfo) -> Result<u16, WriteError> {
        let owned = (key.0.to_owned(), key.1.to_owned());
        if let Some(id) = self.channels.get(&owned) {
            return Ok(*id);
        }
        let info = info();
        let schema = if info.schema.name.is_empty() {
            0
        } else {
            self.writer.add_schema(&info.schema.name, &info.schema.encoding, &info.schema.data)?
        };
        let id = self.writer.add_channel(schema, &info.topic, &info.message_encoding, &info.metadata)?;
        self.channels.insert(owned, id);
        Ok(id)
    }

    fn write_message(
        &mut self,
        header: &MessageHeader,
        log_time: MonoTime,
        data: &[u8],
    ) -> Result<(), WriteError> {
        let began = *self.chunk_began.get_or_insert(log_time);
        if (log_time - began).abs() >= Span::from_s(1.0) {
            self.flush()?;
            self.chunk_began = Some(log_time);
        }
        Ok(self.writer.write_to_known_channel(header, data)?)
    }

    /// Ends the chunk and passes everything to the output.
    pub fn flush(&mut self) -> Result<(), WriteError> {
        Ok(self.writer.flush()?)
    }

    /// Ends the recording: index, statistics, closing magic; returns the output.
    pub fn finish(mut self) -> Result<W, WriteError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner())
    }
}

fn header(channel_id: u16, sequence: u32, log_time: MonoTime, publish_time: MonoTime) -> MessageHeader {
    MessageHeader { channel_id, sequence, log_time: unsigned(log_time), publish_time: unsigned(publish_time) }
}

/// MCAP times are unsigned; negative times become zero.
fn unsigned(t: MonoTime) -> u64 {
    u64::try_from(t.ns()).unwrap_or(0)
}
