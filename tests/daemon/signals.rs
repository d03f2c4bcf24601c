//! Signals and the watchdog while the daemon starts and while it reads slow files.

use std::io::{ErrorKind, Write};
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::time::Duration;

use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::Signal;

use super::harness::{Bench, Daemon};

/// A file that is as slow as its writer: a reader waits for a writer.
fn slow_file(path: &Path) {
    let _ = std::fs::remove_file(path);
    mknodat(CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).expect("a fifo");
}

/// A service manager's socket.
struct Manager(UnixDatagram);

impl Manager {
    fn new(path: &Path) -> Self {
        let socket = UnixDatagram::bind(path).expect("a socket");
        socket.set_read_timeout(Some(Duration::from_secs(120))).expect("a time-out");
        Self(socket)
    }

    /// Waits for a message that contains this line.
    fn wait(&self, line: &str) {
        let mut buffer = [0; 4096];
        loop {
            let length = match self.0.recv(&mut buffer) {
                Ok(length) => length,
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) => panic!("no {line}: {error}"),
            };
            if String::from_utf8_lossy(&buffer[..length]).lines().any(|text| text == line) {
                return;
            }
        }
    }
}

#[test]
fn signals_are_answered_before_the_configuration_is_read() {
    // Given a configuration whose reading never ends.
    let bench = Bench::new();
    slow_file(&bench.config());
    let daemon = bench.start();
    daemon.wait_until("signals are taken over", || daemon.catches(&[Signal::TERM, Signal::INT, Signal::HUP]));

    // When it is asked to reload and to stop, then it continues and stops.
    daemon.signal(Signal::HUP);
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.ended().code(), Some(0));
}

#[test]
fn a_hang_up_before_the_configuration_is_read_ends_nothing() {
    let bench = Bench::new();
    let text = std::fs::read_to_string(bench.config()).expect("written by the bench");
    slow_file(&bench.config());
    let daemon = bench.start();
    // Opened as soon as the daemon reads it.
    let mut slow = std::fs::File::options().write(true).open(bench.config()).expect("opened");
    daemon.signal(Signal::HUP);
    // The next read of the file returns at once.
    std::fs::remove_file(bench.config()).expect("removed");
    std::fs::write(bench.config(), &text).expect("written");
    slow.write_all(text.as_bytes()).expect("read");
    drop(slow);

    daemon.wait(&["event=started"]);
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.ended().code(), Some(0));
}

#[test]
fn the_watchdog_is_stroked_and_the_end_handled_while_slow_files_are_read() {
    let bench = Bench::new();
    let manager = Manager::new(&bench.path("manager"));
    let text = std::fs::read_to_string(bench.config()).expect("written by the bench");
    let daemon = Daemon::start_under(&bench.config(), &bench.path("log"), Some(&bench.path("manager")));
    daemon.wait(&["event=device_up", "about=camera"]);

    // When a reload reads a configuration without a writer, then every task still answers.
    slow_file(&bench.config());
    daemon.signal(Signal::HUP);
    manager.wait("RELOADING=1");
    for _ in 0..8 {
        manager.wait("WATCHDOG=1");
    }
    // When it is there, then it is used.
    std::fs::write(bench.config(), format!("{text}\n[log]\nlevel = \"warn\"\n")).expect("read");
    daemon.wait(&["event=reloaded", "log.level"]);

    // When it names a terrain tile whose reading never ends, then the same, and the stop request is handled.
    let tile = bench.path("N38W010.hgt");
    slow_file(&tile);
    std::fs::remove_file(bench.config()).expect("removed");
    let terrain = format!("terrain = {:?}", tile.to_string_lossy());
    bench.configure(|text| text.replace("elevation_msl_m = 33.0", &terrain));
    daemon.signal(Signal::HUP);
    manager.wait("RELOADING=1");
    for _ in 0..8 {
        manager.wait("WATCHDOG=1");
    }
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.ended().code(), Some(0));
}
