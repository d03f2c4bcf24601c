//! The wireless link: QUIC with certificates on both sides, live datagrams, back-fill on streams.
//!
//! `docs/link.md` describes the message format and what is guaranteed.

mod backlog;
mod dial;
mod door;
mod events;
mod governor;
mod inbox;
pub mod keys;
mod live;
mod pace;
mod payload;
mod peer;
mod quic;
mod ranges;
mod receive;
mod sense;
mod session;
mod station;
mod store_backlog;
mod thumbnail;
pub mod tls;
pub mod wire;

pub use backlog::{Backlog, Extent, Found, MemoryBacklog, Unread};
pub use events::{LinkError, LinkEvent};
pub use inbox::{Inbox, Progress};
pub use live::{Class, downlink_class};
pub use payload::{EarlyRecords, LinkHandle, LinkStatus, PayloadLink, PayloadSettings, StationStatus};
pub use ranges::RangeSet;
pub use station::{
    Arrival, Channel, FromPayload, OpenStation, PayloadStatus, Recall, StationHandle, StationLink,
    StationSettings,
};
pub use store_backlog::StoreBacklog;
pub use thumbnail::Picture;
