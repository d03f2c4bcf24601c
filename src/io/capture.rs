//! Captures: serial bytes and frames to and from MCAP.

use std::collections::BinaryHeap;
use std::path::{Path, PathBuf};

use super::mcap_read::{self, McapReader, RawMessage, ReadError};
use super::mcap_write::{CONFIG_ATTACHMENT, Maker, McapFile, WriteError};
use super::records::{self, EventDecoder, FRAME_NUMBER_KEY, IN_SEQUENCE, KeptMessage};
use windhover_base::msg::{Event, EventBody};
use windhover_base::time::{MonoTime, Span};

/// Messages are sorted by their log time over this span: writers with several threads do not keep the order exactly.
const REORDER: Span = Span::from_ns(1_000_000_000);
/// Unless they take more memory than this, in bytes: a second of raw colour frames fits twice.
const REORDER_BYTES: usize = 1 << 28;
/// Memory of a message apart from its bytes, approximately, for the limit.
const MESSAGE_COST: usize = 256;

/// One message of a capture: as recorded, and as an event where it is one.
#[derive(Clone, Debug)]
pub struct CaptureItem {
    /// As recorded.
    pub raw: RawMessage,
    /// The event; `None` for topics that are not a source.
    pub event: Option<Event>,
}

/// Events of a capture in order of reception.
pub struct CaptureReader {
    reader: McapReader,
    waiting: BinaryHeap<Reordered>,
    waiting_bytes: usize,
    newest: MonoTime,
    read: u64,
    seq: u64,
    decoder: EventDecoder,
    warnings: Vec<String>,
}

/// Orders the heap: earliest first, file order among equals.
struct Reordered {
    raw: RawMessage,
    order: u64,
}

impl PartialEq for Reordered {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}
impl Eq for Reordered {}
impl PartialOrd for Reordered {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Reordered {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (other.raw.log_time, other.order).cmp(&(self.raw.log_time, self.order))
    }
}

/// The configuration attached to a recording, as text; `None` where there is none.
pub fn attached_config(path: &Path) -> Result<Option<String>, ReadError> {
    let found = mcap_read::attachment(path, CONFIG_ATTACHMENT)?;
    Ok(found.map(|bytes| String::from_utf8_lossy(&bytes).into_owned()))
}

impl CaptureReader {
    /// Opens a capture or flight: a file, or a directory of segments.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        Ok(Self {
            reader: McapReader::open(path)?,
            waiting: BinaryHeap::new(),
            waiting_bytes: 0,
            newest: MonoTime::from_ns(i64::MIN),
            read: 0,
            seq: 0,
            decoder: EventDecoder::default(),
            warnings: Vec::new(),
        })
    }

    /// Damage and unreadable messages found since the last call.
    pub fn take_warnings(&mut self) -> Vec<String> {
        let mut all = self.reader.take_warnings();
        all.append(&mut self.warnings);
        all
    }

    /// Bytes read so far, and in total.
    pub fn progress(&self) -> (u64, u64) {
        self.reader.progress()
    }

    fn event(&mut self, raw: &RawMessage) -> Option<Event> {
        let body = match self.body(raw) {
            Ok(body) => body?,
            Err(error) => {
                let (channel, at) = (&raw.channel, raw.log_time);
                let text = format!(
                    "a message on {} at {at:?} is not {}: {error}",
                    channel.topic, channel.schema.name
                );
                mcap_read::warn(&mut self.warnings, text);
                return None;
            }
        };
        let seq = self.seq;
        self.seq += 1;
        Some(Event { t_recv: raw.log_time, seq, body })
    }

    fn body(&mut self, raw: &RawMessage) -> Result<Option<EventBody>, prost::DecodeError> {
        let numbered = raw.channel.metadata.get(FRAME_NUMBER_KEY).is_some_and(|v| v == IN_SEQUENCE);
        self.decoder.body(&KeptMessage {
            topic: &raw.channel.topic,
            schema: &raw.channel.schema.name,
            frame_number: numbered.then_some(raw.sequence),
            data: &raw.data,
        })
    }
}

impl Iterator for CaptureReader {
    type Item = CaptureItem;

    fn next(&mut self) -> Option<CaptureItem> {
        loop {
            let due = self.waiting_bytes > REORDER_BYTES
                || self.waiting.peek().is_some_and(|first| self.newest - first.raw.log_time >= REORDER);
            if !due && let Some(raw) = self.reader.next() {
                // Other messages may be stamped by other clocks than the events.
                if records::is_event(&raw.channel.topic) {
                    self.newest = self.newest.max(raw.log_time);
                }
                self.waiting_bytes += raw.data.len() + MESSAGE_COST;
                self.waiting.push(Reordered { raw, order: self.read });
                self.read += 1;
                continue;
            }
            let raw = self.waiting.pop()?.raw;
            self.waiting_bytes -= raw.data.len() + MESSAGE_COST;
            let event = self.event(&raw);
            return Some(CaptureItem { raw, event });
        }
    }
}

/// Writes a capture of events. The file gets its name when it is finished.
pub struct CaptureWriter {
    path: PathBuf,
    writer: McapFile,
}

impl CaptureWriter {
    /// Creates a capture with its configuration attached.
    pub fn create(path: &Path, config_toml: &str, began: MonoTime) -> Result<Self, WriteError> {
        let writer = McapFile::create(path, Maker::Capture, config_toml, began)?;
        Ok(Self { path: path.to_owned(), writer })
    }

    /// States the origin of the messages of a topic, before the first of them.
    pub fn made_of(&mut self, topic: &str, text: &str) {
        self.writer.made_of(topic, text);
    }

    /// Writes an event; ticks are not recorded.
    pub fn write(&mut self, event: &Event) -> Result<(), WriteError> {
        records::of_event(event).map_or(Ok(()), |record| self.writer.write(&record))
    }

    /// Ends the capture.
    pub fn finish(self) -> Result<(), WriteError> {
        self.writer.close(&self.path)
    }
}
