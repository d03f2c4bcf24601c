//! Reading MCAP files in any condition: cut off, with gaps, or complete.
//!
//! The reader walks the file's records itself, so that damage affects only the damaged record: a chunk that fails its
//! checksum is skipped, a cut file ends at its last whole record, and each case is a warning. A length is limited by
//! the rest of the file and by the limits of [`mcap_record`](super::mcap_record), and each definition of a file is kept
//! once and within a limit: a hostile file takes at most some hundreds of megabytes while it is read.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::{Record as McapRecord, op};

use super::mcap_definitions::{ChannelInfo, Definitions};
use super::mcap_record::{RECORD_HEAD, longest, parse, sized_u32, split, unpack_chunk};
use super::regular;
use super::segment_files::segment_files;
use windhover_base::time::MonoTime;

/// Longest attachment that is read: a configuration, not a video.
const MAX_ATTACHMENT: u64 = 1 << 24;

/// Why a recording could not be read at all.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The system's refusal.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not an MCAP file.
    #[error("{} is not an MCAP recording (its first bytes are not those of one)", path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
    },
    /// A directory without segments.
    #[error("{} has no .mcap segment", path.display())]
    Empty {
        /// The directory.
        path: PathBuf,
    },
}

/// A message of a recording.
#[derive(Clone, PartialEq, Debug)]
pub struct RawMessage {
    /// Its channel.
    pub channel: Arc<ChannelInfo>,
    /// Time of recording, host time.
    pub log_time: MonoTime,
    /// Time of validity or of sending, host time.
    pub publish_time: MonoTime,
    /// Its sequence number, in its writer's meaning.
    pub sequence: u32,
    /// The bytes.
    pub data: Vec<u8>,
}

/// Files of a recording: the file itself, or the segments of a flight's directory in order.
pub fn segments_of(path: &Path) -> Result<Vec<PathBuf>, ReadError> {
    let files = segment_files(path).map_err(|source| ReadError::Io { path: path.to_owned(), source })?;
    if files.is_empty() { Err(ReadError::Empty { path: path.to_owned() }) } else { Ok(files) }
}

/// Messages of a recording in file order.
pub struct McapReader {
    files: VecDeque<PathBuf>,
    current: Option<OpenFile>,
    warnings: Vec<String>,
    bytes_total: u64,
    bytes_done: u64,
}

struct OpenFile {
    path: PathBuf,
    input: BufReader<File>,
    position: u64,
    length: u64,
    definitions: Definitions,
    /// The chunk being read: its records, and the position in them.
    chunk: Option<(Vec<u8>, usize)>,
}

/// One record's frame: operation code and length of its body.
struct Frame {
    op: u8,
    length: u64,
}

/// Most warnings that are kept: a badly damaged file has more than anyone reads.
const MOST_WARNINGS: usize = 100;

/// 1 January 2200, Unix time: a message that is stamped later is damaged. One such stamp would have the pipeline wait for
/// centuries of silence.
const LATEST_NS: u64 = 7_258_118_400_000_000_000;

/// Adds a warning, or once a note that further ones are not listed.
pub(super) fn warn(warnings: &mut Vec<String>, text: String) {
    match warnings.len() {
        ..MOST_WARNINGS => warnings.push(text),
        MOST_WARNINGS => warnings.push("there is more damage than is listed here".into()),
        _ => {}
    }
}

/// The warning for a segment that is not one.
fn skipped(error: &ReadError) -> String {
    format!("{error}; it is skipped")
}

/// The result of reading a record.
enum Step {
    Message(RawMessage),
    Other,
    End,
}

const MAGIC_LENGTH: u64 = 8;

impl McapReader {
    /// Opens a file, or a directory of segments.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let files = segments_of(path)?;
        let bytes_total = files.iter().filter_map(|f| f.metadata().ok()).map(|m| m.len()).sum();
        let mut reader =
            Self { files: files.into(), current: None, warnings: Vec::new(), bytes_total, bytes_done: 0 };
        // A single file must be a recording, so that a wrong path is an error and not an empty recording.
        let mut first_error = None;
        while let Some(file) = reader.files.pop_front() {
            match OpenFile::open(file) {
                Ok(file) => {
                    reader.current = Some(file);
                    return Ok(reader);
                }
                Err(error) => {
                    warn(&mut reader.warnings, skipped(&error));
                    first_error.get_or_insert(error);
                }
            }
        }
        Err(first_error.unwrap_or_else(|| ReadError::Empty { path: path.to_owned() }))
    }

    /// New damage since the last call.
    pub fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }

    /// Bytes read so far and in total, for progress.
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
                Err(error) => warn(&mut self.warnings, skipped(&error)),
            }
        }
        false
    }
}

impl Iterator for McapReader {
    type Item = RawMessage;

    fn next(&mut self) -> Option<RawMessage> {
        loop {
            let Some(file) = &mut self.current else {
                if self.next_file() {
                    continue;
                }
                return None;
            };
            match file.step(&mut self.warnings) {
                Step::Message(message) => return Some(message),
                Step::Other => {}
                Step::End => {
                    self.bytes_done += file.length;
                    self.current = None;
                }
            }
        }
    }
}

impl OpenFile {
    fn open(path: PathBuf) -> Result<Self, ReadError> {
        let io = |source| ReadError::Io { path: path.clone(), source };
        let file = regular::open(&path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut input = BufReader::with_capacity(1 << 16, file);
        let mut magic = [0; MAGIC_LENGTH as usize];
        if input.read_exact(&mut magic).is_err() || magic != *mcap::MAGIC {
            return Err(ReadError::NotMcap { path });
        }
        let definitions = Definitions::default();
        Ok(Self { path, input, position: MAGIC_LENGTH, length, definitions, chunk: None })
    }

    /// The next record's frame; `None` at the end, with a warning where the file is cut.
    fn read_frame(&mut self, warnings: &mut Vec<String>) -> Option<Frame> {
        let left = self.length.saturating_sub(self.position);
        let mut head = [0; RECORD_HEAD];
        if left < RECORD_HEAD as u64 || self.input.read_exact(&mut head).is_err() {
            warn(warnings, self.cut());
            return None;
        }
        self.position += RECORD_HEAD as u64;
        let mut length = [0; 8];
        length.copy_from_slice(&head[1..]);
        let frame = Frame { op: head[0], length: u64::from_le_bytes(length) };
        if frame.length > self.length - self.position {
            warn(warnings, self.cut());
            return None;
        }
        Some(frame)
    }

    fn cut(&self) -> String {
        format!("{} is cut off at byte {}: read to its last whole record", self.path.display(), self.position)
    }

    fn damaged(&self, what: &str) -> String {
        format!("{}: {what} before byte {} is damaged and skipped", self.path.display(), self.position)
    }

    fn skip(&mut self, bytes: u64) -> Option<()> {
        self.input.seek_relative(i64::try_from(bytes).ok()?).ok()?;
        self.position += bytes;
        Some(())
    }

    fn read(&mut self, bytes: u64) -> Option<Vec<u8>> {
        let mut body = vec![0; usize::try_from(bytes).ok()?];
        self.input.read_exact(&mut body).ok()?;
        self.position += bytes;
        Some(body)
    }

    /// Reads one record, from the open chunk or from the file.
    fn step(&mut self, warnings: &mut Vec<String>) -> Step {
        if let Some((records, at)) = self.chunk.take() {
            return self.step_in_chunk(records, at, warnings);
        }
        let Some(frame) = self.read_frame(warnings) else { return Step::End };
        if frame.op == op::DATA_END || frame.op == op::FOOTER {
            return Step::End;
        }
        let wanted = matches!(frame.op, op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK);
        let believed = frame.length <= longest(frame.op);
        if !wanted || !believed {
            if !believed {
                warn(warnings, self.damaged("a record longer than the limit"));
            }
            return self.skip(frame.length).map_or(Step::End, |()| Step::Other);
        }
        let Some(body) = self.read(frame.length) else {
            warn(warnings, self.damaged("a record"));
            return Step::End;
        };
        if frame.op == op::CHUNK {
            match chunk_records(&body) {
                Some(records) => self.chunk = Some((records, 0)),
                None => warn(warnings, self.damaged("a chunk")),
            }
            return Step::Other;
        }
        self.take(frame.op, &body, warnings)
    }

    fn step_in_chunk(&mut self, records: Vec<u8>, at: usize, warnings: &mut Vec<String>) -> Step {
        let rest = &records[at..];
        if rest.is_empty() {
            return Step::Other;
        }
        let Some((code, body, after)) = split(rest) else {
            warn(warnings, self.damaged("the end of a chunk"));
            return Step::Other;
        };
        let step = self.take(code, body, warnings);
        let next = records.len() - after.len();
        self.chunk = Some((records, next));
        step
    }

    fn take(&mut self, code: u8, body: &[u8], warnings: &mut Vec<String>) -> Step {
        if !matches!(code, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
            return Step::Other;
        }
        let Some(record) = parse(code, body) else {
            warn(warnings, self.damaged("a record"));
            return Step::Other;
        };
        if let McapRecord::Message { header, data } = record {
            let Some(channel) = self.definitions.channels.get(&header.channel_id) else { return Step::Other };
            if header.log_time > LATEST_NS {
                warn(warnings, self.damaged("a message of the year 2200 or later"));
                return Step::Other;
            }
            return Step::Message(RawMessage {
                channel: Arc::clone(channel),
                log_time: MonoTime::from_unsigned_ns(header.log_time),
                publish_time: MonoTime::from_unsigned_ns(header.publish_time),
                sequence: header.sequence,
                data: data.into_owned(),
            });
        }
        if !self.definitions.learn(record, body.len()) && !self.definitions.overfull {
            self.definitions.overfull = true;
            let path = self.path.display();
            warn(
                warnings,
                format!("{path} defines more schemas and channels than the limit: the rest is left out"),
            );
        }
        Step::Other
    }
}

/// The records of a chunk record; its checksum is verified before anything of it is used.
fn chunk_records(body: &[u8]) -> Option<Vec<u8>> {
    match parse(op::CHUNK, body)? {
        McapRecord::Chunk { header, data } => unpack_chunk(&header, &data),
        _ => None,
    }
}

/// The first attachment of that name in a recording, at any place in the file.
pub fn attachment(path: &Path, name: &str) -> Result<Option<Vec<u8>>, ReadError> {
    for segment in segments_of(path)? {
        let mut file = match OpenFile::open(segment) {
            Ok(file) => file,
            Err(_) if path.is_dir() => continue,
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
            if frame.op == op::ATTACHMENT && frame.length <= MAX_ATTACHMENT {
                let body = self.read(frame.length)?;
                if let Some(data) = attachment_named(&body, name) {
                    return Some(data.to_vec());
                }
            } else {
                self.skip(frame.length)?;
            }
        }
        None
    }
}

/// The data of an attachment record if it has that name: log time, create time, name, media type, data, checksum;
/// strings after 4-byte lengths, data after 8 bytes (MCAP specification).
fn attachment_named<'a>(body: &'a [u8], name: &str) -> Option<&'a [u8]> {
    let (found, rest) = sized_u32(body.get(16..)?)?;
    let (_media_type, rest) = sized_u32(rest)?;
    let length = usize::try_from(u64::from_le_bytes(rest.get(..8)?.try_into().ok()?)).ok()?;
    let data = rest.get(8..8usize.checked_add(length)?)?;
    (found == name.as_bytes()).then_some(data)
}
