//! Back-fill from the store on the data card: earlier runs, and records that are no longer in memory.

use std::time::Duration;

use ring::rand::SecureRandom as _;

use super::backlog::{Backlog, Extent, Found};
use crate::io::store::StoreHandle;

/// Name under which the card stores its identity.
const CARD: &str = "link.card";
/// How long the card may take to report its identity: records that are made meanwhile are sent once the link is open.
const WAIT: Duration = Duration::from_secs(5);

/// The store's queue. Its runs count 1, 2, 3, … on each card, so a new card starts again at 1; on the link a random
/// number on the card distinguishes them.
pub struct StoreBacklog {
    store: StoreHandle,
    card: u32,
}

impl StoreBacklog {
    /// A backlog of a store; also returns the identity of the present run on the link and its flight's name. Waits up
    /// to ten seconds for the card, where there is one.
    pub fn open(store: StoreHandle) -> (Self, u32, String) {
        let session = store.run();
        let index = store.index_within(WAIT);
        let known = index.as_ref().and_then(|index| index.state(CARD));
        let card =
            known.and_then(|blob| Some(u32::from_be_bytes(blob.try_into().ok()?))).unwrap_or_else(|| {
                let mut fresh = [0; 4];
                // Without random bytes only runs of different cards may be confused.
                let _ = ring::rand::SystemRandom::new().fill(&mut fresh);
                // A card that did not answer may have an identity: it keeps that.
                if index.is_some() {
                    store.put_state(CARD, fresh.to_vec());
                }
                u32::from_be_bytes(fresh)
            });
        let flight = index.and_then(|index| index.flight(session)).unwrap_or_else(|| boot_name(session));
        (Self { store, card }, session ^ card, flight)
    }
}

fn boot_name(session: u32) -> String {
    format!("boot-{session}")
}

/// A run of the card under its number on the link.
fn on_link(mut extent: Extent, card: u32) -> Extent {
    if extent.flight.is_empty() {
        extent.flight = boot_name(extent.run);
    }
    extent.run ^= card;
    extent
}

impl Backlog for StoreBacklog {
    fn extents(&self) -> Vec<Extent> {
        self.store.extents().into_iter().map(|extent| on_link(extent, self.card)).collect()
    }

    fn read(&self, run: u32, first: u32, end: u32, max_bytes: usize) -> Found {
        self.store.read(run ^ self.card, first, end, max_bytes)
    }

    fn acknowledge(&self, station: &str, run: u32, through: u32) {
        Backlog::acknowledge(&self.store, station, run ^ self.card, through);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_distinguished_by_card_and_always_have_a_name() {
        let run = |run, flight: &str| Extent { run, flight: flight.into(), first: 3, end: 10 };
        assert_eq!(on_link(run(1, "20261118T150405Z"), 0xabcd), run(1 ^ 0xabcd, "20261118T150405Z"));
        assert_eq!(on_link(run(2, ""), 0), run(2, "boot-2"));
    }
}
