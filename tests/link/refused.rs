//! Refused peers, and the reports of both sides.

use std::time::Duration;

use tokio::net::UdpSocket;
use windhover::io::link::LinkEvent;
use windhover::io::link::keys::Role;
use windhover::io::link::tls::KeyFiles;
use windhover_base::time::UtcTime;

use crate::team::{
    Keys, Log, MADE, Payload, Station, any, loopback, payload_settings, station_settings, within,
};

const PATIENCE: Duration = Duration::from_secs(10);

fn refused(log: &Log, word: &str) -> bool {
    any(log, |event| matches!(event, LinkEvent::Refused { why, .. } if why.contains(word)))
}

/// Starts both, waits for the word in both logs, and checks that no record went over.
async fn both_say(payload_files: KeyFiles, station_files: KeyFiles, on_board: &str, on_ground: &str) {
    let payload = Payload::start(&payload_settings(payload_files, loopback()), 1, None);
    let station = Station::first(&station_settings(station_files, Some(payload.address)));
    for _ in 0..10 {
        payload.send();
    }
    let said = within(PATIENCE, || refused(&payload.events, on_board)).await;
    assert!(said, "on board: {:?}", payload.events);
    let said = within(PATIENCE, || refused(&station.events, on_ground)).await;
    assert!(said, "on the ground: {:?}", station.events);
    assert!(station.of(1).times.is_empty(), "records went to someone who was refused");
    assert!(payload.handle.status().refused >= 1 || !on_board.is_empty());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_station_of_a_foreign_authority() {
    let (ours, foreign) = (Keys::new(), Keys::new());
    let mut files = foreign.files(Role::Station, "base");
    // It trusts our payload, but its own certificate is signed elsewhere.
    files.authority = ours.authority.certificate_file();
    files.revoked = None;
    both_say(ours.files(Role::Payload, "alpha"), files, "certificate", "refused").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_payload_of_a_foreign_authority() {
    let (ours, foreign) = (Keys::new(), Keys::new());
    let payload = foreign.files(Role::Payload, "alpha");
    both_say(payload, ours.files(Role::Station, "base"), "refused", "certificate").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_expired_station() {
    let keys = Keys::new();
    let long_ago = UtcTime::from_unix_ns(MADE.unix_ns() - 4 * 365 * 86_400 * 1_000_000_000);
    keys.authority.issue(Role::Station, "old", 365, long_ago).expect("a station");
    let files = keys.files(Role::Station, "old");
    both_say(keys.files(Role::Payload, "alpha"), files, "expired", "expired").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_revoked_station() {
    let keys = Keys::new();
    let files = keys.files(Role::Station, "stolen");
    keys.authority.revoke(Role::Station, "stolen", MADE).expect("revoked");
    both_say(keys.files(Role::Payload, "alpha"), files, "revoked", "revoked").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_revoked_payload() {
    let keys = Keys::new();
    let files = keys.files(Role::Payload, "stolen");
    keys.authority.revoke(Role::Payload, "stolen", MADE).expect("revoked");
    both_say(files, keys.files(Role::Station, "base"), "revoked", "revoked").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_payload_that_calls_itself_a_station() {
    let keys = Keys::new();
    let files = keys.files(Role::Payload, "beta");
    let settings = station_settings(files, None);
    let recall = std::sync::Arc::new(|_: &str, _: &str, _: u32| Default::default());
    let error = windhover::io::link::StationLink::open(&settings, recall).err().expect("refused");
    assert!(error.to_string().contains("the certificate of a payload, not of a station"), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nobody_without_a_certificate() {
    let keys = Keys::new();
    let payload = Payload::start(&payload_settings(keys.files(Role::Payload, "alpha"), loopback()), 1, None);
    let mut roots = rustls::RootCertStore::empty();
    let pem = std::fs::read(keys.authority.certificate_file()).expect("the authority");
    use rustls::pki_types::pem::PemObject as _;
    roots.add(rustls::pki_types::CertificateDer::from_pem_slice(&pem).expect("PEM")).expect("a root");
    let provider = std::sync::Arc::new(rustls::crypto::ring::default_provider());
    let mut tls = rustls::ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("TLS 1.3")
        .with_root_certificates(roots)
        .with_no_client_auth();
    tls.alpn_protocols = vec![b"windhover/1".to_vec()];
    let quic = quinn::crypto::rustls::QuicClientConfig::try_from(tls).expect("QUIC");
    let mut endpoint = quinn::Endpoint::client(([127, 0, 0, 1], 0).into()).expect("a port");
    endpoint.set_default_client_config(quinn::ClientConfig::new(std::sync::Arc::new(quic)));
    let connecting = endpoint.connect(payload.address, "payload.windhover").expect("a call");
    if let Ok(connection) = connecting.await {
        let reason = connection.closed().await;
        assert!(reason.to_string().contains("certificate"), "{reason}");
    }
    assert!(
        within(PATIENCE, || refused(&payload.events, "no certificate")
            || refused(&payload.events, "certificate"))
        .await
    );
    assert!(payload.handle.status().stations.is_empty());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn noise_costs_nothing_and_a_station_still_gets_in() {
    let keys = Keys::new();
    let payload = Payload::start(&payload_settings(keys.files(Role::Payload, "alpha"), loopback()), 1, None);
    let noise = UdpSocket::bind("127.0.0.1:0").await.expect("a port");
    let mut state = 1_u32;
    for length in 0..1_400_usize {
        let bytes: Vec<u8> = (0..length)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect();
        noise.send_to(&bytes, payload.address).await.expect("sent");
    }
    let station = Station::first(&station_settings(keys.files(Role::Station, "base"), Some(payload.address)));
    let sent = payload.send() + 1;
    station.complete(1, sent, PATIENCE).await;
    assert_eq!(payload.handle.status().stations.len(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_station_revoked_in_flight_is_thrown_out() {
    let keys = Keys::new();
    let payload = Payload::start(&payload_settings(keys.files(Role::Payload, "alpha"), loopback()), 1, None);
    let station = Station::first(&station_settings(keys.files(Role::Station, "base"), Some(payload.address)));
    assert!(within(PATIENCE, || payload.handle.status().stations.len() == 1).await);
    keys.authority.revoke(Role::Station, "base", MADE).expect("revoked");
    let thrown_out = within(PATIENCE, || payload.handle.status().stations.is_empty()).await;
    // It connects again at once, and gets the reason.
    let has_reason = within(PATIENCE, || refused(&payload.events, "revoked")).await;
    assert!(thrown_out && has_reason, "{:?}", payload.events);
    assert!(keys.path().exists());
    drop(station);
}
