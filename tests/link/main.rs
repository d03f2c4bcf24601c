//! The wireless link over an impaired relay: nothing missing, nothing twice, no foreign peer.

mod refused;
mod relay;
mod station;
mod team;
mod trouble;

use std::sync::Arc;
use std::time::Duration;

use relay::{Radio, Relay};
use team::{Keys, Payload, Station, any, card, loopback, payload_settings, record, station_settings, within};
use windhover::io::link::keys::Role;
use windhover::io::link::{Backlog, EarlyRecords, LinkEvent};
use windhover_base::time::MonoTime;

const PATIENCE: Duration = Duration::from_secs(20);

fn is_up(event: &LinkEvent) -> bool {
    matches!(event, LinkEvent::Up { .. })
}

struct Pair {
    /// The files of the keys live as long as this.
    _keys: Keys,
    payload: Payload,
    relay: Relay,
    station: Station,
}

async fn pair(radio: Radio, seed: u64) -> Pair {
    let keys = Keys::new();
    let payload = Payload::start(&payload_settings(keys.files(Role::Payload, "alpha"), loopback()), 1, None);
    let relay = Relay::start(payload.address, radio, seed);
    let station = Station::first(&station_settings(keys.files(Role::Station, "base"), Some(relay.address)));
    assert!(within(PATIENCE, || any(&station.events, is_up)).await, "no connection");
    Pair { _keys: keys, payload, relay, station }
}

async fn send(payload: &Payload, count: u32, every: Duration) -> u32 {
    let mut next = 0;
    for _ in 0..count {
        next = payload.send() + 1;
        tokio::time::sleep(every).await;
    }
    next
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_good_radio_carries_everything_live() {
    let pair = pair(Radio::default(), 1).await;
    let sent = send(&pair.payload, 60, Duration::from_millis(40)).await;
    pair.station.complete(1, sent, PATIENCE).await;
    // A machine that is busy may let one overtake the other, which is then back-filled.
    let live = pair.station.of(1).live_ms.len();
    assert!(live > 30, "{live} of {sent} came live");
    assert!(any(&pair.payload.events, is_up), "the payload tells of the station");
    pair.station.stop().await;
    let gone = |e: &LinkEvent| matches!(e, LinkEvent::Down { peer, .. } if peer == "base");
    assert!(within(PATIENCE, || any(&pair.payload.events, gone)).await, "the station said goodbye");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_made_before_the_link_was_open_reaches_the_station() {
    // Given records of a run whose link was not open yet.
    let keys = Keys::new();
    let settings = payload_settings(keys.files(Role::Payload, "alpha"), loopback());
    let early = EarlyRecords::new(&settings);
    let numbers: Vec<_> = (0..5).map(|n| early.send(&record(MonoTime::from_ns(n)))).collect();
    assert_eq!(numbers, [0, 1, 2, 3, 4].map(Some));
    // When the link is open, then numbers go on, and a station gets them all.
    let payload = Payload::start(&settings, 1, None);
    payload.handle.begin_with(early);
    assert_eq!(payload.send(), 5);
    let files = keys.files(Role::Station, "base");
    let station = Station::first(&station_settings(files, Some(payload.address)));
    station.complete(1, 6, PATIENCE).await;
    station.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lossy_radio_loses_nothing_in_the_end() {
    for (loss, seed) in [(0.1, 2), (0.3, 3)] {
        let pair = pair(Radio { loss, ..Radio::default() }, seed).await;
        let sent = send(&pair.payload, 100, Duration::from_millis(10)).await;
        pair.station.complete(1, sent, PATIENCE).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cut_is_filled_and_live_goes_on_at_once() {
    let pair = pair(Radio::default(), 4).await;
    send(&pair.payload, 20, Duration::from_millis(10)).await;
    pair.relay.set(|radio| radio.cut = true);
    let at_cut = send(&pair.payload, 60, Duration::from_millis(20)).await;
    let before = pair.station.of(1).live_ms.len();
    pair.relay.set(|radio| radio.cut = false);
    let live = || pair.station.of(1).live_ms.len() - before;
    let (mut sent, restored) = (at_cut, tokio::time::Instant::now());
    while live() < 15 && restored.elapsed() < PATIENCE {
        sent = send(&pair.payload, 1, Duration::from_millis(30)).await;
    }
    assert!(live() >= 15, "{} live of {} after the cut", live(), sent - at_cut);
    pair.station.complete(1, sent, PATIENCE).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_station_that_roams_stays_connected() {
    let pair = pair(Radio::default(), 5).await;
    for _ in 0..3 {
        send(&pair.payload, 20, Duration::from_millis(10)).await;
        pair.relay.roam();
    }
    let sent = send(&pair.payload, 100, Duration::from_millis(20)).await;
    pair.station.complete(1, sent, PATIENCE).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_station_restarted_in_mid_backfill_goes_on_where_it_was() {
    let keys = Keys::new();
    let payload = Payload::start(&payload_settings(keys.files(Role::Payload, "alpha"), loopback()), 1, None);
    // Slow enough that 3000 records of the past take a while.
    let slow = Radio { rate: Some(60e3), ..Radio::default() };
    let relay = Relay::start(payload.address, slow, 6);
    for _ in 0..3_000 {
        payload.send();
    }
    let settings = station_settings(keys.files(Role::Station, "base"), Some(relay.address));
    let first = Station::first(&settings);
    let some = within(PATIENCE, || first.of(1).times.len() > 200).await;
    assert!(some, "back-fill begins: {:?}", payload.handle.status());
    let got = first.vanish().await;
    let half = got.lock().expect("not poisoned")[&1].times.len();
    assert!(half < 3_000, "restarted in the middle");
    relay.set(|radio| radio.rate = None);
    let second = Station::start(&settings, got);
    second.complete(1, 3_000, PATIENCE).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_payload_restarted_in_mid_backfill_fills_from_its_store() {
    let keys = Keys::new();
    let settings = payload_settings(keys.files(Role::Payload, "alpha"), loopback());
    let old = card(1, 2_000);
    // Given: run 1 is on the card, run 2 is going on, and the station has got a part of both.
    let payload = Payload::start(&settings, 2, Some(Arc::clone(&old) as Arc<dyn Backlog>));
    let slow = Radio { rate: Some(40e3), ..Radio::default() };
    let relay = Relay::start(payload.address, slow, 7);
    let station = Station::first(&station_settings(keys.files(Role::Station, "base"), Some(relay.address)));
    let some = within(PATIENCE, || station.of(1).times.len() > 100).await;
    assert!(some, "back-fill begins: {:?}", payload.handle.status());
    // When: power fails, and the payload comes back as run 3 at the same port.
    let address = payload.address;
    payload.vanish().await;
    assert!(station.of(1).times.len() < 2_000, "restarted in the middle");
    relay.set(|radio| radio.rate = None);
    let again = payload_settings(keys.files(Role::Payload, "alpha"), Some(address));
    let free = within(PATIENCE, || std::net::UdpSocket::bind(address).is_ok()).await;
    assert!(free, "the port is still taken");
    let payload = Payload::start(&again, 3, Some(old as Arc<dyn Backlog>));
    let sent = send(&payload, 20, Duration::from_millis(10)).await;
    // Then: the old run is completed from the card, the new one is whole.
    station.complete(1, 2_000, PATIENCE).await;
    station.complete(3, sent, PATIENCE).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn both_sides_restarted_in_mid_backfill_end_up_the_same() {
    // Given: a run on the card, of which the station has got a part.
    let keys = Keys::new();
    let settings = payload_settings(keys.files(Role::Payload, "alpha"), loopback());
    let old = card(1, 2_000);
    let payload = Payload::start(&settings, 2, Some(Arc::clone(&old) as Arc<dyn Backlog>));
    let slow = Radio { rate: Some(40e3), ..Radio::default() };
    let relay = Relay::start(payload.address, slow, 9);
    let calls = station_settings(keys.files(Role::Station, "base"), Some(relay.address));
    let station = Station::first(&calls);
    let some = within(PATIENCE, || station.counts(1).0 > 100).await;
    assert!(some, "back-fill begins: {:?}", payload.handle.status());
    // When: both end without a goodbye and come back, the payload first.
    let address = payload.address;
    let got = station.vanish().await;
    payload.vanish().await;
    let half = got.lock().expect("not poisoned")[&1].times.len();
    assert!(half < 2_000, "restarted in the middle");
    relay.set(|radio| radio.rate = None);
    let free = within(PATIENCE, || std::net::UdpSocket::bind(address).is_ok()).await;
    assert!(free, "the port is still taken");
    let again = payload_settings(keys.files(Role::Payload, "alpha"), Some(address));
    let payload = Payload::start(&again, 3, Some(old as Arc<dyn Backlog>));
    let station = Station::start(&calls, got);
    let sent = send(&payload, 20, Duration::from_millis(10)).await;
    // Then: what the station had does not come again, the rest does.
    station.complete(1, 2_000, PATIENCE).await;
    station.complete(3, sent, PATIENCE).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_stations_each_get_everything_and_one_that_vanishes_hurts_nobody() {
    let keys = Keys::new();
    let payload = Payload::start(&payload_settings(keys.files(Role::Payload, "alpha"), loopback()), 1, None);
    let mut stations = Vec::new();
    for name in ["one", "two", "three", "four"] {
        let files = keys.files(Role::Station, name);
        stations.push(Station::first(&station_settings(files, Some(payload.address))));
    }
    let all = within(PATIENCE, || payload.handle.status().stations.len() == 4).await;
    assert!(all, "{:?}", payload.handle.status());
    let half = send(&payload, 30, Duration::from_millis(10)).await;
    stations.pop().expect("four stations").vanish().await;
    let sent = send(&payload, 30, Duration::from_millis(10)).await;
    assert!(half < sent);
    for station in &stations {
        station.complete(1, sent, PATIENCE).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_payload_behind_a_modem_calls_its_station() {
    let keys = Keys::new();
    let mut listening = station_settings(keys.files(Role::Station, "base"), None);
    listening.listen = loopback();
    let station = Station::first(&listening);
    let mut settings = payload_settings(keys.files(Role::Payload, "alpha"), None);
    settings.dial = vec![station.address.to_string()];
    let payload = Payload::start(&settings, 1, None);
    let sent = send(&payload, 30, Duration::from_millis(10)).await;
    station.complete(1, sent, PATIENCE).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_ceiling_is_obeyed_and_live_is_thinned_to_it() {
    let keys = Keys::new();
    let mut settings = payload_settings(keys.files(Role::Payload, "alpha"), loopback());
    settings.ceiling = Some(6_000.0);
    let payload = Payload::start(&settings, 1, None);
    let relay = Relay::start(payload.address, Radio::default(), 8);
    let station = Station::first(&station_settings(keys.files(Role::Station, "base"), Some(relay.address)));
    assert!(within(PATIENCE, || any(&station.events, is_up)).await, "no connection");
    tokio::time::sleep(Duration::from_secs(1)).await;
    let (before, started) = (relay.bytes_down(), tokio::time::Instant::now());
    // Ten times what fits, so that it is too much on a busy machine as well.
    let sent = send(&payload, 400, Duration::from_millis(4)).await as usize;
    // What QUIC adds by itself is taken into account a tenth of a second later.
    let allowed = 6_000.0 * (started.elapsed().as_secs_f64() + 0.1) + 1_228.0;
    let bytes = (relay.bytes_down() - before) as f64;
    assert!(bytes < allowed, "{bytes} bytes where {allowed} are allowed");
    let live = station.of(1).live_ms.len();
    assert!((10..sent / 2).contains(&live), "{live} of {sent} live: thinned, not stopped");
}
