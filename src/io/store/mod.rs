//! Flights on the data card: append-only MCAP segments, and beside them data that can be rebuilt.
//!
//! [`Store`] runs three threads: one encodes (frames to JPEG, values to protobuf), one writes and is the only one that
//! waits for the card, one does maintenance (index, sealing, old flights). Callers hold a [`StoreHandle`] and never
//! wait. `docs/storage.md` describes the layout and the guarantees.

mod backlog;
#[cfg(test)]
mod crash_tests;
mod encode;
pub mod flight;
pub mod flight_writer;
pub mod format;
pub mod frame_keeper;
mod handle;
#[cfg(test)]
mod handle_tests;
pub mod index;
pub mod inspect;
pub mod journal;
pub mod keeper;
pub mod queue;
pub mod rebuild;
pub mod record;
mod recorder;
pub mod retention;
pub mod scan;
pub mod seal;
#[cfg(test)]
mod seal_tests;
pub mod segment;
pub mod status;
mod store_shared;
pub mod summary;
pub mod volume;
pub mod wear;

pub use frame_keeper::Region;
pub use handle::{Store, StoreHandle};
pub use status::{Recording, StoreNotice, StoreStatus};
