//! Proof of the wireless link over an impaired relay: cuts, loss, a line too slow, ten stations.
//!
//! `cargo bench --bench link` runs every case in about six minutes and prints how late live records were
//! and whether all arrived once; `cargo bench --bench link -- cut25 slow` runs those named.

#[path = "../tests/link/relay.rs"]
#[expect(dead_code, reason = "the tests use the rest")]
mod relay;
#[path = "../tests/link/team.rs"]
#[expect(dead_code, reason = "shared with the tests, which use more of it")]
mod team;

use std::time::Duration;

use relay::{Radio, Relay};
use team::{Got, Keys, Payload, Station, loopback, payload_settings, station_settings};
use windhover::io::link::keys::Role;

/// One-way delay of the relay, ms.
const DELAY_MS: f64 = 20.0;
const EVERY: Duration = Duration::from_nanos(33_333_333);

fn radio() -> Radio {
    Radio { delay: Duration::from_millis(DELAY_MS as u64), ..Radio::default() }
}

struct Bench {
    _keys: Keys,
    payload: Payload,
    relay: Relay,
    stations: Vec<Station>,
}

async fn start(radio: Radio, stations: usize) -> Bench {
    let keys = Keys::new();
    let payload = Payload::start(&payload_settings(keys.files(Role::Payload, "alpha"), loopback()), 1, None);
    let relay = Relay::start(payload.address, radio, 42).await;
    let mut up = Vec::new();
    for n in 0..stations {
        let files = keys.files(Role::Station, &format!("station-{n}"));
        up.push(Station::first(&station_settings(files, Some(relay.address))));
    }
    while payload.handle.status().stations.len() < stations {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    tokio::time::sleep(Duration::from_secs(2)).await;
    Bench { _keys: keys, payload, relay, stations: up }
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
        let missing = |s: &Station| (sent as usize).saturating_sub(s.of(1).times.len());
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
        late.sort_by(f64::total_cmp);
        let at = |q: f64| late.get(((late.len() as f64 - 1.0) * q) as usize).copied().unwrap_or(f64::NAN);
        println!(
            "{name:10} {sent:6} sent, {live:6} live; later than the line's {DELAY_MS} ms: p50 {:6.1} p99 {:6.1} \
             max {:6.1} ms; missing {missing}, twice {twice}, complete {seconds:.1} s after the last",
            at(0.5),
            at(0.99),
            at(1.0)
        );
    }

    async fn cut(&self, seconds: u64) {
        self.send(5.0).await;
        self.relay.set(|radio| radio.cut = true);
        self.send(seconds as f64).await;
        let before = self.stations[0].of(1).live_ms.len();
        let restored = tokio::time::Instant::now();
        self.relay.set(|radio| radio.cut = false);
        let first = async {
            while self.stations[0].of(1).live_ms.len() == before {
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

async fn case(name: &str) {
    match name {
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
    let all = ["clear", "loss10", "loss30", "cut6", "cut25", "cut120", "slow", "ten"];
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
