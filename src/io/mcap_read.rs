//! Reading MCAP files as they come back from the field: cut off, holed, or whole.
//!
//! The reader walks the file's records itself, so that damage costs only the record it hit: a chunk
//! that fails its checksum is skipped, a cut file ends at its last whole record, and each is told as
//! a warning.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::{Record as McapRecord, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::time::MonoTime;

/// Why a recording could not be read at all.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The system refused.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Something else than an MCAP file.
    #[error("{} is not an MCAP recording (its first bytes are not those of one)", path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
    },
    /// A directory without segments.
    #[error("{} holds no .mcap segment", path.display())]
    Empty {
        /// The directory.
        path: PathBuf,
    },
}

/// A channel of a recording: topic and schema.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct ChannelInfo {
    /// Topic.
    pub topic: String,
    /// Encoding of its messages.
    pub message_encoding: String,
    /// Name of its schema; empty where it has none.
    pub schema_name: String,
    /// Encoding of its schema.
    pub schema_encoding: String,
    /// The schema.
    pub schema_data: Vec<u8>,
    /// What else its writer said of it.
    pub metadata: BTreeMap<String, String>,
}

/// A message of a recording.
#[derive(Clone, PartialEq, Debug)]
pub struct RawMessage {
    /// Its channel.
    pub channel: Arc<ChannelInfo>,
    /// When it was recorded, host time.
    pub log_time: MonoTime,
    /// When it was true or sent, host time.
    pub publish_time: MonoTime,
    /// Its sequence number, as its writer understood it.
    pub sequence: u32,
    /// The bytes.
    pub data: Vec<u8>,
}

/// Files of a recording: itself, or the segments of a flight's directory in order.
pub fn segments_of(path: &Path) -> Result<Vec<PathBuf>, ReadError> {
    let io = |source| ReadError::Io { path: path.to_owned(), source };
    if !path.metadata().map_err(io)?.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let mut files = Vec::new();
    for entry in path.read_dir().map_err(io)? {
        let file = entry.map_err(io)?.path();
        if file.extension().is_some_and(|e| e == "mcap") {
            files.push(file);
        }
    }
    files.sort();
    if files.is_empty() {
        return Err(ReadError::Empty { path: path.to_owned() });
    }
    Ok(files)
}

/// Messages of a recording in file order.
pub struct McapReader {
    files: VecDeque<PathBuf>,
    current: Option<OpenFile>,
    ready: VecDeque<RawMessage>,
    warnings: Vec<String>,
    bytes_total: u64,
    bytes_done: u64,
}

struct OpenFile {
    path: PathBuf,
    input: BufReader<File>,
    position: u64,
    length: u64,
    schemas: HashMap<u16, (String, String, Vec<u8>)>,
    channels: HashMap<u16, Arc<ChannelInfo>>,
}

/// One record's frame: operation code and length of its body.
struct Frame {
    op: u8,
    length: u64,
}

const MAGIC_LENGTH: u64 = 8;
const FRAME_LENGTH: u64 = 9;

impl McapReader {
    /// Opens a file, or a directory of segments.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let files = segments_of(path)?;
        let bytes_total = files.iter().filter_map(|f| f.metadata().ok()).map(|m| m.len()).sum();
        let mut reader = Self {
            files: files.into(),
            current: None,
            ready: VecDeque::new(),
            warnings: Vec::new(),
            bytes_total,
            bytes_done: 0,
        };
        // The first file must be one, so that a wrong path is an error and not an empty recording.
        let first = reader.files.pop_front().ok_or_else(|| ReadError::Empty { path: path.to_owned() })?;
        reader.current = Some(OpenFile::open(first)?);
        Ok(reader)
    }

    /// What was damaged, so far. Taken: the next call tells only what is new.
    pub fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }

    /// Bytes read and bytes in all, for progress.
    pub fn progress(&self) -> (u64, u64) {
        (self.bytes_done + self.current.as_ref().map_or(0, |f| f.position), self.bytes_total)
    }

    fn next_file(&mut self) -> bool {
        while let Some(path) = self.files.pop_front() {
            match OpenFile::open(path) {
                Ok(file) => {
                    self.current = Some(file);
                    return true;
                }
                Err(error) => self.warnings.push(error.to_string()),
            }
        }
        false
    }
}

impl Iterator for McapReader {
    type Item = RawMessage;

    fn next(&mut self) -> Option<RawMessage> {
        loop {
            if let Some(message) = self.ready.pop_front() {
                return Some(message);
            }
            let Some(file) = &mut self.current else {
                if self.next_file() {
                    continue;
                }
                return None;
            };
            if !file.read_record(&mut self.ready, &mut self.warnings) {
                self.bytes_done += file.length;
                self.current = None;
            }
        }
    }
}

impl OpenFile {
    fn open(path: PathBuf) -> Result<Self, ReadError> {
        let io = |source| ReadError::Io { path: path.clone(), source };
        let file = File::open(&path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut input = BufReader::with_capacity(1 << 16, file);
        let mut magic = [0; MAGIC_LENGTH as usize];
        if input.read_exact(&mut magic).is_err() || magic != *mcap::MAGIC {
            return Err(ReadError::NotMcap { path });
        }
        Ok(Self {
            path,
            input,
            position: MAGIC_LENGTH,
            length,
            schemas: HashMap::new(),
            channels: HashMap::new(),
        })
    }

    /// The next record's frame; `None` at the end, told as a warning where the file is cut.
    fn read_frame(&mut self, warnings: &mut Vec<String>) -> Option<Frame> {
        let left = self.length - self.position;
        let mut head = [0; FRAME_LENGTH as usize];
        if left < FRAME_LENGTH || self.input.read_exact(&mut head).is_err() {
            warnings.push(self.cut());
            return None;
        }
        self.position += FRAME_LENGTH;
        let mut length = [0; 8];
        length.copy_from_slice(&head[1..]);
        let frame = Frame { op: head[0], length: u64::from_le_bytes(length) };
        if frame.length > self.length - self.position {
            warnings.push(self.cut());
            return None;
        }
        Some(frame)
    }

    fn cut(&self) -> String {
        format!("{} is cut off at byte {}: read to its last whole record", self.path.display(), self.position)
    }

    fn damaged(&self, what: &str, error: &dyn std::fmt::Display) -> String {
        format!(
            "{}: {what} before byte {} is damaged and skipped: {error}",
            self.path.display(),
            self.position
        )
    }

    /// Reads one record; false at the end of what can be read.
    fn read_record(&mut self, ready: &mut VecDeque<RawMessage>, warnings: &mut Vec<String>) -> bool {
        let Some(frame) = self.read_frame(warnings) else { return false };
        if frame.op == op::DATA_END || frame.op == op::FOOTER {
            return false;
        }
        let wanted = matches!(frame.op, op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK);
        if !wanted {
            self.position += frame.length;
            return self.input.seek_relative(frame.length as i64).is_ok();
        }
        let mut body = vec![0; frame.length as usize];
        if let Err(error) = self.input.read_exact(&mut body) {
            warnings.push(self.damaged("a record", &error));
            return false;
        }
        self.position += frame.length;
        if frame.op == op::CHUNK {
            match unpack_chunk(&body) {
                Ok(records) => records.into_iter().for_each(|record| self.take(record, ready)),
                Err(error) => warnings.push(self.damaged("a chunk", &error)),
            }
        } else {
            match mcap::parse_record(frame.op, &body) {
                Ok(record) => self.take(record, ready),
                Err(error) => warnings.push(self.damaged("a record", &error)),
            }
        }
        true
    }

    fn take(&mut self, record: McapRecord<'_>, ready: &mut VecDeque<RawMessage>) {
        match record {
            McapRecord::Schema { header, data } => {
                self.schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
            }
            McapRecord::Channel(channel) => {
                let (schema_name, schema_encoding, schema_data) =
                    self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let info = ChannelInfo {
                    topic: channel.topic,
                    message_encoding: channel.message_encoding,
                    schema_name,
                    schema_encoding,
                    schema_data,
                    metadata: channel.metadata,
                };
                self.channels.insert(channel.id, Arc::new(info));
            }
            McapRecord::Message { header, data } => {
                if let Some(channel) = self.channels.get(&header.channel_id) {
                    ready.push_back(RawMessage {
                        channel: Arc::clone(channel),
                        log_time: host_time(header.log_time),
                        publish_time: host_time(header.publish_time),
                        sequence: header.sequence,
                        data: data.into_owned(),
                    });
                }
            }
            _ => {}
        }
    }
}

/// Largest chunk unpacked: beyond it a size is damage, not data.
const CHUNK_LIMIT: usize = 1 << 28;

/// Unpacks the body of a chunk record whole, its checksum verified before anything of it is used.
fn unpack_chunk(body: &[u8]) -> Result<Vec<McapRecord<'static>>, mcap::McapError> {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(CHUNK_LIMIT);
    let mut reader = LinearReader::new_with_options(options);
    let mut frame = vec![op::CHUNK];
    frame.extend_from_slice(&(body.len() as u64).to_le_bytes());
    let mut left = frame.as_slice().chain(body);
    let mut records = Vec::new();
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(need) => {
                let read = left.read(reader.insert(need.min(CHUNK_LIMIT)))?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { opcode, data } => {
                if matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
                    records.push(mcap::parse_record(opcode, data)?.into_owned());
                }
            }
        }
    }
    Ok(records)
}

/// MCAP times are unsigned; what does not fit is the end of time.
fn host_time(ns: u64) -> MonoTime {
    MonoTime::from_ns(i64::try_from(ns).unwrap_or(i64::MAX))
}

/// The first attachment of that name in a recording, wherever in the file it stands.
pub fn attachment(path: &Path, name: &str) -> Result<Option<Vec<u8>>, ReadError> {
    for segment in segments_of(path)? {
        let mut file = match OpenFile::open(segment) {
            Ok(file) => file,
            Err(ReadError::NotMcap { .. }) if path.is_dir() => continue,
            Err(error) => return Err(error),
        };
        if let Some(found) = file.find_attachment(name) {
            return Ok(Some(found));
        }
    }
    Ok(None)
}

impl OpenFile {
    fn find_attachment(&mut self, name: &str) -> Option<Vec<u8>> {
        let mut ignored = Vec::new();
        while let Some(frame) = self.read_frame(&mut ignored) {
            if frame.op == op::FOOTER {
                return None;
            }
            if frame.op == op::ATTACHMENT {
                let mut body = vec![0; frame.length as usize];
                self.input.read_exact(&mut body).ok()?;
                if let Some(data) = attachment_named(&body, name) {
                    return Some(data.to_vec());
                }
            } else {
                self.input.seek(SeekFrom::Current(i64::try_from(frame.length).ok()?)).ok()?;
            }
            self.position += frame.length;
        }
        None
    }
}

/// The data of an attachment record if it has that name: log time, create time, name, media type,
/// data, checksum; strings behind 4-byte lengths, data behind 8 bytes (MCAP specification).
fn attachment_named<'a>(body: &'a [u8], name: &str) -> Option<&'a [u8]> {
    let (found, rest) = sized_u32(body.get(16..)?)?;
    let (_media_type, rest) = sized_u32(rest)?;
    let length = usize::try_from(u64::from_le_bytes(rest.get(..8)?.try_into().ok()?)).ok()?;
    let data = rest.get(8..8usize.checked_add(length)?)?;
    (found == name.as_bytes()).then_some(data)
}

fn sized_u32(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let length = u32::from_le_bytes(bytes.get(..4)?.try_into().ok()?) as usize;
    let rest = bytes.get(4..)?;
    Some((rest.get(..length)?, rest.get(length..)?))
}
