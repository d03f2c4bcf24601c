//! The store on separate cards: full, read-only, failing, removed, put back, not permitted. A card is a tmpfs, or an
//! ext4 on a loop device where it has to fail as devices do; both need the right to mount, and without it these tests
//! report that and pass.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
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
use windhover::io::store::{Recording, Store, StoreHandle, StoreNotice, inspect};
use windhover_base::msg::{Event, EventBody, Source};
use windhover_base::time::MonoTime;

use crate::leave_out::leave_out;

/// A mount point and the card in it.
struct CardMount(TempDir);

impl CardMount {
    /// An empty mount; `None` where this user may not mount.
    fn new() -> Option<Self> {
        let mount = Self(tempfile::tempdir().unwrap());
        std::fs::create_dir(mount.path()).unwrap();
        if !mount.put_in("size=64m") {
            leave_out("card", "mounting takes privileges this user has not");
            return None;
        }
        Some(mount)
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

    /// Removes the card while it is in use.
    fn take_out(&self) {
        assert!(quietly(Command::new("umount").arg("-l").arg(self.path())), "unmounted");
    }
}

impl Drop for CardMount {
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
    handle.event(&Event {
        t_recv,
        seq: 0,
        body: EventBody::Bytes { source: Source::Gps, data: words.as_bytes().to_vec() },
    });
}

/// The recorded events, flight by flight.
fn recorded(card: &Path) -> Vec<String> {
    let mut names = flight::flight_names(card).unwrap();
    names.sort();
    let lines = names.iter().flat_map(|name| CaptureReader::open(&card.join(FLIGHTS).join(name)).unwrap());
    lines
        .filter_map(|item| match item.event?.body {
            EventBody::Bytes { source: Source::Gps, data: bytes } => Some(String::from_utf8(bytes).unwrap()),
            _ => None,
        })
        .collect()
}

/// An ext4 on a loop device, on a file whose own file system can be filled: then writes that the card's
/// file system had promised fail at the device, as those of worn flash do.
struct FailingCard {
    mount: CardMount,
    below: CardMount,
}

impl FailingCard {
    fn new() -> Option<Self> {
        let (mount, below) = (CardMount::new()?, CardMount::new()?);
        let card = Self { mount, below };
        std::fs::File::create(card.image()).unwrap().set_len(96 << 20).unwrap();
        let made = quietly(Command::new("mkfs.ext4").args(["-q", "-F", "-m", "1"]).arg(card.image()));
        card.mount.take_out();
        if !made || !card.put_in() {
            leave_out("a failing card", "no mkfs.ext4 or no loop device here");
            return None;
        }
        Some(card)
    }

    fn image(&self) -> PathBuf {
        self.below.path().join("card.img")
    }

    /// As the unit var-lib-windhover.mount does: checked, then mounted.
    fn put_in(&self) -> bool {
        quietly(Command::new("e2fsck").arg("-p").arg(self.image()));
        let options = ["-o", "loop,noatime,nodev,nosuid,noexec,errors=remount-ro"];
        let image = self.image();
        quietly(Command::new("mount").args(options).arg(image).arg(self.mount.path()))
    }

    /// Lets everything fail that needs a block not written before.
    fn fail(&self) {
        let filled = std::fs::write(self.below.path().join("ballast"), vec![1; 128 << 20]);
        assert!(filled.is_err(), "64 MB hold no 128");
    }

    fn mend(&self) {
        std::fs::remove_file(self.below.path().join("ballast")).unwrap();
    }

    /// Waits until nothing uses the device: until then it is not removed.
    fn let_go(&self) {
        for _ in 0..300 {
            let used = Command::new("losetup").arg("-j").arg(self.image()).output().unwrap();
            if used.stdout.is_empty() {
                return;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        panic!("the store holds on to a card that was taken out");
    }
}

impl Drop for FailingCard {
    fn drop(&mut self) {
        // The loop device is removed before its file.
        while quietly(Command::new("umount").arg("-l").arg(self.mount.path())) {}
    }
}

#[test]
fn a_device_that_refuses_writes_stops_recording_and_the_same_card_comes_back() {
    let Some(device) = FailingCard::new() else { return };
    let (card, clock) = (device.mount.path(), HostClock::start());
    let (store, notices) = start(&card, clock);
    let handle = store.handle();
    expect(&notices, "recording_started");
    expect(&notices, "index_ready");
    say(&handle, clock.now(), "before");
    let acknowledged = handle.status().last_commit_ns;
    while handle.status().last_commit_ns == acknowledged {
        std::thread::sleep(Duration::from_millis(20));
    }
    device.fail();
    // Incompressible bytes, until one write reaches a block that does not exist.
    let mut noise = 1u64;
    let stopped = loop {
        let words = std::iter::repeat_with(|| {
            noise = noise.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            noise.to_le_bytes()
        });
        let bytes: Vec<u8> = words.take(16 << 10).flatten().collect();
        handle.event(&Event {
            t_recv: clock.now(),
            seq: 0,
            body: EventBody::Bytes { source: Source::Compass, data: bytes },
        });
        match notices.recv_timeout(Duration::from_millis(50)) {
            Ok(notice) if notice.name() == "recording_stopped" => break notice.to_string(),
            _ => {}
        }
    };
    assert!(stopped.contains("NOT RECORDING"), "{stopped}");
    // Which of them depends on what the file system was writing when the device refused.
    let refusals = ["Input/output error", "No space left on device", "Read-only file system"];
    assert!(refusals.iter().any(|words| stopped.contains(words)), "{stopped}");
    let (free, _) = Volume::new(&card).space().unwrap();
    assert!(free > 20 << 20, "the card's own file system has room: {free} bytes");
    say(&handle, clock.now(), "meanwhile");
    // The pilot removes it, cleans its contacts, and puts it back.
    device.mount.take_out();
    device.let_go();
    device.mend();
    assert!(device.put_in());
    while handle.status().recording != Recording::On {
        std::thread::sleep(Duration::from_millis(20));
    }
    say(&handle, clock.now(), "after");
    store.stop();
    let recorded = recorded(&card);
    assert!(
        recorded.contains(&"before".to_owned()) && recorded.contains(&"after".to_owned()),
        "{recorded:?}"
    );
    let (flights, errors) = inspect::list(&card).unwrap();
    assert!(errors.is_empty() && !flights.is_empty(), "{errors:?}");
}

/// The store under another user: root may write everywhere.
#[test]
fn a_card_of_somebody_else_is_reported_and_used_once_it_is_handed_over() {
    let Some(mount) = CardMount::new() else { return };
    let tests = std::env::current_exe().unwrap();
    let built = tests.parent().and_then(Path::parent).unwrap().join("examples/store_load");
    if !built.exists() {
        leave_out("a card of somebody else", "the example store_load is not built");
        return;
    }
    // Where nobody may look and execute.
    std::fs::set_permissions(mount.0.path(), Permissions::from_mode(0o755)).unwrap();
    let program = mount.0.path().join("store_load");
    std::fs::copy(built, &program).unwrap();
    std::fs::set_permissions(mount.path(), Permissions::from_mode(0o700)).unwrap();
    const NOBODY: u32 = 65_534;
    let child = Command::new(&program)
        .arg(mount.path())
        .args(["--seconds", "8", "--fps", "0", "--floor-mb", "8"])
        .uid(NOBODY)
        .gid(NOBODY)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(std::fs::read_dir(mount.path()).unwrap().count(), 0);
    // What windhover-card.service does after a mount.
    std::os::unix::fs::chown(mount.path(), Some(NOBODY), Some(NOBODY)).unwrap();
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    let stopped = said.lines().find(|l| l.starts_with("recording_stopped")).expect(&said);
    assert!(stopped.contains("Permission denied"), "{stopped}");
    assert!(said.contains("recording_resumed"), "{said}");
    assert!(!recorded(&mount.path()).is_empty(), "{said}");
}

#[test]
fn a_full_card_stops_recording_until_space_appears() {
    let Some(mount) = CardMount::new() else { return };
    let (card, clock) = (mount.path(), HostClock::start());
    let (store, notices) = start(&card, clock);
    let handle = store.handle();
    expect(&notices, "recording_started");
    say(&handle, clock.now(), "before");
    handle.put_state("warm", vec![1]);
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
    handle.put_state("warm", vec![2]);
    store.stop();
    assert_eq!(flight::flight_names(&card).unwrap().len(), 1, "the same flight continues");
    assert_eq!(recorded(&card), ["before", "after"]);
    // A restart finds the state that the flight saved last, after it continued.
    let (store, _) = start(&card, clock);
    assert_eq!(store.handle().state("warm", Duration::from_secs(30)), Some(vec![2]));
    store.stop();
}

#[test]
fn a_read_only_card_is_reported_and_used_once_it_can_be_written() {
    let Some(mount) = CardMount::new() else { return };
    mount.remount("ro");
    let (card, clock) = (mount.path(), HostClock::start());
    let (store, notices) = start(&card, clock);
    let reason = expect(&notices, "recording_stopped");
    assert!(reason.contains("Read-only file system"), "{reason}");
    mount.remount("rw");
    expect(&notices, "recording_resumed");
    say(&store.handle(), clock.now(), "written");
    store.stop();
    assert_eq!(recorded(&card), ["written"]);
}

#[test]
fn a_card_taken_out_is_missed_and_the_next_one_used() {
    let Some(mount) = CardMount::new() else { return };
    let (card, clock) = (mount.path(), HostClock::start());
    let (store, notices) = start(&card, clock);
    let handle = store.handle();
    expect(&notices, "recording_started");
    say(&handle, clock.now(), "on the first");
    expect(&notices, "index_ready");
    mount.take_out();
    let reason = expect(&notices, "recording_stopped");
    assert!(reason.contains("removed"), "{reason}");
    assert!(matches!(handle.status().recording, Recording::Stopped(_)));
    assert_eq!(std::fs::read_dir(&card).unwrap().count(), 0, "nothing is written to the system card");
    assert!(mount.put_in("size=64m"));
    expect(&notices, "recording_resumed");
    say(&handle, clock.now(), "on the second");
    expect(&notices, "index_ready");
    store.stop();
    assert_eq!(recorded(&card), ["on the second"]);
}

#[test]
fn an_empty_slot_is_not_recorded_to() {
    let Some(mount) = CardMount::new() else { return };
    mount.take_out();
    let (card, clock) = (mount.path(), HostClock::start());
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
    assert_eq!(recorded(dir.path()), ["1969", "1970", "1970", "1979"]);
    let info = flight::flight_info(dir.path(), "boot-1").unwrap();
    assert!(info.closed);
    let gps = info.topics["/gps/serial"];
    assert_eq!((gps.count, gps.first_ns, gps.last_ns), (4, 0, 300_000_000_000_000_000));
}
