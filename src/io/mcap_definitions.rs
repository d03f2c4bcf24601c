//! What an MCAP file defines, schemas and channels: each kept once, and all within a limit.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use mcap::records::Record as McapRecord;

/// Schemas and channels of a file are kept up to so many bytes: a thousand channels of this program
/// take a tenth of it.
const MAX_DEFINITIONS: usize = 1 << 26;
/// Memory that a definition takes beside its bytes, near enough for a limit.
const DEFINITION_COST: usize = 256;
/// A schema of a recording.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct SchemaInfo {
    /// Its name; empty stands for no schema.
    pub name: String,
    /// How it is written, e.g. `protobuf`.
    pub encoding: String,
    /// The schema.
    pub data: Vec<u8>,
}

/// A channel of a recording: topic and schema.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct ChannelInfo {
    /// Topic.
    pub topic: String,
    /// Encoding of its messages.
    pub message_encoding: String,
    /// Its schema, shared by all channels that have it.
    pub schema: Arc<SchemaInfo>,
    /// What else its writer said of it.
    pub metadata: BTreeMap<String, String>,
}

/// Schemas and channels of a file, by number.
#[derive(Default)]
pub(super) struct Definitions {
    pub(super) schemas: HashMap<u16, Arc<SchemaInfo>>,
    pub(super) channels: HashMap<u16, Arc<ChannelInfo>>,
    /// Bytes taken by everything ever defined; what is said again does not count.
    bytes: usize,
    /// Whether something was left out because that was too much.
    pub(super) overfull: bool,
}

impl Definitions {
    /// Takes a schema or channel whose record has so many bytes; false where there is no room for it.
    pub(super) fn learn(&mut self, record: McapRecord<'_>, bytes: usize) -> bool {
        let room = self.bytes.saturating_add(bytes + DEFINITION_COST) <= MAX_DEFINITIONS;
        match record {
            McapRecord::Schema { header, data } => {
                let same = |s: &Arc<SchemaInfo>| {
                    s.name == header.name && s.encoding == header.encoding && s.data == *data
                };
                if self.schemas.get(&header.id).is_some_and(same) {
                    return true;
                }
                if room {
                    let data = data.into_owned();
                    let schema = SchemaInfo { name: header.name, encoding: header.encoding, data };
                    self.schemas.insert(header.id, Arc::new(schema));
                }
            }
            McapRecord::Channel(channel) => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let info = ChannelInfo {
                    topic: channel.topic,
                    message_encoding: channel.message_encoding,
                    schema,
                    metadata: channel.metadata,
                };
                if self.channels.get(&channel.id).is_some_and(|known| **known == info) {
                    return true;
                }
                if room {
                    self.channels.insert(channel.id, Arc::new(info));
                }
            }
            _ => return true,
        }
        if room {
            self.bytes += bytes + DEFINITION_COST;
        }
        room
    }
}
