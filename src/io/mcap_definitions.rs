//! Definitions of an MCAP file, schemas and channels: each kept once, and all within a limit.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use mcap::records::Record as McapRecord;

/// Schemas and channels of a file are kept up to this many bytes: a thousand channels of this program take a tenth of
/// it.
const MAX_DEFINITIONS: usize = 1 << 26;
/// Memory of a definition apart from its bytes, approximately, for the limit.
const DEFINITION_COST: usize = 256;
/// A schema of a recording.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct SchemaInfo {
    /// Its name; empty stands for no schema.
    pub name: String,
    /// Its encoding, e.g. `protobuf`.
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
    /// Metadata of its writer.
    pub metadata: BTreeMap<String, String>,
}

/// Schemas and channels of a file, by number.
#[derive(Default)]
pub(super) struct Definitions {
    pub(super) schemas: HashMap<u16, Arc<SchemaInfo>>,
    pub(super) channels: HashMap<u16, Arc<ChannelInfo>>,
    /// Bytes of all definitions so far; repeated ones do not count.
    bytes: usize,
    /// Whether a definition was left out because of the limit.
    pub(super) overfull: bool,
}

impl Definitions {
    /// Takes a schema or channel whose record has this many bytes; false where there is no room for it.
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
