//! The whole store on a directory: items in, files out; a failing card stops nothing else.

use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use super::flight::{self, FLIGHTS};
use super::journal::Journal;
use super::volume::Volume;
use super::{Recording, Store, StoreHandle, StoreNotice};
use crate::config::{FramePolicy, StoreConfig};
use crate::io::capture::CaptureReader;
use crate::io::clock::HostClock;
use crate::io::records::{Record, Schema, topic};
use windhover_base::msg::{Event, EventBody, FrameEncoding, FramePayload, Source};
use windhover_base::time::{Span, UtcTime};

fn gps(clock: &HostClock, seq: u64) -> Event {
    Event {
        t_recv: clock.now(),
        seq,
        body: EventBody::Bytes { source: Source::Gps, data: format!("$GPGGA,{seq}\r\n").into_bytes() },
    }
}

fn frame(clock: &HostClock, index: u32) -> Event {
    let t = clock.now();
    let payload = FramePayload {
        index,
        t_exposure: t,
        encoding: FrameEncoding::Grey,
        width: 64,
        height: 48,
        stride: 64,
        data: Arc::from(vec![index as u8; 64 * 48]),
    };
    Event { t_recv: t, seq: u64::from(index), body: EventBody::Frame(payload) }
}

fn estimate(clock: &HostClock, n: u32) -> Arc<Record> {
    let now = clock.now();
    Arc::new(Record {
        topic: topic::target_state("ugv").into(),
        schema: Schema::TargetState,
        log_time: now,
        publish_time: now,
        data: n.to_le_bytes().to_vec(),
    })
}

fn config(path: &Path) -> StoreConfig {
    let free_target_mb = 0;
    StoreConfig {
        path: path.display().to_string(),
        free_floor_mb: 8,
        free_target_mb,
        ..StoreConfig::default()
    }
}

/// Waits for a notice of this name, up to ten seconds.
fn expect_notice(notices: &Receiver<StoreNotice>, name: &str) -> StoreNotice {
    loop {
        match notices.recv_timeout(Duration::from_secs(10)) {
            Ok(notice) if notice.name() == name => return notice,
            Ok(_) => {}
            Err(error) => panic!("no notice {name}: {error}"),
        }
    }
}

/// Waits until the card has had this many commits, up to ten seconds.
fn wait_for_commits(handle: &StoreHandle, times: usize) {
    let mut last = handle.status().last_commit_ns;
    let mut seen = 0;
    for _ in 0..1000 {
        let now = handle.status().last_commit_ns;
        seen += usize::from(now != last);
        last = now;
        if seen == times {
            return;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    panic!("no commit in ten seconds: {:?}", handle.status());
}

fn events_of(dir: &Path) -> (Vec<Vec<u8>>, u32) {
    let (mut lines, mut frames) = (Vec::new(), 0);
    let mut reader = CaptureReader::open(dir).unwrap();
    for item in &mut reader {
        match item.event.map(|e| e.body) {
            Some(EventBody::Bytes { source: Source::Gps, data: bytes }) => lines.push(bytes),
            Some(EventBody::Frame(_)) => frames += 1,
            _ => {}
        }
    }
    assert_eq!(reader.take_warnings(), Vec::<String>::new());
    (lines, frames)
}

#[test]
fn a_flight_is_recorded_named_and_read_again() {
    let dir = tempfile::tempdir().unwrap();
    let clock = HostClock::start();
    let volume = Volume::new(dir.path());
    let (store, notices) = Store::start_on(volume.clone(), &config(dir.path()), "[gps]\n".into(), clock);
    let handle = store.handle();
    assert_eq!(handle.run(), 1);
    for n in 0..40 {
        handle.event(&gps(&clock, n));
        handle.event(&frame(&clock, n as u32));
        handle.record(estimate(&clock, n as u32), Some(n as u32));
    }
    handle.put_state("datum", vec![1, 2, 3]);
    assert!(!handle.set_start(UtcTime::from_unix_ns(315_532_800_000_000_000)), "1980 is not accepted");
    assert!(handle.set_start(UtcTime::from_unix_ns(1_795_000_000_000_000_000)));
    expect_notice(&notices, "flight_named");
    store.stop();

    let name = "20261118T110640Z";
    assert_eq!(flight::flight_names(dir.path()).unwrap(), [name]);
    let (lines, frames) = events_of(&dir.path().join(FLIGHTS).join(name));
    assert_eq!((lines.len(), frames), (40, 40));
    assert_eq!(lines[39], b"$GPGGA,39\r\n");
    let info = flight::flight_info(dir.path(), name).unwrap();
    assert!(info.closed);
    assert_eq!(info.estimates().unwrap().count, 40);

    // The next run finds state and queue of the previous one.
    let (store, _notices) = Store::start_on(volume, &config(dir.path()), String::new(), clock);
    let handle = store.handle();
    assert_eq!(handle.run(), 2);
    assert_eq!(handle.state("datum", Duration::from_secs(5)), Some(vec![1, 2, 3]));
    let index = handle.index().unwrap();
    assert_eq!(index.queued_runs(), [(1, 0, 40)]);
    let (number, record) = index.queued(1, 7, 8).next().unwrap().unwrap();
    assert_eq!(
        (number, &record.data[..], &record.topic[..]),
        (7, &7u32.to_le_bytes()[..], "/target/ugv/state")
    );

    // The link reads them as its backlog: as many as fit, from the requested number on.
    let backlog: &dyn crate::io::link::Backlog = &handle;
    let extents = backlog.extents();
    assert_eq!((extents[0].run, extents[0].first, extents[0].end, &extents[0].flight[..]), (1, 0, 40, name));
    let read = backlog.read(1, 38, 99, 10_000).unwrap();
    assert_eq!(read.iter().map(|(n, _)| *n).collect::<Vec<_>>(), [38, 39]);
    assert_eq!(read[0].1.schema, Schema::TargetState);
    assert_eq!(backlog.read(1, 0, 40, 1).unwrap().len(), 1);
    store.stop();
}

#[test]
fn a_failing_card_stops_recording_loudly_and_it_resumes() {
    for (fault, free) in [
        (Some(std::io::ErrorKind::StorageFull), None),
        (Some(std::io::ErrorKind::ReadOnlyFilesystem), None),
        (Some(std::io::ErrorKind::PermissionDenied), None),
        (Some(std::io::ErrorKind::Other), None),
        (None, Some(1 << 20)),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let clock = HostClock::start();
        let journal = Arc::new(Journal::default());
        let volume = Volume::journaled(dir.path(), Arc::clone(&journal));
        let (store, notices) = Store::start_on(volume, &config(dir.path()), "[gps]\n".into(), clock);
        let handle = store.handle();
        expect_notice(&notices, "recording_started");
        handle.event(&gps(&clock, 0));
        wait_for_commits(&handle, 2);
        journal.set_fault(fault);
        journal.set_free(free);
        handle.event(&gps(&clock, 1));
        expect_notice(&notices, "recording_stopped");
        assert!(matches!(handle.status().recording, Recording::Stopped(_)), "{fault:?}");
        // Nothing waits meanwhile: a thousand frames are passed at once.
        (0..1000).for_each(|n| handle.event(&frame(&clock, n)));
        std::thread::sleep(Duration::from_millis(300));
        journal.set_fault(None);
        journal.set_free(None);
        expect_notice(&notices, "recording_resumed");
        handle.event(&gps(&clock, 2));
        expect_notice(&notices, "recording_dropout");
        store.stop();
        let name = flight::flight_names(dir.path()).unwrap().remove(0);
        super::keeper::settle_flight(&Volume::new(dir.path()), &name, true, |_, _| {}).unwrap();
        let (lines, _) = events_of(&dir.path().join(FLIGHTS).join(&name));
        let kept: Vec<&[u8]> = lines.iter().map(|l| &l[..]).collect();
        assert!(kept.contains(&&b"$GPGGA,0\r\n"[..]) && kept.contains(&&b"$GPGGA,2\r\n"[..]), "{fault:?}");
        let info = flight::flight_info(dir.path(), &name).unwrap();
        assert!(info.topics.contains_key("/store/dropout"), "{fault:?}: {:?}", info.topics.keys());
    }
}

#[test]
fn without_a_card_everything_else_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let missing = dir.path().join("not-there");
    let clock = HostClock::start();
    let (store, notices) = Store::start_on(Volume::new(&missing), &config(&missing), String::new(), clock);
    let handle = store.handle();
    assert!(handle.run() >= 0x8000_0000, "a number no card has");
    let StoreNotice::Stopped { reason } = expect_notice(&notices, "recording_stopped") else { panic!() };
    assert!(reason.contains("not-there"), "{reason}");
    assert_eq!(handle.state("datum", Duration::ZERO), None);
    // A card is inserted.
    std::fs::create_dir(&missing).unwrap();
    expect_notice(&notices, "recording_resumed");
    handle.event(&gps(&clock, 3));
    store.stop();
    assert_eq!(flight::flight_names(&missing).unwrap(), ["boot-1"]);
}

#[test]
fn a_broken_index_is_made_again_from_the_segments() {
    let dir = tempfile::tempdir().unwrap();
    let clock = HostClock::start();
    let volume = Volume::new(dir.path());
    let (store, notices) = Store::start_on(volume.clone(), &config(dir.path()), String::new(), clock);
    let handle = store.handle();
    (0..25).for_each(|n| handle.record(estimate(&clock, n), Some(n)));
    handle.put_state("clock", vec![9]);
    expect_notice(&notices, "recording_started");
    store.stop();
    let index = dir.path().join(super::index::INDEX);
    for file in ["db", "conf"] {
        std::fs::write(index.join(file), vec![0xA5; 70_000]).unwrap();
    }
    let (store, notices) = Store::start_on(volume, &config(dir.path()), String::new(), clock);
    expect_notice(&notices, "index_rebuilding");
    expect_notice(&notices, "index_ready");
    let index = store.handle().index().unwrap();
    assert_eq!(index.queued_runs(), [(1, 0, 25)]);
    assert_eq!(index.state("clock"), Some(vec![9]));
    assert_eq!(super::rebuild::differences(dir.path(), &index).unwrap().len(), 0);
    store.stop();
}

#[test]
fn the_state_of_an_earlier_run_is_read_before_a_slow_card_has_begun_a_flight() {
    // Given a state on a card.
    let dir = tempfile::tempdir().unwrap();
    let (clock, journal) = (HostClock::start(), Arc::new(Journal::default()));
    let start = || {
        let volume = Volume::journaled(dir.path(), Arc::clone(&journal));
        Store::start_on(volume, &config(dir.path()), String::new(), clock)
    };
    let (store, _notices) = start();
    store.handle().put_state("warm", vec![1, 2, 3]);
    store.stop();

    // When the next run finds a card that is slow to begin a flight.
    journal.set_held(true);
    let (store, notices) = start();
    let state = store.handle().state("warm", Duration::from_secs(30));
    let begun = store.handle().status().flight;
    journal.set_held(false);

    // Then the state is available meanwhile, and the flight still begins; nothing of it is sealed.
    assert_eq!((state, begun), (Some(vec![1, 2, 3]), String::new()));
    expect_notice(&notices, "index_ready");
    store.handle().event(&gps(&clock, 1));
    store.stop();
    let names = flight::flight_names(dir.path()).unwrap();
    assert_eq!(names.len(), 2, "{names:?}");
    assert!(names.iter().all(|name| flight::flight_info(dir.path(), name).unwrap().closed));
    let sealed = notices.try_iter().find(|notice| notice.name() == "segment_sealed");
    assert!(sealed.is_none(), "{sealed:?}");
}

#[test]
fn a_segment_that_the_index_missed_at_the_end_is_found_at_the_next_start() {
    // Given a closed flight with no segment in the index, as after a stop that could not wait.
    let dir = tempfile::tempdir().unwrap();
    let clock = HostClock::start();
    let volume = Volume::new(dir.path());
    let start = || Store::start_on(volume.clone(), &config(dir.path()), String::new(), clock);
    let (store, notices) = start();
    store.handle().record(estimate(&clock, 0), Some(0));
    expect_notice(&notices, "index_ready");
    store.stop();
    let name = flight::flight_names(dir.path()).unwrap().remove(0);
    let index = super::index::Index::open(&dir.path().join(super::index::INDEX)).unwrap();
    index.apply(&[super::index::Change::Forget(1), super::index::Change::Flight(1, name)]).unwrap();
    assert_eq!(super::rebuild::differences(dir.path(), &index).unwrap().len(), 1);
    drop(index);
    // When the store is started again, then the index has it.
    let (store, notices) = start();
    expect_notice(&notices, "index_ready");
    let index = store.handle().index().unwrap();
    assert_eq!(super::rebuild::differences(dir.path(), &index).unwrap(), []);
    store.stop();
}

#[test]
fn what_a_daemon_far_behind_records_is_read_in_the_order_it_was_handled() {
    // Given events that are handled seconds after their reception, as on an overloaded machine, with states stored
    // between them.
    let dir = tempfile::tempdir().unwrap();
    let clock = HostClock::start();
    let config = StoreConfig { frames: FramePolicy::Zstd, ..config(dir.path()) };
    let (store, _notices) = Store::start_on(Volume::new(dir.path()), &config, String::new(), clock);
    let (handle, began) = (store.handle(), clock.now() - Span::from_s(5.0));
    for n in 0..300u32 {
        let t_recv = began + Span::from_ms(10.0 * f64::from(n));
        let made = if n % 10 == 7 { frame(&clock, n) } else { gps(&clock, u64::from(n)) };
        handle.event(&Event { t_recv, ..made });
        if n % 100 == 50 {
            handle.put_state("warm", vec![0; 100]);
        }
    }
    store.stop();
    // Then they are read in that order.
    let name = flight::flight_names(dir.path()).unwrap().remove(0);
    let read = CaptureReader::open(&dir.path().join(FLIGHTS).join(name)).unwrap();
    let times: Vec<i64> = read.filter_map(|item| item.event).map(|event| event.t_recv.ns()).collect();
    assert_eq!(times.len(), 300);
    assert!(times.is_sorted(), "{times:?}");
}

#[test]
fn a_flight_that_is_removed_while_it_is_written_is_reported_and_begun_anew() {
    // Given a flight on the card.
    let dir = tempfile::tempdir().unwrap();
    let clock = HostClock::start();
    let (store, notices) =
        Store::start_on(Volume::new(dir.path()), &config(dir.path()), "[gps]\n".into(), clock);
    let handle = store.handle();
    handle.event(&gps(&clock, 1));
    wait_for_commits(&handle, 1);
    let flights = dir.path().join(FLIGHTS);
    // When its directory is removed, then that is reported at the next write.
    std::fs::remove_dir_all(&flights).unwrap();
    handle.event(&gps(&clock, 2));
    let StoreNotice::Stopped { reason } = expect_notice(&notices, "recording_stopped") else {
        unreachable!()
    };
    assert!(reason.contains("removed or replaced"), "{reason}");
    // Then another flight begins, and the losses are counted.
    expect_notice(&notices, "recording_resumed");
    handle.event(&gps(&clock, 3));
    wait_for_commits(&handle, 1);
    store.stop();
    let words = handle.status().outcome().expect("the end is on the card");
    assert!(words.starts_with("written, except for 1 messages"), "{words}");
    let name = flight::flight_names(dir.path()).unwrap().pop().expect("a flight");
    assert_eq!(events_of(&flights.join(name)).0, [b"$GPGGA,3\r\n"]);
}

#[test]
fn an_end_that_reaches_nobody_is_no_end_that_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let clock = HostClock::start();
    let (store, _notices) =
        Store::start_on(Volume::new(dir.path()), &config(dir.path()), "[gps]\n".into(), clock);
    let handle = store.handle();
    handle.event(&gps(&clock, 1));
    wait_for_commits(&handle, 1);
    assert_eq!(handle.status().outcome(), Ok("everything is written".into()));
    // When the flight's files are moved away at the very end.
    std::fs::rename(dir.path().join(FLIGHTS), dir.path().join("ELSEWHERE")).unwrap();
    handle.event(&gps(&clock, 2));
    store.stop();
    let why = handle.status().outcome().expect_err("the end is not in its place");
    assert!(why.contains("removed or replaced"), "{why}");
}
