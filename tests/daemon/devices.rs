//! Devices that answer, are in use, or send nothing: the real binary over pseudo-terminals.

use std::time::Duration;

use super::harness::{Bench, Feeder, Garmin};

#[test]
fn a_receiver_is_configured_and_its_answers_are_checked() {
    // Given a receiver that echoes its settings, as a GPS 18x does.
    let bench = Bench::new();
    bench.configure(|text| {
        text.replace("baud = 38400\n\n[compass]", "baud = 38400\nconfigure_garmin = true\n\n[compass]")
    });
    let (gps, compass) = bench.lines();
    let receiver = Garmin::start(gps.far_end(), |body| Some(body.to_owned()));
    let daemon = bench.start();
    let feeder = Feeder::start(gps, compass);

    // Then every setting is accepted, and the receiver is used.
    let (line, seen) = daemon.wait(&["event=receiver_configured", "about=gps"]);
    assert!(line.contains("7 settings accepted"), "{line}");
    let (_, seen) = daemon.wait_from(seen, &["event=health", "fix=3d"]);

    // When another receiver is plugged in that keeps averaging positions, then that is reported.
    let (mut gps, compass) = feeder.stop();
    drop(receiver);
    gps.unplug();
    let (_, seen) = daemon.wait_from(seen, &["event=device_down", "about=gps", "fault=unplugged"]);
    gps.plug();
    let other = |body: &str| Some(body.replace("PGRMC1,1,1,1", "PGRMC1,1,1,2"));
    let receiver = Garmin::start(gps.far_end(), other);
    let (line, seen) = daemon.wait_from(seen, &["event=receiver_not_configured", "about=gps"]);
    assert!(line.contains("PGRMC1") && line.contains("other values"), "{line}");

    // When one is plugged in that does not answer, then that is reported too, moments after the last time, and its data
    // are used.
    drop(receiver);
    gps.unplug();
    let (_, seen) = daemon.wait_from(seen, &["event=device_down", "about=gps", "fault=unplugged"]);
    gps.plug();
    let feeder = Feeder::start(gps, compass);
    let (line, seen) = daemon.wait_from(seen, &["event=receiver_not_configured", "about=gps"]);
    assert!(line.contains("did not answer PGRMC1"), "{line}");
    daemon.wait_from(seen, &["event=health", "fix=3d"]);
    feeder.stop();
}

#[test]
fn a_port_that_another_program_holds_is_taken_when_it_is_free() {
    let bench = Bench::new();
    let (gps, compass) = bench.lines();
    let path = bench.path("gps").to_string_lossy().into_owned();
    let held = serialport::TTYPort::open(&serialport::new(path, 38_400)).expect("opened");
    let daemon = bench.start();
    let (line, _) = daemon.wait(&["event=device_down", "about=gps", "fault=busy"]);
    assert!(line.contains("another program uses the port"), "{line}");
    daemon.wait(&["event=not_ready", "gps"]);
    drop(held);
    let feeder = Feeder::start(gps, compass);
    daemon.wait(&["event=device_up", "about=gps"]);
    daemon.wait(&["event=ready"]);
    feeder.stop();
}

#[test]
fn a_receiver_without_a_fix_is_decoded_and_not_used() {
    // Given a receiver under a roof, then its sentences are counted and no fix is reported.
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

    // When it sees satellites and then loses them, then both are reported.
    feeder.sky(true);
    let (_, seen) = daemon.wait_from(seen, &["event=health", "fix=3d"]);
    feeder.sky(false);
    let (_, seen) = daemon.wait_from(seen, &["event=fix_lost"]);
    daemon.wait_from(seen, &["event=health", "fix=none"]);
    feeder.stop();
}

#[test]
fn a_compass_that_falls_silent_is_reported_and_used_again() {
    let bench = Bench::new();
    let (gps, compass) = bench.lines();
    let daemon = bench.start();
    let feeder = Feeder::start(gps, compass);
    let (_, seen) = daemon.wait(&["event=ready"]);

    // When nothing more arrives on its line, which stays open, then that is reported.
    let (gps, compass) = feeder.stop();
    let (_, seen) = daemon.wait_from(seen, &["event=source_silent", "about=compass"]);
    let (line, seen) = daemon.wait_from(seen, &["event=health", "compass_hz=0.0"]);
    assert!(line.contains("level=warn"), "{line}");
    let feeder = Feeder::start(gps, compass);
    daemon.wait_from(seen, &["event=source_back", "about=compass"]);
    feeder.stop();
}
