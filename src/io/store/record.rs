//! Input of the store: encoded records on named channels, and the numbers of channels in a flight.

use std::collections::BTreeMap;
use std::sync::Arc;

use mcap::records::Channel;

use super::format;
use crate::io::records::{FRAME_NUMBER_KEY, IN_SEQUENCE, Schema};

/// Channel metadata key of records that are also queued for the ground station.
pub const BACKFILL_KEY: &str = "windhover.backfill";

/// Topic of the store's own records of dropped messages (JSON).
pub const DROPOUT_TOPIC: &str = "/store/dropout";

/// Topic of the last known states (see `index`).
pub const STATE_TOPIC: &str = "/store/state";

/// A stream of messages of one kind.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ChannelDef {
    /// Topic, e.g. `/gps/serial`.
    pub topic: String,
    /// Name of the schema, e.g. `windhover.SerialBytes`; empty where there is none.
    pub schema_name: String,
    /// Encoding of the schema, e.g. `protobuf`.
    pub schema_encoding: String,
    /// The schema, e.g. a `FileDescriptorSet`.
    pub schema: Vec<u8>,
    /// Encoding of messages, e.g. `protobuf`.
    pub message_encoding: String,
    /// Whether its records get sequence numbers and are queued for back-fill.
    pub backfill: bool,
    /// Whether a message's sequence number is the number of its camera frame.
    pub frame_numbers: bool,
}

impl ChannelDef {
    /// A channel of JSON messages without a schema.
    pub fn json(topic: &str) -> Arc<Self> {
        Arc::new(Self {
            topic: topic.into(),
            schema_name: String::new(),
            schema_encoding: String::new(),
            schema: Vec::new(),
            message_encoding: "json".into(),
            backfill: false,
            frame_numbers: false,
        })
    }
}

/// What is dropped first when the card cannot keep up.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Weight {
    /// A camera frame: dropped first, oldest first.
    Frame,
    /// Anything else.
    Small,
}

impl Weight {
    /// Of a record of that schema.
    pub fn of(schema: Schema) -> Self {
        if schema == Schema::CompressedVideo { Self::Frame } else { Self::Small }
    }
}

/// One encoded message.
#[derive(Clone, Debug)]
pub struct RawRecord {
    /// Its channel; using the same `Arc` each time saves look-ups.
    pub channel: Arc<ChannelDef>,
    /// Time of reception or creation, host time, ns.
    pub log_ns: u64,
    /// Time of validity, host time, ns; `log_ns` where not known.
    pub publish_ns: u64,
    /// Position in its stream; its number in the
    /// run on back-fill channels, the frame's on those of frames.
    pub sequence: u32,
    /// The message.
    pub data: Arc<[u8]>,
    /// Whether it is dropped first.
    pub weight: Weight,
}

impl RawRecord {
    /// Memory that it takes, bytes, approximately, for bounding queues.
    pub fn bytes(&self) -> usize {
        self.data.len() + 128
    }
}

/// Schemas and channels under their numbers. Numbers are never reused within a flight, so that a segment whose
/// definitions were lost can be read with those of a neighbour.
#[derive(Clone, Default, PartialEq, Eq, Debug)]
pub struct Definitions {
    /// Schemas by number, from 1: name, encoding, data.
    pub schemas: BTreeMap<u16, (String, String, Vec<u8>)>,
    /// Channels by number, from 1.
    pub channels: BTreeMap<u16, Channel>,
}

impl Definitions {
    /// The channel's number, and whether it is new.
    pub fn number(&mut self, def: &ChannelDef) -> (u16, bool) {
        let known = self.channels.values().find(|c| {
            c.topic == def.topic
                && c.message_encoding == def.message_encoding
                && self.schema_name(c.schema_id) == def.schema_name
        });
        if let Some(channel) = known {
            return (channel.id, false);
        }
        let schema_id = self.schema_number(def);
        let id = self.channels.keys().next_back().map_or(1, |last| last + 1);
        let mut metadata = BTreeMap::new();
        if def.backfill {
            metadata.insert(BACKFILL_KEY.into(), "1".into());
        }
        if def.frame_numbers {
            metadata.insert(FRAME_NUMBER_KEY.into(), IN_SEQUENCE.into());
        }
        let channel = Channel {
            id,
            schema_id,
            topic: def.topic.clone(),
            message_encoding: def.message_encoding.clone(),
            metadata,
        };
        self.channels.insert(id, channel);
        (id, true)
    }

    fn schema_name(&self, id: u16) -> &str {
        self.schemas.get(&id).map_or("", |(name, _, _)| name)
    }

    fn schema_number(&mut self, def: &ChannelDef) -> u16 {
        if def.schema_name.is_empty() {
            return 0;
        }
        let wanted = (def.schema_name.clone(), def.schema_encoding.clone(), def.schema.clone());
        if let Some((id, _)) = self.schemas.iter().find(|(_, schema)| **schema == wanted) {
            return *id;
        }
        let id = self.schemas.keys().next_back().map_or(1, |last| last + 1);
        self.schemas.insert(id, wanted);
        id
    }

    /// Adds the definitions of `other` that are missing here.
    pub fn complete_from(&mut self, other: &Self) {
        for (id, schema) in &other.schemas {
            self.schemas.entry(*id).or_insert_with(|| schema.clone());
        }
        for (id, channel) in &other.channels {
            self.channels.entry(*id).or_insert_with(|| channel.clone());
        }
    }

    /// Whether no definition here differs in `other`.
    pub fn agrees_with(&self, other: &Self) -> bool {
        self.schemas.iter().all(|(id, s)| other.schemas.get(id) == Some(s))
            && self.channels.iter().all(|(id, c)| other.channels.get(id) == Some(c))
    }

    /// Takes one schema or channel record; others are ignored.
    pub fn learn(&mut self, record: &mcap::records::Record<'_>) {
        use mcap::records::Record;
        match record {
            Record::Schema { header, data } if header.id != 0 => {
                let schema = (header.name.clone(), header.encoding.clone(), data.to_vec());
                self.schemas.entry(header.id).or_insert(schema);
            }
            Record::Channel(channel) => {
                self.channels.entry(channel.id).or_insert_with(|| channel.clone());
            }
            _ => {}
        }
    }

    /// Whether channel `id` can be read with these definitions.
    pub fn has(&self, id: u16) -> bool {
        self.channels.get(&id).is_some_and(|c| c.schema_id == 0 || self.schemas.contains_key(&c.schema_id))
    }

    /// Writes channel `id` and its schema as records.
    pub fn put_one(&self, out: &mut Vec<u8>, id: u16) {
        let Some(channel) = self.channels.get(&id) else { return };
        if let Some((name, encoding, data)) = self.schemas.get(&channel.schema_id) {
            format::put_schema(out, channel.schema_id, name, encoding, data);
        }
        format::put_channel(out, channel);
    }

    /// Writes all of them as records.
    pub fn put(&self, out: &mut Vec<u8>) {
        for (id, (name, encoding, data)) in &self.schemas {
            format::put_schema(out, *id, name, encoding, data);
        }
        for channel in self.channels.values() {
            format::put_channel(out, channel);
        }
    }
}
