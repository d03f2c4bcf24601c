//! The encoding thread: events and outputs in, records out, in the same order.

use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use super::frame_keeper::FrameKeeper;
use super::queue::{Entry, Popped, Queue};
use super::record::{ChannelDef, RawRecord, STATE_TOPIC, Weight};
use super::store_shared::StoreShared;
use crate::io::records::{self, Record, Schema};
use windhover_base::msg::{Event, EventBody, Source};
use windhover_base::time::MonoTime;

/// An item to be encoded.
#[derive(Debug)]
pub(super) enum Work {
    /// An event.
    Event(Event),
    /// A record of an output, with its number where ground stations get it.
    Record(Arc<Record>, Option<u32>),
    /// A last known state.
    State(String, Vec<u8>),
}

/// Channels by topic and schema.
#[derive(Debug, Default)]
pub(super) struct Channels(HashMap<(Cow<'static, str>, Schema), Arc<ChannelDef>>);

impl Channels {
    fn of(&mut self, record: &Record, backfill: bool) -> Arc<ChannelDef> {
        let key = (record.topic.clone(), record.schema);
        let make = || {
            Arc::new(ChannelDef {
                topic: record.topic.clone().into_owned(),
                schema_name: record.schema.name().into(),
                schema_encoding: "protobuf".into(),
                schema: record.schema.descriptor(),
                message_encoding: "protobuf".into(),
                backfill,
                frame_numbers: record.topic == Source::Camera.topic(),
            })
        };
        Arc::clone(self.0.entry(key).or_insert_with(make))
    }

    /// The record in the store's form.
    pub(super) fn raw(&mut self, record: &Record, number: Option<u32>, weight: Weight) -> RawRecord {
        RawRecord {
            channel: self.of(record, number.is_some()),
            log_ns: unsigned(record.log_time),
            publish_ns: unsigned(record.publish_time),
            sequence: number.unwrap_or(0),
            data: Arc::from(&record.data[..]),
            weight,
        }
    }
}

/// MCAP times are unsigned; negative times become zero.
pub(super) fn unsigned(t: MonoTime) -> u64 {
    u64::try_from(t.ns()).unwrap_or(0)
}

/// Runs until `intake` is closed and empty; then closes `output`.
pub(super) fn run(
    intake: &Queue<Work>,
    output: &Queue<RawRecord>,
    frames: &FrameKeeper,
    shared: &StoreShared,
    now: impl Fn() -> MonoTime,
) {
    let mut channels = Channels::default();
    // Time of the newest event: items without a time get it. The clock may be seconds ahead where the pipeline is
    // behind, and readers sort messages over one second only.
    let mut newest_ns = None;
    let states = ChannelDef::json(STATE_TOPIC);
    let states = Arc::new(ChannelDef { message_encoding: "windhover.state".into(), ..(*states).clone() });
    loop {
        let entry = match intake.pop(Duration::from_secs(1)) {
            Popped::Entry(entry) => entry,
            Popped::Nothing => continue,
            Popped::Closed => break,
        };
        let raw = match entry.value {
            Work::Event(event) => encode_event(&event, frames, shared, &mut channels),
            Work::Record(record, number) => Some(channels.raw(&record, number, Weight::of(record.schema))),
            Work::State(name, blob) => {
                let at = newest_ns.unwrap_or_else(|| unsigned(now()));
                let data = state_message(&name, &blob).into();
                let channel = Arc::clone(&states);
                Some(RawRecord {
                    channel,
                    log_ns: at,
                    publish_ns: at,
                    sequence: 0,
                    data,
                    weight: Weight::Small,
                })
            }
        };
        if let Some(raw) = raw {
            newest_ns = newest_ns.max(Some(raw.log_ns));
            let topic = raw.channel.topic.clone().into();
            output.push(Entry {
                bytes: raw.bytes(),
                weight: raw.weight,
                topic,
                log_ns: raw.log_ns,
                value: raw,
            });
        }
    }
    output.close();
}

fn encode_event(
    event: &Event,
    frames: &FrameKeeper,
    shared: &StoreShared,
    channels: &mut Channels,
) -> Option<RawRecord> {
    if let EventBody::Frame(frame) = &event.body {
        let kept = frames.keep(frame, shared.region())?;
        let event = Event { body: EventBody::Frame(kept), ..event.clone() };
        let record = records::of_event(&event)?;
        return Some(RawRecord { sequence: frame.index, ..channels.raw(&record, None, Weight::Frame) });
    }
    Some(channels.raw(&records::of_event(event)?, None, Weight::Small))
}

/// A state as a message: length of its name, name, blob.
pub(super) fn state_message(name: &str, blob: &[u8]) -> Vec<u8> {
    let name = &name.as_bytes()[..name.len().min(255)];
    let mut out = vec![name.len() as u8];
    out.extend_from_slice(name);
    out.extend_from_slice(blob);
    out
}

/// Name and blob of a state message.
pub(super) fn parse_state(message: &[u8]) -> Option<(String, Vec<u8>)> {
    let length = usize::from(*message.first()?);
    let name = String::from_utf8(message.get(1..1 + length)?.to_vec()).ok()?;
    Some((name, message.get(1 + length..)?.to_vec()))
}
