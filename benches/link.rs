//! Proof of the wireless link over an impaired relay: cuts, loss, a line too slow, ten stations, an hour's cut.
//!
//! `cargo bench --bench link` runs every case in about seven minutes and prints the lateness of live records and
//! whether all arrived once; `cargo bench --bench link -- cut25 slow` runs the named ones. Each case has a floor: the
//! lateness of bare UDP datagrams at 30 a second through a relay of the same delay in the same run, which is the part
//! of machine and harness.

#[path = "../tests/link/relay.rs"]
#[expect(dead_code, reason = "the tests use the rest")]
mod relay;
#[path = "../tests/link/team.rs"]
#[expect(dead_code, reason = "shared with the tests, which use more of it")]
mod team;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use relay::{Radio, Relay};
use team::{Got, Keys, Payload, Station, card, loopback, payload_settings, station_settings};
use windhover::io::link::Backlog;
use windhover::io::link::keys::Role;

/// One-way delay of the relay, ms.
const DELAY_MS: f64 = 20.0;
const EVERY: Duration = Duration::from_nanos(33_333_333);

fn radio() -> Radio {
    Radio { delay: Duration::from_millis(DELAY_MS as u64), ..Radio::default() }
}

/// Bare datagrams through a relay, and their lateness beyond its delay, ms.
struct Floor {
    late_ms: Arc<Mutex<Vec<f64>>>,
    stopped: Arc<AtomicBool>,
}

impl Floor {
    fn start() -> Self {
        let floor = Self { late_ms: Arc::default(), stopped: Arc::default() };
        let port = || std::net::UdpSocket::bind("127.0.0.1:0").expect("a loopback port");
        let (near, far, began) = (port(), port(), Instant::now());
        let relay = Relay::start(far.local_addr().expect("bound"), radio(), 7);
        near.connect(relay.address).expect("loopback");
        far.set_read_timeout(Some(Duration::from_millis(200))).expect("a time-out above zero");
        let stopped = Arc::clone(&floor.stopped);
        std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                std::thread::sleep(EVERY);
                let sent = began.elapsed().as_nanos() as u64;
                let _ = near.send(&sent.to_le_bytes());
            }
        });
        let (stopped, late_ms) = (Arc::clone(&floor.stopped), Arc::clone(&floor.late_ms));
        std::thread::spawn(move || {
            let (mut stamp, _relay) = ([0; 8], relay);
            while !stopped.load(Ordering::Relaxed) {
                if far.recv(&mut stamp).is_ok() {
                    let passed = began.elapsed().as_nanos() as u64 - u64::from_le_bytes(stamp);
                    late_ms.lock().expect("not poisoned").push(passed as f64 * 1e-6 - DELAY_MS);
                }
            }
        });
        floor
    }
}

impl Drop for Floor {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
    }
}

/// Median, 99th percentile and maximum.
fn spread(mut ms: Vec<f64>) -> [f64; 3] {
    ms.sort_by(f64::total_cmp);
    let at = |q: f64| ms.get(((ms.len() as f64 - 1.0) * q) as usize).copied().unwrap_or(f64::NAN);
    [at(0.5), at(0.99), at(1.0)]
}

struct Bench {
    _keys: Keys,
    payload: Payload,
    relay: Relay,
    stations: Vec<Station>,
    floor: Floor,
}

async fn start(radio: Radio, stations: usize) -> Bench {
    start_with(radio, stations, 64 << 20, None).await
}

async fn start_with(radio: Radio, stations: usize, memory: usize, card: Option<Arc<dyn Backlog>>) -> Bench {
    let keys = Keys::new();
    let mut settings = payload_settings(keys.files(Role::Payload, "alpha"), loopback());
    settings.backlog_bytes = memory;
    let payload = Payload::start(&settings, 1, card);
    let relay = Relay::start(payload.address, radio, 42);
    let mut up = Vec::new();
    for n in 0..stations {
        let files = keys.files(Role::Station, &format!("station-{n}"));
        up.push(Station::first(&station_settings(files, Some(relay.address))));
    }
    while payload.handle.status().stations.len() < stations {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    tokio::time::sleep(Duration::from_secs(2)).await;
    Bench { _keys: keys, payload, relay, stations: up, floor: Floor::start() }
}

impl Bench {
    /// Sends at 30 Hz, on time however long a send takes.
    async fn send(&self, seconds: f64) -> u32 {
        let mut tick = tokio::time::interval(EVERY);
        let mut next = 0;
        for _ in 0..(seconds * 30.0) as u32 {
            tick.tick().await;
            next = self.payload.send() + 1;
        }
        next
    }

    async fn settle(&self, sent: u32, patience_s: u64) -> (f64, usize, usize) {
        let began = tokio::time::Instant::now();
        let missing = |s: &Station| (sent as usize).saturating_sub(s.counts(1).0);
        while self.stations.iter().any(|s| missing(s) > 0) && began.elapsed().as_secs() < patience_s {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let twice = |s: &Station| s.of(1).times.values().filter(|times| **times > 1).count();
        (
            began.elapsed().as_secs_f64(),
            self.stations.iter().map(missing).sum(),
            self.stations.iter().map(twice).sum(),
        )
    }

    fn report(&self, name: &str, sent: u32, (seconds, missing, twice): (f64, usize, usize)) {
        let mut late: Vec<f64> = Vec::new();
        let mut live = 0;
        for station in &self.stations {
            let got: Got = station.of(1);
            live += got.live_ms.len();
            late.extend(got.live_ms.iter().map(|ms| ms - DELAY_MS));
        }
        let floor = spread(self.floor.late_ms.lock().expect("not poisoned").clone());
        let [p50, p99, most] = spread(late);
        println!(
            "{name:10} {sent:6} sent, {live:6} live; ms beyond the line's {DELAY_MS}: p50 {p50:5.1} p99 {p99:5.1} \
             max {most:5.1}; bare UDP p50 {:4.1} p99 {:4.1} max {:4.1}; missing {missing}, twice {twice}, \
             complete {seconds:.1} s after the last",
            floor[0], floor[1], floor[2]
        );
    }

    async fn cut(&self, seconds: u64) {
        self.send(5.0).await;
        self.relay.set(|radio| radio.cut = true);
        self.send(seconds as f64).await;
        let before = self.stations[0].counts(1).1;
        let restored = tokio::time::Instant::now();
        self.relay.set(|radio| radio.cut = false);
        let first = async {
            while self.stations[0].counts(1).1 == before {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            restored.elapsed().as_secs_f64() * 1e3
        };
        let (sent, first) = tokio::join!(self.send(10.0), first);
        let outcome = self.settle(sent, 120).await;
        self.report(&format!("cut{seconds}"), sent, outcome);
        println!("           first live record {first:.0} ms after the cut ended");
    }
}

/// Memory of this process that is resident, bytes.
fn resident() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<usize>().ok());
    kib.unwrap_or(0) << 10
}

/// An hour's cut in simulated time: 31 records a second for an hour as fast as they can be made, a second of them every
/// millisecond. The card has all records, memory a part of them.
async fn hour() {
    const SECONDS: u32 = 3_600;
    const A_SECOND: u32 = 31;
    const MEMORY: usize = 4 << 20;
    let whole = card(1, SECONDS * A_SECOND + 300);
    let bench = start_with(radio(), 1, MEMORY, Some(whole)).await;
    bench.relay.set(|radio| radio.cut = true);
    let before = resident();
    for _ in 0..SECONDS {
        for _ in 0..A_SECOND {
            bench.payload.send();
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let held = bench.payload.handle.status().backlog_bytes;
    println!(
        "hour       memory for back-fill {:.1} MB of {:.1} allowed; the process grew by {:.1} MB",
        held as f64 * 1e-6,
        MEMORY as f64 * 1e-6,
        resident().saturating_sub(before) as f64 * 1e-6
    );
    bench.relay.set(|radio| radio.cut = false);
    let sent = bench.send(10.0).await;
    let outcome = bench.settle(sent, 300).await;
    bench.report("hour", sent, outcome);
}

async fn case(name: &str) {
    match name {
        "hour" => hour().await,
        "clear" | "loss10" | "loss30" => {
            let loss = match name {
                "loss10" => 0.1,
                "loss30" => 0.3,
                _ => 0.0,
            };
            let bench = start(Radio { loss, ..radio() }, 1).await;
            let sent = bench.send(30.0).await;
            let outcome = bench.settle(sent, 60).await;
            bench.report(name, sent, outcome);
        }
        "cut6" | "cut25" | "cut120" => {
            let bench = start(radio(), 1).await;
            bench.cut(name[3..].parse().unwrap_or(6)).await;
        }
        "slow" => {
            let bench = start(Radio { rate: Some(6_000.0), ..radio() }, 1).await;
            let sent = bench.send(30.0).await;
            bench.report("48 kbit/s", sent, (0.0, 0, 0));
            bench.relay.set(|radio| radio.rate = None);
            let outcome = bench.settle(sent, 60).await;
            bench.report("widened", sent, outcome);
        }
        "ten" => {
            let bench = start(radio(), 10).await;
            let sent = bench.send(30.0).await;
            let outcome = bench.settle(sent, 60).await;
            bench.report("ten", sent, outcome);
        }
        other => eprintln!("no case {other:?}"),
    }
}

fn main() {
    let all = ["clear", "loss10", "loss30", "cut6", "cut25", "cut120", "slow", "ten", "hour"];
    let named: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .expect("a runtime needs threads and an epoll handle");
    for name in all.iter().filter(|name| named.is_empty() || named.iter().any(|n| n == *name)) {
        runtime.block_on(case(name));
    }
}
