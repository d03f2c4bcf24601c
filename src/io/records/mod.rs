//! Recorded messages: events and outputs as protobuf messages on named topics.

mod event_codec;
mod output_messages;
mod outputs;
mod schema;
pub mod topic;
pub mod warm_message;

pub use event_codec::{EventDecoder, KeptMessage, is_event, of_event, to_attitude, topic_of_event};
pub use output_messages::{detections, health, location, ownship, target_state, transform};
pub use outputs::{DaemonFigures, OutputEncoder, opening};
pub use schema::Schema;

use std::borrow::Cow;

use windhover_base::time::MonoTime;

/// Channel metadata key for the place of a frame's number: with value [`IN_SEQUENCE`] it is the message's sequence
/// number. Frames that are not in the recording then leave a gap, and a replay numbers the others as the flight did.
/// Without this key frames are counted in order.
pub const FRAME_NUMBER_KEY: &str = "windhover.frame_number";

/// See [`FRAME_NUMBER_KEY`].
pub const IN_SEQUENCE: &str = "sequence";

/// One message to be recorded or sent.
#[derive(Clone, Debug)]
pub struct Record {
    /// Topic.
    pub topic: Cow<'static, str>,
    /// Schema of `data`.
    pub schema: Schema,
    /// Log clock: reception of the event that caused it, host time.
    pub log_time: MonoTime,
    /// Time of validity, host time.
    pub publish_time: MonoTime,
    /// The protobuf message.
    pub data: Vec<u8>,
}
