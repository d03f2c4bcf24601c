//! The store from the outside: the command line, kill -9, other programs' readers.
#![expect(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::Arc;
use std::time::Duration;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use windhover::config::StoreConfig;
use windhover::io::capture::CaptureReader;
use windhover::io::clock::HostClock;
use windhover::io::records::{Record, Schema, topic};
use windhover::io::store::flight::{self, FLIGHTS, FlightInfo};
use windhover::io::store::summary::TopicStats;
use windhover::io::store::volume::Volume;
use windhover::io::store::{Store, StoreNotice};
use windhover_base::msg::{Event, EventBody, Source};

use crate::leave_out::leave_out;

fn windhover(root: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_windhover"))
        .args(["store", "--path"])
        .arg(root)
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn config(root: &Path) -> StoreConfig {
    let path = root.display().to_string();
    StoreConfig { path, free_floor_mb: 8, free_target_mb: 0, ..StoreConfig::default() }
}

/// Records `lines` GPS lines and as many numbered estimates as one closed flight.
fn record_flight(root: &Path, lines: u32) {
    let clock = HostClock::start();
    let (store, notices) = Store::start_on(Volume::new(root), &config(root), "[gps]\n".into(), clock);
    let handle = store.handle();
    while !matches!(notices.recv_timeout(Duration::from_secs(20)), Ok(StoreNotice::Started { .. })) {}
    for n in 0..lines {
        let t_recv = clock.now();
        handle.event(&Event {
            t_recv,
            seq: u64::from(n),
            body: EventBody::Bytes { source: Source::Gps, data: n.to_le_bytes().to_vec() },
        });
        let topic = topic::target_state("ugv").into();
        let data = windhover::io::proto::windhover::TargetState::default();
        let data = prost::Message::encode_to_vec(&data);
        let record =
            Record { topic, schema: Schema::TargetState, log_time: t_recv, publish_time: t_recv, data };
        handle.record(Arc::new(record), Some(n));
    }
    store.stop();
}

#[test]
fn the_command_line_tends_flights() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    record_flight(root, 30);
    record_flight(root, 20);
    // A stop waits half a second for the flight to be closed; on a busy machine repair does the rest.
    std::thread::sleep(Duration::from_millis(500));
    stdout(&windhover(root, &["repair"]));
    let list = stdout(&windhover(root, &["list"]));
    assert!(list.contains("boot-1") && list.contains("boot-2"), "{list}");
    let shown = stdout(&windhover(root, &["show", "boot-1", "--json"]));
    let shown: serde_json::Value = serde_json::from_str(&shown).unwrap();
    assert_eq!((shown["estimates"].as_u64(), shown["closed"].as_bool()), (Some(30), Some(true)));
    let shown = stdout(&windhover(root, &["show", "boot-2"]));
    assert!(shown.contains(" 10000 cycles lasts") && shown.contains("100000 cycles lasts"), "{shown}");
    stdout(&windhover(root, &["rebuild"]));
    let verified = windhover(root, &["verify"]);
    assert!(verified.status.success(), "{}", String::from_utf8_lossy(&verified.stdout));

    // After a kill, parts are unfinished and nothing is wrong: the flight is not closed, its last segment has no end
    // and half a chunk after its last complete one, and nothing of it is in the index yet.
    let cut = root.join(FLIGHTS).join("boot-2");
    let before = std::fs::read(cut.join("000000.mcap")).unwrap();
    let info = std::fs::read(cut.join(flight::FLIGHT_FILE)).unwrap();
    std::fs::remove_file(cut.join(flight::FLIGHT_FILE)).unwrap();
    let chunks_end = before.windows(9).rposition(|w| w == [0x0F, 4, 0, 0, 0, 0, 0, 0, 0]).unwrap();
    std::fs::write(cut.join("000000.mcap"), [&before[..chunks_end], &[6; 300]].concat()).unwrap();
    std::fs::remove_dir_all(root.join("index")).unwrap();
    let verified = windhover(root, &["verify"]);
    let words = String::from_utf8_lossy(&verified.stdout);
    assert!(verified.status.success() && words.contains("0 things wrong"), "{words}");
    assert!(words.contains("boot-2/000000.mcap: was cut off;") && words.contains("300 bytes"), "{words}");
    assert!(words.contains("boot-2: not closed") && words.contains("no index"), "{words}");
    assert!(words.contains("3 things unfinished"), "{words}");
    std::fs::write(cut.join("000000.mcap"), before).unwrap();
    std::fs::write(cut.join(flight::FLIGHT_FILE), info).unwrap();
    stdout(&windhover(root, &["rebuild"]));

    // A cut segment is found, sealed and complete again; nothing of its content is lost.
    let segment = root.join(FLIGHTS).join("boot-1/000000.mcap");
    let bytes = std::fs::read(&segment).unwrap();
    std::fs::write(&segment, &bytes[..bytes.len() - 20]).unwrap();
    let verified = windhover(root, &["verify"]);
    assert_eq!(verified.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&verified.stdout).contains("boot-1/000000.mcap: is not sealed"));
    assert!(stdout(&windhover(root, &["repair"])).contains("was cut off"));
    stdout(&windhover(root, &["verify", "boot-1"]));
    assert_eq!(CaptureReader::open(&root.join(FLIGHTS).join("boot-1")).unwrap().count(), 60);

    assert_eq!(windhover(root, &["delete", "boot-1"]).status.code(), Some(2), "asks, and nobody answers");
    stdout(&windhover(root, &["keep", "boot-1"]));
    assert_eq!(windhover(root, &["delete", "boot-1", "--yes"]).status.code(), Some(1), "it is kept");
    stdout(&windhover(root, &["keep", "--undo", "boot-1"]));
    stdout(&windhover(root, &["delete", "boot-1", "--yes"]));
    assert_eq!(flight::flight_names(root).unwrap(), ["boot-2"]);
    assert_eq!(windhover(root, &["show", "boot-9"]).status.code(), Some(1));
}

#[test]
fn a_thousand_flights_are_listed() {
    let dir = tempfile::tempdir().unwrap();
    let volume = Volume::new(dir.path());
    for session in 1..=1000 {
        let name = flight::create_flight(&volume, session, None).unwrap();
        let stats = TopicStats { count: 9, first_ns: 1, last_ns: 60_000_000_001, ..TopicStats::default() };
        let topics = [("/target/ugv/state".to_owned(), stats)].into();
        let info =
            FlightInfo { session, closed: true, segments: 1, bytes: 5, topics, ..FlightInfo::default() };
        let bytes = serde_json::to_vec(&info).unwrap();
        std::fs::write(dir.path().join(FLIGHTS).join(name).join(flight::FLIGHT_FILE), bytes).unwrap();
    }
    let list = stdout(&windhover(dir.path(), &["list"]));
    let lines: Vec<&str> = list.lines().collect();
    assert_eq!(lines.len(), 1001);
    assert!(lines[1].starts_with("boot-1 ") && lines[1000].starts_with("boot-1000 "), "in order of age");
}

/// The `mcap` package of a Python, where there is one.
fn python() -> Option<&'static str> {
    let has_mcap = |python: &&str| {
        let tried = Command::new(python).args(["-c", "import mcap"]).stderr(Stdio::null()).status();
        tried.is_ok_and(|status| status.success())
    };
    // The one `make test` sets up, or the system's.
    let own = concat!(env!("CARGO_MANIFEST_DIR"), "/target/venv/bin/python");
    [own, "python3"].into_iter().find(has_mcap)
}

#[test]
fn python_reads_what_was_cut_and_sealed() {
    let Some(python) = python() else {
        leave_out("a cut flight read by Python", "no Python with the mcap package (pip install mcap)");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    record_flight(dir.path(), 40);
    let segment = dir.path().join(FLIGHTS).join("boot-1/000000.mcap");
    let whole = std::fs::read(&segment).unwrap();
    let script = "
import sys
from mcap.reader import make_reader, NonSeekingReader
for make in (make_reader, NonSeekingReader):
    with open(sys.argv[1], 'rb') as f:
        print(sum(1 for _ in make(f, validate_crcs=True).iter_messages()))
with open(sys.argv[1], 'rb') as f:
    print([a.name for a in make_reader(f).iter_attachments()])
";
    let read = || {
        let output = Command::new(python).args(["-c", script]).arg(&segment).output().unwrap();
        stdout(&output)
    };
    assert_eq!(read(), "80\n80\n['config.toml']\n");
    std::fs::write(&segment, &whole[..whole.len() - 700]).unwrap();
    stdout(&windhover(dir.path(), &["repair"]));
    assert_eq!(read(), "80\n80\n['config.toml']\n");
    let mut holed = whole;
    holed[..4096].fill(0);
    std::fs::write(&segment, holed).unwrap();
    stdout(&windhover(dir.path(), &["repair"]));
    assert_eq!(read().lines().next(), Some("80"));
}

/// The recording program, built beside the tests.
fn recorder() -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    let target = tests.parent().and_then(Path::parent).unwrap();
    target.join("examples/store_load")
}

/// Numbers of GPS lines in all flights.
fn lines_kept(root: &Path) -> BTreeSet<u32> {
    let mut kept = BTreeSet::new();
    for name in flight::flight_names(root).unwrap() {
        let mut reader = CaptureReader::open(&root.join(FLIGHTS).join(name)).unwrap();
        for item in &mut reader {
            if let Some(EventBody::Bytes { source: Source::Gps, data: bytes }) = item.event.map(|e| e.body) {
                kept.extend(String::from_utf8_lossy(&bytes).get(7..15).and_then(|n| n.parse::<u32>().ok()));
            }
        }
        assert_eq!(reader.take_warnings(), Vec::<String>::new());
    }
    kept
}

/// Starts a recording, kills it after a random time, starts up again, and compares.
fn kill_once(seed: u64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let dir = tempfile::tempdir().unwrap();
    let mut child = Command::new(recorder())
        .arg(dir.path())
        .args(["--seconds", "60", "--fps", "0", "--floor-mb", "8", "--acks"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut output = BufReader::new(child.stdout.take().unwrap());
    let acks = std::thread::spawn(move || {
        let mut last = 0;
        let mut line = String::new();
        while output.read_line(&mut line).is_ok_and(|n| n > 0) {
            last = line.trim().strip_prefix("ack ").and_then(|n| n.parse().ok()).unwrap_or(last);
            line.clear();
        }
        last
    });
    std::thread::sleep(Duration::from_millis(random.random_range(10..4000)));
    child.kill().unwrap();
    child.wait().unwrap();
    let acknowledged: u32 = acks.join().unwrap();

    let clock = HostClock::start();
    let (store, notices) =
        Store::start_on(Volume::new(dir.path()), &config(dir.path()), String::new(), clock);
    loop {
        match notices.recv_timeout(Duration::from_secs(30)) {
            Ok(StoreNotice::IndexReady { .. }) => break,
            Ok(StoreNotice::Failed { reason } | StoreNotice::Stopped { reason }) => {
                panic!("seed {seed}: {reason}")
            }
            Ok(_) => {}
            Err(error) => panic!("seed {seed}: {error}"),
        }
    }
    let queued = store.handle().index().unwrap().queued_runs();
    store.stop();
    let kept = lines_kept(dir.path());
    let missing: Vec<u32> = (0..acknowledged).filter(|n| !kept.contains(n)).collect();
    assert!(missing.is_empty(), "seed {seed}: of {acknowledged} acknowledged lines {missing:?} are lost");
    // Estimates come at 15 a second against 20 lines: what was acknowledged of them is queued.
    let due = acknowledged * 15 / 20;
    assert!(
        due == 0 || queued.iter().any(|(_, first, end)| *first == 0 && *end + 1 >= due),
        "{queued:?} of {due}"
    );
}

fn kill_many(times: u64, first_seed: u64) {
    if !recorder().exists() {
        leave_out("kill -9", "the example store_load is not built");
        return;
    }
    std::thread::scope(|scope| {
        for lane in 0..4 {
            scope.spawn(move || (0..times / 4).for_each(|k| kill_once(first_seed + lane * 1000 + k)));
        }
    });
}

#[test]
fn kill_9_loses_nothing_acknowledged() {
    kill_many(20, 1);
}

#[test]
#[ignore = "200 runs take minutes: cargo test --release --test records -- --ignored kill_9_two_hundred"]
fn kill_9_two_hundred_times() {
    kill_many(200, 50_000);
}
