//! A payload and stations on loopback, and the records that the stations got.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::watch;
use windhover::io::clock::HostClock;
use windhover::io::link::keys::{Authority, Role};
use windhover::io::link::tls::KeyFiles;
use windhover::io::link::{
    Backlog, FromPayload, LinkEvent, LinkHandle, MemoryBacklog, PayloadLink, PayloadSettings, RangeSet,
    StationHandle, StationLink, StationSettings,
};
use windhover::io::records::{Record, Schema};
use windhover_base::time::{MonoTime, UtcTime};

/// 2026-11-19T00:00:00Z: when the tests' certificates are made.
pub const MADE: UtcTime = UtcTime::from_unix_ns(1_795_046_400_000_000_000);

/// An authority in a temporary directory.
pub struct Keys {
    pub dir: tempfile::TempDir,
    pub authority: Authority,
}

impl Keys {
    pub fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let authority = Authority::at(dir.path().join("keys"));
        authority.create("test", 3_650, MADE).expect("an authority");
        Self { dir, authority }
    }

    /// Files of a member, made when needed.
    pub fn files(&self, role: Role, name: &str) -> KeyFiles {
        let (certificate, key) = self.authority.member_files(role, name);
        if !certificate.exists() {
            self.authority.issue(role, name, 3_650, MADE).expect("a member");
        }
        KeyFiles {
            authority: self.authority.certificate_file(),
            certificate,
            key,
            revoked: Some(self.authority.revoked_file()),
        }
    }

    pub fn path(&self) -> &Path {
        self.dir.path()
    }
}

pub type Log = Arc<Mutex<Vec<LinkEvent>>>;

fn collect(mut events: tokio::sync::mpsc::Receiver<LinkEvent>) -> Log {
    let log = Log::default();
    let kept = Arc::clone(&log);
    tokio::spawn(async move {
        while let Some(event) = events.recv().await {
            kept.lock().expect("not poisoned").push(event);
        }
    });
    log
}

pub fn any(log: &Log, matches: impl Fn(&LinkEvent) -> bool) -> bool {
    log.lock().expect("not poisoned").iter().any(matches)
}

/// A state of 160 bytes, received and valid at `t`.
pub fn record(t: MonoTime) -> Record {
    Record {
        topic: "/target/ugv/state".into(),
        schema: Schema::TargetState,
        log_time: t,
        publish_time: t,
        data: vec![0x5a; 160],
    }
}

/// A run of so many records on what stands for the card.
pub fn card(run: u32, records: u32) -> Arc<MemoryBacklog> {
    let card = MemoryBacklog::new(run, format!("boot-{run}"), 256 << 20);
    for n in 0..records {
        card.append(Arc::new(record(MonoTime::from_ns(n.into()))));
    }
    Arc::new(card)
}

/// A running payload.
pub struct Payload {
    pub handle: LinkHandle,
    pub address: SocketAddr,
    pub events: Log,
    /// The payload runs while this lives.
    _stop: watch::Sender<bool>,
    task: tokio::task::JoinHandle<()>,
    clock: HostClock,
}

pub fn payload_settings(files: KeyFiles, listen: Option<SocketAddr>) -> PayloadSettings {
    PayloadSettings {
        files,
        listen,
        dial: Vec::new(),
        ceiling: None,
        thumbnails: None,
        thumbnail_width: 320,
        backlog_bytes: 64 << 20,
    }
}

pub fn loopback() -> Option<SocketAddr> {
    Some(([127, 0, 0, 1], 0).into())
}

impl Payload {
    pub fn start(settings: &PayloadSettings, run: u32, deep: Option<Arc<dyn Backlog>>) -> Self {
        let flight = format!("boot-{run}");
        let (link, handle, events) = PayloadLink::open(settings, run, &flight, deep).expect("a payload");
        let address = link.local_addr().expect("bound");
        let stop = watch::Sender::new(false);
        let task = tokio::spawn(link.run(stop.subscribe()));
        Self { handle, address, events: collect(events), _stop: stop, task, clock: HostClock::start() }
    }

    /// Sends one record of 160 bytes, as the estimator would; its log time is now.
    pub fn send(&self) -> u32 {
        self.handle.send(&record(self.clock.now())).expect("a record for the ground")
    }

    /// Ends without a goodbye, as in a power failure.
    pub async fn vanish(self) {
        self.task.abort();
        let _ = self.task.await;
    }
}

/// What a station got of a payload's run.
#[derive(Clone, Debug, Default)]
pub struct Got {
    /// How often each number came out.
    pub times: BTreeMap<u32, u32>,
    /// Milliseconds from the log time to the arrival of what came live.
    pub live_ms: Vec<f64>,
    /// Milliseconds since the station's start at which live records arrived.
    pub live_at_ms: Vec<f64>,
}

/// A running station; what it got outlives it.
pub struct Station {
    pub handle: StationHandle,
    pub address: SocketAddr,
    pub got: Arc<Mutex<BTreeMap<u32, Got>>>,
    pub events: Log,
    stop: watch::Sender<bool>,
    task: tokio::task::JoinHandle<()>,
}

pub fn station_settings(files: KeyFiles, dial: Option<SocketAddr>) -> StationSettings {
    StationSettings {
        files,
        listen: None,
        dial: dial.iter().map(ToString::to_string).collect(),
        thumbnails: true,
    }
}

impl Station {
    /// Starts with what an earlier life got (nothing, in a first).
    pub fn start(settings: &StationSettings, got: Arc<Mutex<BTreeMap<u32, Got>>>) -> Self {
        let kept = Arc::clone(&got);
        let recall = Arc::new(move |_: &str, _: &str, run: u32| {
            let mut set = RangeSet::new();
            if let Some(got) = kept.lock().expect("not poisoned").get(&run) {
                for number in got.times.keys() {
                    set.insert(*number);
                }
            }
            set
        });
        let (link, handle, mut records, events) = StationLink::open(settings, recall).expect("a station");
        let address = link.local_addr().expect("bound");
        let (into, clock, started) = (Arc::clone(&got), HostClock::start(), tokio::time::Instant::now());
        let acknowledge = handle.clone();
        tokio::spawn(async move {
            while let Some(message) = records.recv().await {
                let FromPayload::Record(arrival) = message else { continue };
                let mut got = into.lock().expect("not poisoned");
                let got = got.entry(arrival.run).or_default();
                *got.times.entry(arrival.number).or_default() += 1;
                if arrival.live {
                    let late = clock.now() - arrival.log_time;
                    got.live_ms.push(late.ms());
                    got.live_at_ms.push(started.elapsed().as_secs_f64() * 1e3);
                }
                let one = RangeSet::of(arrival.number, arrival.number + 1);
                acknowledge.stored(&arrival.payload, arrival.run, &one);
            }
        });
        let stop = watch::Sender::new(false);
        let task = tokio::spawn(link.run(stop.subscribe()));
        Self { handle, address, got, events: collect(events), stop, task }
    }

    pub fn first(settings: &StationSettings) -> Self {
        Self::start(settings, Arc::default())
    }

    pub async fn vanish(self) -> Arc<Mutex<BTreeMap<u32, Got>>> {
        self.task.abort();
        let _ = self.task.await;
        // What was received a moment ago still reaches the collector.
        tokio::time::sleep(Duration::from_millis(50)).await;
        self.got
    }

    pub async fn stop(self) {
        self.stop.send_replace(true);
        let _ = self.task.await;
    }

    pub fn of(&self, run: u32) -> Got {
        self.got.lock().expect("not poisoned").get(&run).cloned().unwrap_or_default()
    }

    /// How many numbers of a run came, and how many records of it live.
    pub fn counts(&self, run: u32) -> (usize, usize) {
        let got = self.got.lock().expect("not poisoned");
        got.get(&run).map_or((0, 0), |got| (got.times.len(), got.live_ms.len()))
    }

    /// Waits until numbers 0 to `count` − 1 of a run are there, each once.
    pub async fn complete(&self, run: u32, count: u32, patience: Duration) {
        let waited = within(patience, || self.counts(run).0 as u32 >= count).await;
        let got = self.of(run);
        assert!(
            waited,
            "{} of {count} records after {patience:?}; {:?}",
            got.times.len(),
            self.handle.status()
        );
        assert!(got.times.keys().copied().eq(0..count), "other numbers than were sent");
        let twice = got.times.iter().find(|(_, times)| **times != 1);
        assert_eq!(twice, None, "nothing comes twice");
    }
}

/// Whether something becomes true in time.
pub async fn within(patience: Duration, mut what: impl FnMut() -> bool) -> bool {
    let deadline = tokio::time::Instant::now() + patience;
    while !what() {
        if tokio::time::Instant::now() > deadline {
            return false;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    true
}
