//! Devices that are held by others, or have nothing to say: the real binary over pseudo-terminals.

use std::time::Duration;

use super::harness::{Bench, Feeder};

#[test]
fn a_port_that_another_program_holds_is_taken_when_it_is_free() {
    let bench = Bench::new();
    let (gps, compass) = bench.lines();
    let path = bench.path("gps").to_string_lossy().into_owned();
    let held = serialport::TTYPort::open(&serialport::new(path, 38_400)).expect("opened");
    let daemon = bench.start();
    let (line, _) = daemon.wait(&["event=device_down", "about=gps", "fault=busy"]);
    assert!(line.contains("another program holds"), "{line}");
    daemon.wait(&["event=not_ready", "gps"]);
    drop(held);
    let feeder = Feeder::start(gps, compass);
    daemon.wait(&["event=device_up", "about=gps"]);
    daemon.wait(&["event=ready"]);
    feeder.stop();
}

#[test]
fn a_receiver_without_a_fix_is_heard_and_not_used() {
    // Given a receiver under a roof, then its sentences are counted and no fix is told.
    let bench = Bench::new();
    let (gps, compass) = bench.lines();
    let daemon = bench.start();
    let feeder = Feeder::start(gps, compass);
    feeder.sky(false);
    std::thread::sleep(Duration::from_millis(300));
    let (_, seen) = daemon.wait(&["event=ready"]);
    let (_, seen) = daemon.wait_from(seen, &["event=health"]);
    let (line, seen) = daemon.wait_from(seen, &["event=health", "fix=none"]);
    assert!(!line.contains("gps_hz=0.0"), "{line}");

    // When it sees the sky and then loses it, then both are told.
    feeder.sky(true);
    let (_, seen) = daemon.wait_from(seen, &["event=health", "fix=3d"]);
    feeder.sky(false);
    let (_, seen) = daemon.wait_from(seen, &["event=fix_lost"]);
    daemon.wait_from(seen, &["event=health", "fix=none"]);
    feeder.stop();
}

#[test]
fn a_compass_that_falls_silent_is_told_and_heard_again() {
    let bench = Bench::new();
    let (gps, compass) = bench.lines();
    let daemon = bench.start();
    let feeder = Feeder::start(gps, compass);
    let (_, seen) = daemon.wait(&["event=ready"]);

    // When nothing more comes on its line, which stays open, then that is told.
    let (gps, compass) = feeder.stop();
    let (_, seen) = daemon.wait_from(seen, &["event=source_silent", "about=compass"]);
    let (line, seen) = daemon.wait_from(seen, &["event=health", "compass_hz=0.0"]);
    assert!(line.contains("level=warn"), "{line}");
    let feeder = Feeder::start(gps, compass);
    daemon.wait_from(seen, &["event=source_back", "about=compass"]);
    feeder.stop();
}
