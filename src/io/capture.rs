//! Captures: serial bytes and frames in and out of MCAP.

use std::collections::BinaryHeap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::Arc;

use prost::Message as _;

use super::mcap_read::{self, McapReader, RawMessage, ReadError};
use super::mcap_write::{CONFIG_ATTACHMENT, McapWriter, WriteError};
use super::proto::{foxglove, host_time, windhover};
use super::records::{self, FRAME_NUMBER_KEY, IN_SEQUENCE, topic, warm};
use windhover_base::msg::{Delivery, Event, EventBody, FrameEncoding, FramePayload, Source};
use windhover_base::time::{MonoTime, Span};

/// Messages are put in order of their log time over this span: writers of several threads do not
/// keep it exactly.
const REORDER: Span = Span::from_ns(1_000_000_000);
/// Unless they take more memory than this, in bytes: a second of raw colour frames fits twice.
const REORDER_BYTES: usize = 1 << 28;
/// Memory of a message beside its bytes, near enough for a limit.
const MESSAGE_COST: usize = 256;

/// Whether a topic is of events.
fn is_event(topic: &str) -> bool {
    Source::on_topic(topic).is_some() || [topic::SOURCE_EVENT, topic::WARM_START].contains(&topic)
}

/// One message of a capture: as recorded, and as the event it stands for, if any.
#[derive(Clone, Debug)]
pub struct CaptureItem {
    /// As recorded.
    pub raw: RawMessage,
    /// What it stands for; `None` for topics that are not a source.
    pub event: Option<Event>,
}

/// Events of a capture in the order they were heard.
pub struct CaptureReader {
    reader: McapReader,
    waiting: BinaryHeap<Waiting>,
    waiting_bytes: usize,
    newest: MonoTime,
    read: u64,
    seq: u64,
    frames: u32,
    warnings: Vec<String>,
}

/// Orders the heap: earliest first, file order among equals.
struct Waiting {
    raw: RawMessage,
    order: u64,
}

impl PartialEq for Waiting {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}
impl Eq for Waiting {}
impl PartialOrd for Waiting {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Waiting {
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
            frames: 0,
            warnings: Vec::new(),
        })
    }

    /// What was damaged or could not be understood, so far; taken.
    pub fn take_warnings(&mut self) -> Vec<String> {
        let mut all = self.reader.take_warnings();
        all.append(&mut self.warnings);
        all
    }

    /// Bytes read and bytes in all.
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
        let topic = raw.channel.topic.as_str();
        if let Some(source) = Source::on_topic(topic) {
            return self.delivered(source, raw).map(Some);
        }
        Ok(match topic {
            topic::WARM_START => {
                let told = warm::state(&windhover::WarmState::decode(&raw.data[..])?);
                told.map(|state| EventBody::Warm(Box::new(state)))
            }
            topic::SOURCE_EVENT => source_event(&windhover::SourceEvent::decode(&raw.data[..])?),
            _ => None,
        })
    }

    fn delivered(&mut self, source: Source, raw: &RawMessage) -> Result<EventBody, prost::DecodeError> {
        if source.delivers() == Delivery::Bytes {
            let data = windhover::SerialBytes::decode(&raw.data[..])?.data;
            return Ok(EventBody::Bytes { source, data });
        }
        // A frame that does not even decode as a message still counts as one.
        let numbered = raw.channel.metadata.get(FRAME_NUMBER_KEY).is_some_and(|v| v == IN_SEQUENCE);
        let index = if numbered { raw.sequence } else { self.frames };
        self.frames = index.saturating_add(1);
        Ok(EventBody::Frame(frame(raw, index)?))
    }
}

/// A frame out of either image schema.
fn frame(raw: &RawMessage, index: u32) -> Result<FramePayload, prost::DecodeError> {
    if raw.channel.schema.name == "foxglove.RawImage" {
        let image = foxglove::RawImage::decode(&raw.data[..])?;
        return Ok(FramePayload {
            index,
            t_exposure: host_time(image.timestamp.as_ref()),
            encoding: records::encoding_of_raw(&image.encoding),
            width: image.width,
            height: image.height,
            stride: image.step,
            data: Arc::from(image.data),
        });
    }
    let image = foxglove::CompressedImage::decode(&raw.data[..])?;
    let encoding = match image.format.to_ascii_lowercase().as_str() {
        "jpeg" | "jpg" => FrameEncoding::Jpeg,
        "png" => FrameEncoding::Png,
        _ => FrameEncoding::Unknown,
    };
    Ok(FramePayload {
        index,
        t_exposure: host_time(image.timestamp.as_ref()),
        encoding,
        width: 0,
        height: 0,
        stride: 0,
        data: Arc::from(image.data),
    })
}

fn source_event(event: &windhover::SourceEvent) -> Option<EventBody> {
    let source = Source::named(&event.source)?;
    match event.what.as_str() {
        "dropped" => Some(EventBody::Dropped { source, count: event.count }),
        "pulse" => Some(EventBody::Pulse),
        "up" => Some(EventBody::SourceUp(source)),
        "down" => Some(EventBody::SourceDown(source)),
        _ => None,
    }
}

impl Iterator for CaptureReader {
    type Item = CaptureItem;

    fn next(&mut self) -> Option<CaptureItem> {
        loop {
            let due = self.waiting_bytes > REORDER_BYTES
                || self.waiting.peek().is_some_and(|first| self.newest - first.raw.log_time >= REORDER);
            if !due && let Some(raw) = self.reader.next() {
                // Others may be dated by other clocks than what was heard.
                if is_event(&raw.channel.topic) {
                    self.newest = self.newest.max(raw.log_time);
                }
                self.waiting_bytes += raw.data.len() + MESSAGE_COST;
                self.waiting.push(Waiting { raw, order: self.read });
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

/// Writes a capture of events.
pub struct CaptureWriter {
    writer: McapWriter<BufWriter<File>>,
}

impl CaptureWriter {
    /// Creates a capture with its configuration attached.
    pub fn create(path: &Path, config_toml: &str, began: MonoTime) -> Result<Self, WriteError> {
        Ok(Self { writer: McapWriter::create(path, config_toml, began)? })
    }

    /// Writes an event; ticks are not recorded.
    pub fn write(&mut self, event: &Event) -> Result<(), WriteError> {
        records::of_event(event).map_or(Ok(()), |record| self.writer.write(&record))
    }

    /// Ends the capture.
    pub fn finish(self) -> Result<(), WriteError> {
        self.writer.finish().map(drop)
    }
}
