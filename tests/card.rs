//! The store on cards of its own: full, read-only, taken out, put back. A card is a tmpfs, which takes
//! the right to mount; without it these tests say so and pass.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::Receiver;
use std::time::Duration;

use tempfile::TempDir;
use windhover::config::StoreConfig;
use windhover::io::capture::CaptureReader;
use windhover::io::clock::HostClock;
use windhover::io::store::flight::{self, FLIGHTS};
use windhover::io::store::volume::Volume;
use windhover::io::store::{Recording, Store, StoreHandle, StoreNotice};
use windhover::msg::{Event, EventBody};
use windhover::time::MonoTime;

/// A mount point and what is in it.
struct Slot(TempDir);

impl Slot {
    /// An empty slot; `None` where this user may not mount.
    fn new() -> Option<Self> {
        let slot = Self(tempfile::tempdir().unwrap());
        std::fs::create_dir(slot.path()).unwrap();
        if !slot.put_in("size=64m") {
            println!("SKIPPED: mounting takes privileges this user has not");
            return None;
        }
        Some(slot)
    }

    fn path(&self) -> PathBuf {
        self.0.path().join("card")
    }

    /// Puts an empty card in.
    fn put_in(&self, options: &str) -> bool {
        mount(&["-t", "tmpfs", "-o", options, "windhover-test"], &self.path())
    }

    fn remount(&self, options: &str) {
        assert!(mount(&["-o", &format!("remount,{options}")], &self.path()), "remount {options}");
    }

    /// Takes the card out under whoever uses it.
    fn take_out(&self) {
        assert!(quietly(Command::new("umount").arg("-l").arg(self.path())), "unmounted");
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        while quietly(Command::new("umount").arg("-l").arg(self.path())) {}
    }
}

fn mount(args: &[&str], at: &Path) -> bool {
    quietly(Command::new("mount").args(args).arg(at))
}

fn quietly(command: &mut Command) -> bool {
    command.stderr(Stdio::null()).status().is_ok_and(|status| status.success())
}

fn config(path: &Path) -> StoreConfig {
    StoreConfig {
        path: path.display().to_string(),
        require_mount: true,
        free_floor_mb: 8,
        free_target_mb: 0,
        ..StoreConfig::default()
    }
}

fn start(path: &Path, clock: HostClock) -> (Store, Receiver<StoreNotice>) {
    Store::start_on(Volume::new(path), &config(path), "[gps]\n".into(), clock)
}

/// Waits for a notice of this name.
fn expect(notices: &Receiver<StoreNotice>, name: &str) -> String {
    loop {
        match notices.recv_timeout(Duration::from_secs(30)) {
            Ok(notice) if notice.name() == name => return notice.to_string(),
            Ok(_) => {}
            Err(error) => panic!("no notice {name}: {error}"),
        }
    }
}

fn say(handle: &StoreHandle, t_recv: MonoTime, words: &str) {
    handle.event(&Event { t_recv, seq: 0, body: EventBody::GnssBytes(words.as_bytes().to_vec()) });
}

/// What was heard, flight by flight.
fn heard(card: &Path) -> Vec<String> {
    let mut names = flight::flight_names(card).unwrap();
    names.sort();
    let lines = names.iter().flat_map(|name| CaptureReader::open(&card.join(FLIGHTS).join(name)).unwrap());
    lines
        .filter_map(|item| match item.event?.body {
            EventBody::GnssBytes(bytes) => Some(String::from_utf8(bytes).unwrap()),
            _ => None,
        })
        .collect()
}

#[test]
fn a_full_card_stops_recording_until_space_appears() {
    let Some(slot) = Slot::new() else { return };
    let (card, clock) = (slot.path(), HostClock::start());
    let (store, notices) = start(&card, clock);
    let handle = store.handle();
    expect(&notices, "recording_started");
    say(&handle, clock.now(), "before");
    // Something else fills the card to the last page.
    let ballast = card.join("ballast");
    let filled = std::fs::write(&ballast, vec![1; 128 << 20]);
    assert!(filled.is_err(), "64 MB hold no 128");
    let reason = expect(&notices, "recording_stopped");
    assert!(reason.contains("NOT RECORDING"), "{reason}");
    say(&handle, clock.now(), "meanwhile");
    std::fs::remove_file(&ballast).unwrap();
    expect(&notices, "recording_resumed");
    say(&handle, clock.now(), "after");
    expect(&notices, "recording_dropout");
    store.stop();
    assert_eq!(flight::flight_names(&card).unwrap().len(), 1, "the same flight goes on");
    assert_eq!(heard(&card), ["before", "after"]);
}

#[test]
fn a_read_only_card_is_told_and_used_once_it_can_be_written() {
    let Some(slot) = Slot::new() else { return };
    slot.remount("ro");
    let (card, clock) = (slot.path(), HostClock::start());
    let (store, notices) = start(&card, clock);
    let reason = expect(&notices, "recording_stopped");
    assert!(reason.contains("Read-only file system"), "{reason}");
    slot.remount("rw");
    expect(&notices, "recording_resumed");
    say(&store.handle(), clock.now(), "written");
    store.stop();
    assert_eq!(heard(&card), ["written"]);
}

#[test]
fn a_card_taken_out_is_missed_and_the_next_one_used() {
    let Some(slot) = Slot::new() else { return };
    let (card, clock) = (slot.path(), HostClock::start());
    let (store, notices) = start(&card, clock);
    let handle = store.handle();
    expect(&notices, "recording_started");
    say(&handle, clock.now(), "on the first");
    expect(&notices, "index_ready");
    slot.take_out();
    let reason = expect(&notices, "recording_stopped");
    assert!(reason.contains("taken away"), "{reason}");
    assert!(matches!(handle.status().recording, Recording::Stopped(_)));
    assert_eq!(std::fs::read_dir(&card).unwrap().count(), 0, "nothing is written to the system card");
    assert!(slot.put_in("size=64m"));
    expect(&notices, "recording_resumed");
    say(&handle, clock.now(), "on the second");
    expect(&notices, "index_ready");
    store.stop();
    assert_eq!(heard(&card), ["on the second"]);
}

#[test]
fn an_empty_slot_is_not_recorded_to() {
    let Some(slot) = Slot::new() else { return };
    slot.take_out();
    let (card, clock) = (slot.path(), HostClock::start());
    let (store, notices) = start(&card, clock);
    let reason = expect(&notices, "recording_stopped");
    assert!(reason.contains("nothing is mounted"), "{reason}");
    store.stop();
    assert_eq!(std::fs::read_dir(&card).unwrap().count(), 0);
}

#[test]
fn a_clock_before_1980_records_like_any_other() {
    let dir = tempfile::tempdir().unwrap();
    let clock = HostClock::start();
    let config = StoreConfig { require_mount: false, ..config(dir.path()) };
    let (store, notices) = Store::start_on(Volume::new(dir.path()), &config, String::new(), clock);
    expect(&notices, "recording_started");
    let handle = store.handle();
    // A computer whose battery is empty begins at 1970, and one with a wrong one before that.
    for (second, words) in [(-3, "1969"), (5, "1970"), (6, "1970"), (300_000_000, "1979")] {
        say(&handle, MonoTime::from_ns(second * 1_000_000_000), words);
    }
    store.stop();
    assert_eq!(heard(dir.path()), ["1969", "1970", "1970", "1979"]);
    let info = flight::flight_info(dir.path(), "boot-1").unwrap();
    assert!(info.closed);
    let gps = info.topics["/gps/serial"];
    assert_eq!((gps.count, gps.first_ns, gps.last_ns), (4, 0, 300_000_000_000_000_000));
}
