//! The real binary over pseudo-terminals at the real pace, with a recorded camera: everything except the V4L2 call is
//! as in flight.

mod devices;
mod harness;
mod log;
mod signals;
mod warm;

use std::process::Command;
use std::time::Duration;

use harness::{Bench, Feeder, frames};
use rustix::process::Signal;

#[test]
fn from_start_to_ready_to_the_end() {
    // Given a receiver, a compass and a camera.
    let bench = Bench::new();
    let (gps, compass) = bench.lines();
    let daemon = bench.start();
    let feeder = Feeder::start(gps, compass);

    // When they deliver, then the daemon is ready, and sends its health every second.
    daemon.wait(&["event=ready"]);
    let (_, seen) = daemon.wait(&["event=health"]);
    let (line, _) = daemon.wait_from(seen, &["event=health", "fix=3d"]);
    for field in ["gps_hz=", "compass_hz=", "camera_hz=", "card=", "link=", "dropped=", "cpu_pct=", "mem_mb="]
    {
        assert!(line.contains(field), "{field} in {line}");
    }

    // When it is asked to stop, then it stops, and its last event says so.
    daemon.signal(Signal::TERM);
    let log = bench.path("log");
    let status = daemon.ended();
    assert!(status.success(), "{status}");
    let text = std::fs::read_to_string(log).expect("a log");
    assert!(text.lines().last().is_some_and(|line| line.contains("event=stopped")), "{text}");
    feeder.stop();
}

#[test]
fn devices_come_and_go() {
    // Given a daemon without any device.
    let bench = Bench::new();
    bench.configure(|text| text.replace("capture:", "capture-loop:"));
    let daemon = bench.start();
    for device in ["gps", "compass"] {
        daemon.wait(&["event=device_down", device, "fault=missing"]);
    }

    // When they appear, then it is ready.
    let (gps, compass) = bench.lines();
    let feeder = Feeder::start(gps, compass);
    let (_, seen) = daemon.wait(&["event=ready"]);

    // When the compass disappears, then that is reported, and the daemon continues.
    let (gps, mut compass) = feeder.stop();
    compass.unplug();
    let (_, seen) = daemon.wait_from(seen, &["event=device_down", "about=compass", "fault=unplugged"]);

    // When it returns under another number, and the GPS sends noise first, then both are used.
    let mut gps = gps;
    gps.send(&[0xff; 900]);
    compass.plug();
    let feeder = Feeder::start(gps, compass);
    daemon.wait_from(seen, &["event=device_up", "about=compass"]);
    daemon.wait_from(seen, &["event=device_garbled", "about=gps"]);
    let (_, seen) = daemon.wait_from(seen, &["event=health"]);
    let (line, _) = daemon.wait_from(seen, &["event=health", "level=info"]);
    assert!(!line.contains("compass_hz=0.0"), "{line}");
    feeder.stop();
}

#[test]
fn the_configuration_is_read_again() {
    let bench = Bench::new();
    let daemon = bench.start();
    daemon.wait(&["event=started"]);
    daemon.wait(&["event=device_up", "about=camera"]);

    // When a level changes and a line speed too, then the former takes effect and the latter is reported.
    bench.configure(|text| format!("{}\n[log]\nlevel = \"error\"\n", text.replace("38400", "19200")));
    daemon.signal(Signal::HUP);
    daemon.wait(&["event=reloaded", "log.level"]);
    daemon.wait(&["event=needs_restart", "gps.baud: 38400 → 19200"]);
    // What was on its way when the level changed has arrived.
    std::thread::sleep(Duration::from_millis(1_500));
    let lines = daemon.log().lines().count();
    std::thread::sleep(Duration::from_millis(1_500));
    assert_eq!(daemon.log().lines().count(), lines, "only errors are shown now");

    // When the file is broken, then the old configuration stays.
    bench.configure(|text| text.replace("baud = 38400", "baud = \"fast\""));
    daemon.signal(Signal::HUP);
    daemon.wait(&["event=reload_refused", "the previous configuration stays"]);
}

#[test]
fn failing_power_is_reported() {
    let bench = Bench::new();
    let battery = bench.path("sys/class/power_supply/BAT0");
    std::fs::create_dir_all(&battery).expect("created");
    let volts = |microvolts: &str| std::fs::write(battery.join("voltage_now"), microvolts).expect("written");
    volts("12100000");
    let daemon = bench.start();
    daemon.wait(&["event=health", "supply_v=12.10"]);
    volts("9800000");
    daemon.wait(&["event=power_going", "9.80 V"]);
    volts("11500000");
    daemon.wait(&["event=power_back"]);
}

#[test]
fn a_bad_configuration_is_exit_code_78() {
    let bench = Bench::new();
    bench.configure(|text| text.replace("38400", "38401"));
    let output = Command::new(env!("CARGO_BIN_EXE_windhover"))
        .args(["run", "--config"])
        .arg(bench.config())
        .output()
        .expect("run");
    assert_eq!(output.status.code(), Some(78));
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(error.contains("windhover.toml") && error.contains("gps.baud"), "{error}");
    assert!(error.lines().count() <= 2, "{error}");
}

#[test]
fn what_was_recorded_survives_a_crash_and_replays_to_the_same() {
    // Given a flight that ends with kill -9 in the middle of writing.
    let bench = Bench::new();
    let (gps, compass) = bench.lines();
    let daemon = bench.start();
    let feeder = Feeder::start(gps, compass);
    daemon.wait(&["event=ready"]);
    daemon.wait_until("frames on the card", || bench.frames_of(0).len() >= 15);
    daemon.kill();

    // When the daemon is started again, then it is ready again, and the first flight is still there.
    let daemon = bench.start();
    let before = daemon.log().lines().count();
    daemon.wait_from(before, &["event=ready"]);
    daemon.wait_until("frames on the card", || bench.frames_of(1).len() >= 15);
    daemon.signal(Signal::TERM);
    assert!(daemon.ended().success());
    feeder.stop();
    let flights = bench.flights();
    assert_eq!(flights.len(), 2, "{flights:?}");
    assert!(frames(&flights[0]).len() >= 15, "{:?} before the crash", frames(&flights[0]));

    // When the second flight is replayed, then the helicopter's own states are those that flew, frame by frame. A frame
    // that a busy machine did not record leaves a gap in the numbers: up to the first gap the tables are the same.
    let kept = frames(&flights[1]);
    let whole = kept.iter().zip(0..).take_while(|(frame, number)| *frame == number).count();
    let flight = flights[1].to_string_lossy().into_owned();
    bench.command(&["replay", &flight, "--out", "again.mcap"]);
    bench.command(&["export", &flight, "--format", "csv", "--out", "flown"]);
    bench.command(&["export", "again.mcap", "--format", "csv", "--out", "replayed"]);
    let again = frames(&bench.path("again.mcap"));
    assert_eq!(kept, again, "frames keep their numbers");
    let read = |folder| std::fs::read_to_string(bench.path(folder).join("ownship.csv")).expect("a table");
    let (flown, replayed) = (read("flown"), read("replayed"));
    assert!(whole > 10, "{kept:?}");
    let rows = if whole == kept.len() { usize::MAX } else { whole };
    for (number, (flown, replayed)) in flown.lines().zip(replayed.lines()).take(rows).enumerate() {
        assert_eq!(flown, replayed, "row {number}");
    }
    if rows == usize::MAX {
        // The daemon lets time pass after its last input: it may have made one more state than a replay, which ends there.
        let more = flown.lines().count() - replayed.lines().count();
        assert!(more <= 1, "{more} rows are not replayed");
    }
}
