//! A payload in trouble: its connection ends without a goodbye, its card cannot be read.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use windhover::io::link::keys::Role;
use windhover::io::link::tls::Identity;
use windhover::io::link::{Backlog, Extent, Found, MemoryBacklog, Unread};

use crate::team::{Keys, Payload, Station, card, loopback, payload_settings, station_settings, within};

/// Shorter than a station's wait after another program of the same name took over.
const PATIENCE: Duration = Duration::from_secs(20);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_payload_whose_streams_end_before_its_connection_is_called_again() {
    // Given: a payload that falls apart like a process that is killed: its streams are ended, and the close
    // of its connection comes much later, or never.
    let keys = Keys::new();
    let identity = Identity::load(&keys.files(Role::Payload, "alpha"), Role::Payload).expect("an identity");
    let tls = identity.server().expect("a server's settings");
    let server = quinn::ServerConfig::with_crypto(Arc::new(tls));
    let endpoint = quinn::Endpoint::server(server, ([127, 0, 0, 1], 0).into()).expect("a port");
    let address = endpoint.local_addr().expect("bound");
    let _station = Station::first(&station_settings(keys.files(Role::Station, "base"), Some(address)));
    let mut kept = Vec::new();
    for time in 0..3 {
        let calls = async { endpoint.accept().await.expect("an open port").await.expect("a handshake") };
        // Then: the station does not mistake that for another program's takeover, and connects again.
        let called = tokio::time::timeout(PATIENCE, calls).await;
        let call = called.unwrap_or_else(|_| panic!("no call after {time}"));
        // When: the control stream ends.
        let (mut out, _) = call.accept_bi().await.expect("the control stream");
        out.finish().expect("open until now");
        kept.push(call);
    }
}

/// A card that cannot be read at first.
struct Faulty {
    card: Arc<MemoryBacklog>,
    failures: AtomicU32,
}

impl Backlog for Faulty {
    fn extents(&self) -> Vec<Extent> {
        self.card.extents()
    }

    fn read(&self, run: u32, first: u32, end: u32, max_bytes: usize) -> Found {
        let fails = self.failures.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1));
        if fails.is_ok() { Err(Unread { end }) } else { self.card.read(run, first, end, max_bytes) }
    }

    fn acknowledge(&self, station: &str, run: u32, through: u32) {
        self.card.acknowledge(station, run, through);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_card_cannot_read_just_now_is_not_gone() {
    // Given: a run on a card whose first two reads fail, and the present run in memory.
    let keys = Keys::new();
    let card = card(1, 50);
    let deep = Arc::new(Faulty { card, failures: AtomicU32::new(2) });
    let settings = payload_settings(keys.files(Role::Payload, "alpha"), loopback());
    let payload = Payload::start(&settings, 2, Some(deep as Arc<dyn Backlog>));
    let sent = payload.send() + 1;
    let station = Station::first(&station_settings(keys.files(Role::Station, "base"), Some(payload.address)));
    // Then: the present run does not wait for the card, and the old one comes whole.
    station.complete(2, sent, PATIENCE).await;
    station.complete(1, 50, PATIENCE).await;
    let unread = || payload.handle.status().stations.iter().map(|s| s.unread).sum::<u64>() == 2;
    assert!(within(PATIENCE, unread).await, "{:?}", payload.handle.status());
    assert!(station.handle.status().iter().all(|s| s.progress.gone == 0), "{:?}", station.handle.status());
}
