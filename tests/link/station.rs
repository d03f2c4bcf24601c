//! The whole receiving station: flights on disk, page, feeds.

use std::net::SocketAddr;
use std::time::Duration;

use prost::Message as _;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use windhover::app::ground::{self, CotKeys, GroundSettings, mirror};
use windhover::io::link::keys::Role;
use windhover::io::proto::{timestamp, windhover as wh};
use windhover::io::records::{Record, Schema};
use windhover_base::time::MonoTime;

use crate::team::{Keys, Payload, loopback, payload_settings, station_settings};

const PATIENCE: Duration = Duration::from_secs(15);

/// A free TCP port; another program might take it before the station does, but none of ours.
fn free_port() -> SocketAddr {
    std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a port")
}

async fn ask(address: SocketAddr, path: &str, headers: &str) -> String {
    let mut stream = TcpStream::connect(address).await.expect("the page's port");
    let request = format!("GET {path} HTTP/1.1\r\nConnection: close\r\n{headers}\r\n");
    stream.write_all(request.as_bytes()).await.expect("sent");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.expect("an answer");
    String::from_utf8_lossy(&answer).into_owned()
}

async fn eventually(address: SocketAddr, path: &str, headers: &str, word: &str) -> bool {
    let deadline = tokio::time::Instant::now() + PATIENCE;
    while tokio::time::Instant::now() < deadline {
        if TcpStream::connect(address).await.is_ok() && ask(address, path, headers).await.contains(word) {
            return true;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    false
}

fn state(n: i64) -> Record {
    let t = MonoTime::from_ns(1_795_046_400_000_000_000 + n * 66_666_667);
    let state = wh::TargetState {
        timestamp: Some(timestamp(t)),
        target: "ugv".into(),
        status: wh::TrackStatus::Tracking.into(),
        known: true,
        lat_deg: 30.0 + n as f64 * 1e-6,
        lon_deg: -85.0,
        covariance: vec![0.01; 15],
        ..Default::default()
    };
    Record {
        topic: "/target/ugv/state".into(),
        schema: Schema::TargetState,
        log_time: t,
        publish_time: t,
        data: state.encode_to_vec(),
    }
}

/// A station with a page whose payload never answers.
fn alone(keys: &Keys, web: SocketAddr) -> GroundSettings {
    GroundSettings {
        link: station_settings(keys.files(Role::Station, "base"), Some(([127, 0, 0, 1], 9).into())),
        out: keys.path().join("out"),
        web: Some(web),
        open: false,
        token: None,
        tiles: None,
        position: None,
        nmea: None,
        cot: Vec::new(),
        cot_keys: CotKeys::default(),
        foxglove: None,
        #[cfg(feature = "zenoh")]
        zenoh: None,
        #[cfg(feature = "zenoh")]
        ros: None,
        terminal: false,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_station_keeps_shows_and_feeds_what_it_receives() {
    let keys = Keys::new();
    let payload = Payload::start(&payload_settings(keys.files(Role::Payload, "alpha"), loopback()), 7, None);
    let (web, nmea) = (free_port(), free_port());
    let out = keys.path().join("out");
    let settings = GroundSettings {
        link: station_settings(keys.files(Role::Station, "base"), Some(payload.address)),
        nmea: Some(nmea),
        ..alone(&keys, web)
    };
    let stop = tokio::sync::watch::Sender::new(false);
    let running = tokio::spawn(ground::run(settings, stop.subscribe()));
    for n in 0..40 {
        payload.handle.send(&state(n)).expect("for the ground");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let local = "Host: 127.0.0.1\r\n";
    assert!(eventually(web, "/vehicles.geojson", local, "30.000039").await, "the last position in GeoJSON");
    assert!(ask(web, "/", local).await.contains("<title>windhover</title>"));
    assert!(ask(web, "/vehicles.kml", local).await.contains("ugv (alpha)"));
    assert!(ask(web, "/", "Host: evil.example\r\n").await.starts_with("HTTP/1.1 403"));
    let foreign = ask(web, "/live", &format!("{local}Origin: http://evil.example\r\n")).await;
    assert!(foreign.starts_with("HTTP/1.1 403"), "{foreign}");
    assert!(ask(web, "/tiles/..%2f/1/1", local).await.starts_with("HTTP/1.1 4"), "no way out of a folder");
    // NMEA: states that are new after the client came, which it does at a time of its own.
    let mut plotter = TcpStream::connect(nmea).await.expect("the NMEA port");
    let (mut sentence, mut read, mut sent) = (vec![0; 120], None, 40);
    while read.is_none() && sent < 200 {
        payload.handle.send(&state(sent)).expect("for the ground");
        sent += 1;
        let soon = tokio::time::timeout(Duration::from_millis(300), plotter.read(&mut sentence)).await;
        read = soon.ok().map(|read| read.expect("read"));
    }
    assert!(sentence.starts_with(b"$GPRMC,"), "{read:?} bytes after {sent} states");
    // What the live datagrams missed is filled in; when the station ends, everything is on disk, once.
    let stored = || mirror::recall(&out, "alpha", "boot-7", 7).iter().collect::<Vec<_>>();
    let whole = [(0, u32::try_from(sent).expect("small"))];
    for _ in 0..150 {
        if stored() == whole {
            break;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    stop.send_replace(true);
    running.await.expect("no panic").expect("no error");
    assert_eq!(stored(), whole);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_page_beyond_loopback_asks_for_its_token() {
    let keys = Keys::new();
    let web: SocketAddr = ([0, 0, 0, 0], free_port().port()).into();
    let settings = GroundSettings { token: Some("open-sesame".into()), ..alone(&keys, web) };
    let stop = tokio::sync::watch::Sender::new(false);
    let running = tokio::spawn(ground::run(settings, stop.subscribe()));
    let reach: SocketAddr = ([127, 0, 0, 1], web.port()).into();
    let host = "Host: station.example\r\n";
    assert!(eventually(reach, "/?token=open-sesame", host, "<title>").await);
    for (path, headers) in [("/", host), ("/?token=wrong", host), ("/live", host), ("/vehicles.kml", host)] {
        assert!(ask(reach, path, headers).await.starts_with("HTTP/1.1 401"), "{path}");
    }
    let cookie = format!("{host}Cookie: windhover=open-sesame\r\n");
    assert!(ask(reach, "/app.js", &cookie).await.starts_with("HTTP/1.1 200"));
    stop.send_replace(true);
    running.await.expect("no panic").expect("no error");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bytes_that_are_no_request_leave_the_page_as_it_was() {
    use rand::{Rng as _, SeedableRng as _};
    let keys = Keys::new();
    let web = free_port();
    let settings = GroundSettings { tiles: Some(keys.path().join("tiles")), ..alone(&keys, web) };
    let stop = tokio::sync::watch::Sender::new(false);
    let running = tokio::spawn(ground::run(settings, stop.subscribe()));
    let local = "Host: 127.0.0.1\r\n";
    assert!(eventually(web, "/", local, "<title>").await);
    let seed = 20_261_125;
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let paths = ["/", "/live", "/thumbnail/", "/tiles/", "/vehicles.geojson", "/network.kml?token="];
    for round in 0..300 {
        // Noise as it is, as a path, as a header, as a WebSocket's frames.
        let noise: Vec<u8> = (0..random.random_range(0..200)).map(|_| random.random()).collect();
        let path = paths[random.random_range(0..paths.len())].as_bytes();
        let upgrade = b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
                        Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n";
        let host = local.as_bytes();
        let request = match round % 4 {
            0 => noise,
            1 => [b"GET ", path, &noise, b" HTTP/1.1\r\n", host, b"\r\n"].concat(),
            2 => [b"GET ", path, b" HTTP/1.1\r\nCookie: windhover=", &noise, b"\r\n", host, b"\r\n"].concat(),
            _ => [b"GET /live HTTP/1.1\r\n", host, upgrade, &noise].concat(),
        };
        let mut stream = TcpStream::connect(web).await.expect("the page's port");
        // The station may close before it has read everything.
        let _ = stream.write_all(&request).await;
        let _ = stream.shutdown().await;
        let mut answer = [0; 12];
        if let Ok(Ok(read)) = tokio::time::timeout(PATIENCE, stream.read(&mut answer)).await {
            let answer = &answer[..read];
            assert!(!answer.starts_with(b"HTTP/1.1 5"), "seed {seed}, round {round}: an error of ours");
        }
    }
    assert!(ask(web, "/", local).await.contains("<title>windhover</title>"));
    stop.send_replace(true);
    running.await.expect("no panic").expect("no error");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn connections_that_say_nothing_keep_nobody_out() {
    let keys = Keys::new();
    let (web, nmea) = (free_port(), free_port());
    let stop = tokio::sync::watch::Sender::new(false);
    let settings = GroundSettings { nmea: Some(nmea), ..alone(&keys, web) };
    let running = tokio::spawn(ground::run(settings, stop.subscribe()));
    let local = "Host: 127.0.0.1\r\n";
    assert!(eventually(web, "/", local, "<title>windhover</title>").await);
    // Given more connections than there are places, at both ports, that are only opened.
    let mut open = Vec::new();
    for _ in 0..300 {
        for port in [web, nmea] {
            open.push(TcpStream::connect(port).await);
        }
    }
    // Then the page answers, at once and again; and when they are gone, the other port takes plotters again.
    for _ in 0..3 {
        assert!(ask(web, "/", local).await.contains("<title>windhover</title>"));
    }
    drop(open);
    let mut stays = false;
    for _ in 0..100 {
        let mut plotter = TcpStream::connect(nmea).await.expect("the NMEA port");
        // One that is turned away is closed at once.
        let closed = tokio::time::timeout(Duration::from_millis(100), plotter.read(&mut [0; 1])).await;
        stays = closed.is_err();
        if stays {
            break;
        }
    }
    assert!(stays, "the NMEA port takes no plotter any more");
    stop.send_replace(true);
    running.await.expect("no panic").expect("a clean end");
}
