//! A payload whose connection ends otherwise than by a clear goodbye.

use std::sync::Arc;
use std::time::Duration;

use windhover::io::link::keys::Role;
use windhover::io::link::tls::Identity;

use crate::team::{Keys, Station, station_settings};

/// Less than a station waits after another program of the same name took over.
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
        // Then: the station does not take that for another program's taking over, and calls again.
        let called = tokio::time::timeout(PATIENCE, calls).await;
        let call = called.unwrap_or_else(|_| panic!("no call after {time}"));
        // When: the control stream ends.
        let (mut out, _) = call.accept_bi().await.expect("the control stream");
        out.finish().expect("open until now");
        kept.push(call);
    }
}
