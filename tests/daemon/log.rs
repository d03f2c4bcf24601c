//! A sink that accepts nothing: a real pipe that is full and has no reader.

use std::io::{PipeReader, PipeWriter, Write, pipe};
use std::process::{Command, Stdio};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::Signal;

use super::harness::{Bench, Daemon};

/// A pipe into which nothing more goes.
fn full_pipe() -> (PipeReader, PipeWriter) {
    let (reader, mut writer) = pipe().expect("a pipe");
    let at_once = Timespec { tv_sec: 0, tv_nsec: 0 };
    // Ready means room for a page.
    while poll(&mut [PollFd::new(&writer, PollFlags::OUT)], Some(&at_once)).expect("polled") > 0 {
        writer.write_all(&[b'\n'; 4096]).expect("room");
    }
    (reader, writer)
}

#[test]
fn a_stuck_pipe_holds_up_neither_the_file_nor_the_end() {
    // Given a daemon that logs into a pipe without a reader, and into a file.
    let bench = Bench::new();
    let file = bench.path("windhover.log");
    bench.configure(|text| format!("{text}\n[log]\nfile = {:?}\n", file.display().to_string()));
    let (reader, writer) = full_pipe();
    let daemon = Daemon::start_with(&bench.config(), Stdio::from(writer), &file, None);

    // When it has run for a while and is asked to stop, then it continues until then, and ends with all lines in the
    // file.
    let (_, seen) = daemon.wait(&["event=health"]);
    daemon.wait_from(seen, &["event=health"]);
    daemon.signal(Signal::TERM);
    let status = daemon.ended();
    assert!(status.success(), "{status}");
    let text = std::fs::read_to_string(&file).expect("the file");
    let lines: Vec<&str> = text.lines().collect();
    assert!(lines.first().is_some_and(|line| line.contains("event=started")), "{text}");
    assert!(lines.last().is_some_and(|line| line.contains("event=stopped")), "{text}");

    // Then it reports what is missing in the pipe: all its lines.
    let lost = lines.iter().position(|line| line.contains("event=log_lines_lost about=stderr"));
    let lost = lost.or_else(|| lines.iter().position(|line| line.contains("event=log_lines_lost")));
    let at = lost.unwrap_or_else(|| panic!("nothing is said of the pipe:\n{text}"));
    assert!(lines[at].contains("about=stderr") && lines[at].ends_with(&format!(" lines={at}")), "{text}");
    drop(reader);
}

#[test]
fn a_daemon_that_fails_ends_though_nobody_reads_its_last_words() {
    let bench = Bench::new();
    bench.configure(|text| text.replace("38400", "38401"));
    let (reader, writer) = full_pipe();
    let daemon = Daemon::start_with(&bench.config(), Stdio::from(writer), &bench.path("log"), None);
    assert_eq!(daemon.ended().code(), Some(78));
    drop(reader);
}

#[test]
fn a_station_ends_though_its_terminal_is_stuck() {
    // Given a station whose output has no reader, with a payload whose name does not resolve.
    let folder = tempfile::tempdir().expect("a folder");
    let windhover = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_windhover"));
        command.current_dir(folder.path()).stdin(Stdio::null());
        command
    };
    for words in [["keys", "authority"].as_slice(), &["keys", "station", "hut"]] {
        assert!(windhover().args(words).stdout(Stdio::null()).status().expect("run").success(), "{words:?}");
    }
    let (out_reader, out) = full_pipe();
    let (error_reader, error) = full_pipe();
    let station = windhover()
        .args(["ground", "--certificate", "keys/station-hut.pem", "--web", "127.0.0.1:0"])
        .args(["--connect", "nowhere.invalid:4433", "--listen", "127.0.0.1:0"])
        .stdout(out)
        .stderr(error)
        .spawn()
        .expect("started");
    let station = Daemon::of(station, &folder.path().join("none"));

    // When it is up and is asked to stop, then it stops.
    station.wait_until("the folder of flights", || folder.path().join("ground").is_dir());
    std::thread::sleep(Duration::from_secs(3));
    station.signal(Signal::TERM);
    let status = station.ended();
    assert!(status.success(), "{status}");
    drop((out_reader, error_reader));
}
