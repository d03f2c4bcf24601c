//! A running `windhover run`: its configuration, its lines over pseudo-terminals, its log.

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use tempfile::TempDir;
use windhover::io::capture::CaptureReader;
use windhover::io::clock::HostClock;
use windhover_base::msg::{Event, EventBody};
use windhover_base::time::Span;

/// Longest wait of a test: many times what a machine with all processors busy needs. No test asserts durations.
const PATIENCE: Span = Span::from_ns(120_000_000_000);

/// A serial line by a stable name: its near end is a link that can be removed and replaced.
pub struct Line {
    link: PathBuf,
    far: Option<File>,
}

impl Line {
    pub fn new(link: PathBuf) -> Self {
        let mut line = Self { link, far: None };
        line.plug();
        line
    }

    /// Puts a new line under the same name.
    pub fn plug(&mut self) {
        let far: OwnedFd = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)
            .expect("a pseudo-terminal");
        grantpt(&far).expect("granted");
        unlockpt(&far).expect("unlocked");
        let name = ptsname(&far, Vec::new()).expect("named").into_string().expect("ASCII");
        let _ = std::fs::remove_file(&self.link);
        std::os::unix::fs::symlink(name, &self.link).expect("linked");
        self.far = Some(File::from(far));
    }

    /// Another handle on the far end, for a device that also receives.
    pub fn far_end(&self) -> File {
        self.far.as_ref().expect("plugged").try_clone().expect("a second handle")
    }

    /// Removes the line.
    pub fn unplug(&mut self) {
        let _ = std::fs::remove_file(&self.link);
        self.far = None;
    }

    pub fn send(&mut self, bytes: &[u8]) {
        if let Some(far) = &mut self.far {
            // Bytes for a line that nobody reads are lost, as on a real one.
            let _ = far.write_all(bytes);
        }
    }
}

/// `$body*HH` with its line end.
pub fn sentence(body: &str) -> String {
    let sum = body.bytes().fold(0u8, |sum, byte| sum ^ byte);
    format!("${body}*{sum:02X}\r\n")
}

/// A hovering helicopter's receiver and compass, at the real pace, on two lines that can be shared.
pub struct Feeder {
    stop: Arc<AtomicBool>,
    sky: Arc<AtomicBool>,
    thread: Option<JoinHandle<(Line, Line)>>,
}

impl Feeder {
    pub fn start(gps: Line, compass: Line) -> Self {
        Self::at_height(gps, compass, 43.0)
    }

    /// The same at a height above sea level; the bench's ground is at 33 m.
    pub fn at_height(mut gps: Line, mut compass: Line, alt_msl_m: f64) -> Self {
        let (stop, sky) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(true)));
        let (asked, seen) = (stop.clone(), sky.clone());
        let thread = std::thread::spawn(move || {
            let mut n = 0u32;
            while !asked.load(Ordering::Acquire) {
                if n.is_multiple_of(4) {
                    let height = seen.load(Ordering::Acquire).then_some(alt_msl_m);
                    gps.send(epoch(n / 4, height).as_bytes());
                }
                compass.send(sentence("C123.4P-0.5R0.3T21.0").as_bytes());
                n += 1;
                std::thread::sleep(Duration::from_millis(50));
            }
            (gps, compass)
        });
        Self { stop, sky, thread: Some(thread) }
    }

    /// Whether the receiver sees satellites.
    pub fn sky(&self, open: bool) {
        self.sky.store(open, Ordering::Release);
    }

    /// Ends feeding and returns the lines.
    pub fn stop(mut self) -> (Line, Line) {
        self.stop.store(true, Ordering::Release);
        self.thread.take().expect("running").join().expect("fed")
    }
}

/// One epoch of a 5 Hz receiver over Lisbon; without a fix where there is no height.
fn epoch(n: u32, alt_msl_m: Option<f64>) -> String {
    let (seconds, tenths) = (n / 5, n % 5 * 2);
    let time = format!("1504{:02}.{tenths}", seconds % 60);
    let (rmc, gga) = match alt_msl_m {
        Some(alt) => (
            format!("GPRMC,{time},A,3842.20000,N,00911.00000,W,000.0,000.0,181126,003.4,W"),
            format!("GPGGA,{time},3842.20000,N,00911.00000,W,1,09,0.9,{alt:.1},M,50.0,M,,"),
        ),
        None => (format!("GPRMC,{time},V,,,,,,,181126,,"), format!("GPGGA,{time},,,,,0,00,,,M,,M,,")),
    };
    sentence(&rmc) + &sentence(&gga)
}

/// A Garmin receiver that answers each `$PGRM…` sentence on its line. Releases the line when dropped.
pub struct Garmin {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Garmin {
    /// Answers through `answer`: the sentence's body in, the answer's body out.
    pub fn start(mut line: File, answer: impl Fn(&str) -> Option<String> + Send + 'static) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let asked = stop.clone();
        let thread = std::thread::spawn(move || {
            let (mut received, mut buffer) = (String::new(), [0u8; 256]);
            while !asked.load(Ordering::Acquire) {
                let wait = Timespec { tv_sec: 0, tv_nsec: 50_000_000 };
                let mut ready = [PollFd::new(&line, PollFlags::IN)];
                if !poll(&mut ready, Some(&wait)).is_ok_and(|count| count > 0) {
                    continue;
                }
                // The near end is not open: the same as no bytes.
                let Ok(count) = line.read(&mut buffer) else {
                    std::thread::sleep(Duration::from_millis(50));
                    continue;
                };
                received.push_str(&String::from_utf8_lossy(&buffer[..count]));
                while let Some((one, rest)) = received.split_once("\r\n") {
                    let body = one.strip_prefix('$').and_then(|one| one.split_once('*'));
                    // A sentence with a wrong checksum is ignored.
                    let body =
                        body.filter(|(body, _)| sentence(body).trim_end() == one).map(|(body, _)| body);
                    if let Some(answer) = body.and_then(&answer) {
                        let _ = line.write_all(sentence(&answer).as_bytes());
                    }
                    received = rest.to_owned();
                }
            }
        });
        Self { stop, thread: Some(thread) }
    }
}

impl Drop for Garmin {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.thread.take().expect("running").join().expect("ended");
    }
}

/// Numbers of the frames of a recording; none where there is nothing to read yet.
pub fn frames(recording: &Path) -> Vec<u32> {
    let events = CaptureReader::open(recording).into_iter().flatten().filter_map(|item| item.event);
    let number = |event: Event| match event.body {
        EventBody::Frame(frame) => Some(frame.index),
        _ => None,
    };
    events.filter_map(number).collect()
}

/// The files of a flight computer: configuration, lines, card, recorded camera.
pub struct Bench {
    pub folder: TempDir,
}

impl Bench {
    pub fn new() -> Self {
        let bench = Self { folder: tempfile::tempdir().expect("a folder") };
        bench.write_camera(6_000, 0.1);
        std::fs::create_dir(bench.path("card")).expect("created");
        bench.configure(|text| text);
        bench
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn config(&self) -> PathBuf {
        self.path("windhover.toml")
    }

    /// Writes the configuration, changed by `change`.
    pub fn configure(&self, change: impl FnOnce(String) -> String) {
        let text = include_str!("bench.toml").replace("BENCH", &self.folder.path().to_string_lossy());
        std::fs::write(self.config(), change(text)).expect("written");
    }

    /// A recorded camera: a grey frame every `period_s`.
    fn write_camera(&self, frames: u32, period_s: f64) {
        let folder = self.path("camera");
        std::fs::create_dir(&folder).expect("created");
        self.draw(|_, _| 90);
        let rows = (0..frames).map(|n| format!("{:.3},grey.pgm\n", f64::from(n) * period_s));
        let list: String = std::iter::once("time_s,file\n".to_owned()).chain(rows).collect();
        std::fs::write(folder.join("times.csv"), list).expect("written");
    }

    /// Sets the picture of every frame, a grey level for each column and row.
    pub fn draw(&self, level: impl Fn(usize, usize) -> u8) {
        let pixels: Vec<u8> = (0..320 * 256).map(|i| level(i % 320, i / 320)).collect();
        let picture = [b"P5\n320 256\n255\n".as_slice(), &pixels].concat();
        std::fs::write(self.path("camera/grey.pgm"), picture).expect("written");
    }

    pub fn lines(&self) -> (Line, Line) {
        (Line::new(self.path("gps")), Line::new(self.path("compass")))
    }

    /// Flights on the card, oldest first.
    pub fn flights(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.path("card/FLIGHTS")).expect("flights");
        let mut flights: Vec<PathBuf> = entries.map(|entry| entry.expect("an entry").path()).collect();
        flights.sort();
        flights
    }

    /// Numbers of the frames on the card in flight `number`, so far.
    pub fn frames_of(&self, number: usize) -> Vec<u32> {
        let flights = if self.path("card/FLIGHTS").is_dir() { self.flights() } else { Vec::new() };
        flights.get(number).map_or_else(Vec::new, |flight| frames(flight))
    }

    /// Runs another command of the program to its end; returns its standard output.
    pub fn command(&self, args: &[&str]) -> String {
        let output = Command::new(env!("CARGO_BIN_EXE_windhover"))
            .args(args)
            .current_dir(self.folder.path())
            .output()
            .expect("run");
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "windhover {args:?}: {error}");
        String::from_utf8(output.stdout).expect("UTF-8")
    }

    pub fn start(&self) -> Daemon {
        Daemon::start(&self.config(), &self.path("log"))
    }
}

/// The running daemon.
pub struct Daemon {
    child: Child,
    log: PathBuf,
    clock: HostClock,
}

impl Daemon {
    pub fn start(config: &Path, log: &Path) -> Self {
        Self::start_under(config, log, None)
    }

    /// Under a service manager that listens on a socket.
    pub fn start_under(config: &Path, log: &Path, manager: Option<&Path>) -> Self {
        let file = File::options().create(true).append(true).open(log).expect("a log");
        Self::start_with(config, Stdio::from(file), log, manager)
    }

    /// With a standard error other than the log that the test reads.
    pub fn start_with(config: &Path, stderr: Stdio, log: &Path, manager: Option<&Path>) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_windhover"))
            .args(["run", "--config"])
            .arg(config)
            .envs(manager.map(|socket| ("NOTIFY_SOCKET", socket)))
            .stdin(Stdio::null())
            .stderr(stderr)
            .spawn()
            .expect("started");
        Self::of(child, log)
    }

    /// A process that runs, and its log.
    pub fn of(child: Child, log: &Path) -> Self {
        Self { child, log: log.to_owned(), clock: HostClock::start() }
    }

    /// Its log so far; empty before the first line.
    pub fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// The first line after `skip` lines that contains all of `words`, and the number of lines up to and including it.
    pub fn wait_from(&self, skip: usize, words: &[&str]) -> (String, usize) {
        let limit = self.clock.now() + PATIENCE;
        loop {
            let log = self.log();
            let found = log.lines().enumerate().skip(skip).find(|(_, l)| words.iter().all(|w| l.contains(w)));
            if let Some((number, line)) = found {
                return (line.to_owned(), number + 1);
            }
            assert!(self.clock.now() < limit, "no line with {words:?}; the log:\n{log}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    pub fn wait(&self, words: &[&str]) -> (String, usize) {
        self.wait_from(0, words)
    }

    /// Waits until `done` returns true.
    pub fn wait_until(&self, what: &str, mut done: impl FnMut() -> bool) {
        let limit = self.clock.now() + PATIENCE;
        while !done() {
            assert!(self.clock.now() < limit, "not in time: {what}; the log:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Whether the process has taken over these signals.
    pub fn catches(&self, signals: &[Signal]) -> bool {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("it runs");
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).expect("a line of /proc");
        let caught = u64::from_str_radix(caught.trim(), 16).expect("a mask");
        signals.iter().all(|signal| caught & (1 << (signal.as_raw() - 1)) != 0)
    }

    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.child.id().cast_signed()).expect("a process");
        kill_process(pid, signal).expect("signalled");
    }

    /// Ends the process as a crash would.
    pub fn kill(mut self) {
        self.child.kill().expect("killed");
        self.child.wait().expect("a child");
    }

    /// Waits for the end; returns its status.
    pub fn ended(mut self) -> ExitStatus {
        let limit = self.clock.now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                return status;
            }
            assert!(self.clock.now() < limit, "still runs; the log:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
