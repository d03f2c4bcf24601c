//! The wireless link: QUIC with certificates on both sides, live datagrams, back-fill on streams.
//!
//! `docs/link.md` describes the message format and the guarantees.

mod backlog;
mod dial;
mod endpoint;
mod link_events;
mod governor;
pub mod keys;
mod live;
mod pace;
mod payload;
mod payload_shared;
mod peer;
mod quic;
mod ranges;
mod receive;
mod received_numbers;
mod sense;
mod session;
mod station;
mod station_shared;
mod store_backlog;
mod thumbnail;
pub mod tls;
pub mod wire;

pub use backlog::{Backlog, Extent, Found, MemoryBacklog, Unread};
pub use link_events::{LinkError, LinkEvent};
pub use live::{Class, downlink_class};
pub use payload::{EarlyRecords, LinkHandle, PayloadLink, PayloadSettings};
pub use payload_shared::{LinkStatus, StationStatus};
pub use ranges::RangeSet;
pub use received_numbers::{Progress, ReceivedNumbers};
pub use station::{OpenStation, StationHandle, StationLink, StationSettings};
pub use station_shared::{Arrival, Channel, FromPayload, PayloadStatus, Recall};
pub use store_backlog::StoreBacklog;
pub use thumbnail::Picture;
