//! Costs and latency of the daemon, with raw frames at full size and rate.
//!
//! `make load`, or `cargo run --release --example daemon_load -- [--seconds S] [--dir DIR]`
//!
//! Simulates a flight once (raw grey, 1280×1024, 30 frames/s), plays it repeatedly into `windhover run` - frames from
//! memory, serial lines over pseudo-terminals - with recording on, and prints exposure to estimate, processor time by
//! task, memory and losses. The flight hovers over a parked vehicle, so that its end fits its beginning; only the
//! receiver's time jumps back.
//!
//! It also prints how long a byte and a frame waited for their stamp: from just before the write into the line, and
//! from when the frame was due, to the log time in the flight. With `--busy N`, N threads compute meanwhile.
//!
//! The daemon runs in the environment of the unit, and with its niceness where root runs this. A separate thread that
//! only sleeps and reads the clock shows how long the machine itself stood still: a frame that is late in that time is
//! not the daemon's fault.

use std::fs::{self, File};
use std::io::Write;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use clap::Parser;
use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use windhover::app::replay::config_of;
use windhover::io::capture::CaptureReader;
use windhover::io::clock::HostClock;
use windhover_base::msg::{EventBody, Source};
use windhover_base::time::{MonoTime, Span};

#[derive(Parser)]
struct Args {
    /// How long
    #[arg(long, default_value_t = 300)]
    seconds: u64,
    /// Length of the flight that is repeated, seconds
    #[arg(long, default_value_t = 12)]
    flight_s: u64,
    /// Folder for flight, frames, card and log
    #[arg(long, default_value = "target/load")]
    dir: PathBuf,
    /// Folder from which the frames are played: a file system in memory, so that no disk delays them
    #[arg(long, default_value = "/dev/shm")]
    frames_in: PathBuf,
    /// Threads that compute in parallel to the daemon
    #[arg(long, default_value_t = 0)]
    busy: usize,
    /// The daemon
    #[arg(long, default_value = "target/release/windhover")]
    windhover: PathBuf,
}

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

const FPS: f64 = 30.0;

fn main() -> Result<()> {
    let args = Args::parse();
    fs::create_dir_all(&args.dir)?;
    let dir = args.dir.canonicalize()?;
    let flight = dir.join(format!("flight-{}.mcap", args.flight_s));
    if !flight.exists() {
        simulate(&args, &flight)?;
    }
    let camera = tempfile::tempdir_in(&args.frames_in)?;
    let Unpacked { bytes, first_exposure } = unpack(&flight, camera.path())?;
    let card = dir.join("card");
    let _ = fs::remove_dir_all(&card);
    fs::create_dir(&card)?;
    let (gps, compass) = (line()?, line()?);
    let config = dir.join("windhover.toml");
    fs::write(&config, configuration(&flight, &dir, camera.path(), [&gps.1, &compass.1])?)?;

    let log = dir.join("log");
    // `nice` becomes the daemon; without the right to lower the niceness, it reports that and continues.
    let mut daemon = Command::new("nice")
        .args(["-n", of_unit("Nice=").next().unwrap_or("0")])
        .arg(&args.windhover)
        .args(["run", "--config"])
        .arg(&config)
        .envs(of_unit("Environment=").filter_map(|line| line.split_once('=')))
        .stdin(Stdio::null())
        .stderr(File::create(&log)?)
        .spawn()?;
    let flight_s = args.flight_s;
    let began = camera_up(&log, &mut daemon)?;
    let feeder = Background::start(move |asked| {
        let lines = Lines { bytes: &bytes, gps: gps.0, compass: compass.0 };
        feed(lines, flight_s, began, first_exposure, asked)
    });
    let bystander = Background::start(stand_by);
    let busy: Vec<_> = (0..args.busy).map(|_| Background::start(compute)).collect();
    let memory = watch(&mut daemon, args.seconds)?;
    let tasks = tasks(daemon.id())?;
    kill_process(Pid::from_raw(daemon.id().cast_signed()).ok_or("no process")?, Signal::TERM)?;
    daemon.wait()?;
    let written = feeder.stop()?;
    for busy in busy {
        busy.stop()?;
    }
    report(&fs::read_to_string(&log)?, args.seconds, &memory, &tasks)?;
    report_stamps(&card, &written)?;
    let late = bystander.stop()?;
    let longest =
        late.iter().copied().reduce(f64::max).map_or(String::new(), |ms| format!(", by {ms:.1} ms at most"));
    println!(
        "a bystander that sleeps 5 ms at a time woke late by 20 ms or more {} times{longest}",
        late.len()
    );
    Ok(())
}

/// The values of the unit under this name, one line each.
fn of_unit(name: &str) -> impl Iterator<Item = &'static str> {
    let unit = include_str!("../systemd/windhover.service");
    unit.lines().filter_map(move |line| line.strip_prefix(name))
}

fn simulate(args: &Args, flight: &Path) -> Result<()> {
    let status = Command::new(&args.windhover)
        .arg("simulate")
        .arg(flight)
        .args([
            "--scenario",
            "hover10",
            "--lossless",
            "--fps",
            &FPS.to_string(),
            "--duration",
            &args.flight_s.to_string(),
        ])
        .status()?;
    status.success().then_some(()).ok_or_else(|| "the flight could not be simulated".into())
}

/// Bytes of a line, and when they came.
type Bytes = Vec<(Span, bool, Vec<u8>)>;

/// What a flight holds beside its frames; times since its first event.
struct Unpacked {
    bytes: Bytes,
    /// Exposure of the first frame. It is negative where the frame's arrival is the first event.
    first_exposure: Span,
}

/// Writes the frames into a folder that the recorded camera plays.
fn unpack(flight: &Path, camera: &Path) -> Result<Unpacked> {
    let (mut list, mut bytes, mut first) = ("time_s,file\n".to_owned(), Vec::new(), None);
    let mut first_exposure = None;
    for event in CaptureReader::open(flight)?.filter_map(|item| item.event) {
        let since = event.t_recv - *first.get_or_insert(event.t_recv);
        match event.body {
            EventBody::Bytes { source: Source::Gps, data } => bytes.push((since, true, data)),
            EventBody::Bytes { source: Source::Compass, data } => bytes.push((since, false, data)),
            EventBody::Frame(frame) => {
                let name = format!("{:05}.pgm", frame.index);
                let head = format!("P5\n{} {}\n255\n", frame.width, frame.height);
                fs::write(camera.join(&name), [head.as_bytes(), &frame.data].concat())?;
                let exposed = since + (frame.t_exposure - event.t_recv);
                first_exposure.get_or_insert(exposed);
                list += &format!("{:.6},{name}\n", exposed.s());
            }
            _ => {}
        }
    }
    fs::write(camera.join("times.csv"), list)?;
    Ok(Unpacked { bytes, first_exposure: first_exposure.ok_or("the flight has no frames")? })
}

/// Waits until the daemon plays the camera's frames; returns when that was, to a millisecond.
fn camera_up(log: &Path, daemon: &mut Child) -> Result<Instant> {
    loop {
        let text = fs::read_to_string(log)?;
        if text.lines().any(|line| line.contains("event=device_up") && line.contains("about=camera")) {
            return Ok(Instant::now());
        }
        if let Some(status) = daemon.try_wait()? {
            return Err(format!("the daemon ended before its camera was up: {status}").into());
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A pseudo-terminal: its far end, and the path of its near end.
fn line() -> Result<(File, String)> {
    let far: OwnedFd = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&far)?;
    unlockpt(&far)?;
    let near = ptsname(&far, Vec::new())?.into_string()?;
    Ok((File::from(far), near))
}

fn configuration(flight: &Path, dir: &Path, camera: &Path, lines: [&str; 2]) -> Result<String> {
    let mut config = config_of(flight)?;
    config.gps.device = lines[0].into();
    config.compass.device = lines[1].into();
    config.camera.device = format!("capture-loop:{}", camera.display());
    config.store.enabled = true;
    config.store.path = dir.join("card").display().to_string();
    config.store.require_mount = false;
    Ok(config.to_toml()?)
}

/// A thread that works until it is stopped.
struct Background<T> {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<T>,
}

impl<T: Send + 'static> Background<T> {
    /// Starts `work`, which looks whether it has been asked to stop.
    fn start(work: impl FnOnce(&AtomicBool) -> T + Send + 'static) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&stop);
        Self { stop, thread: std::thread::spawn(move || work(&asked)) }
    }

    fn stop(self) -> Result<T> {
        self.stop.store(true, Ordering::Release);
        self.thread.join().map_err(|_| "a thread of the load test panicked".into())
    }
}

/// Computes until it is stopped.
fn compute(asked: &AtomicBool) {
    let mut sum = 0_u64;
    while !asked.load(Ordering::Acquire) {
        sum = std::hint::black_box((0..100_000).fold(sum, |sum, n| sum.rotate_left(5) ^ n));
    }
}

/// What was written into a line, and when.
struct Written {
    t: MonoTime,
    is_gps: bool,
    data: Vec<u8>,
}

/// Both serial lines, and what is written into them.
struct Lines<'a> {
    bytes: &'a Bytes,
    gps: File,
    compass: File,
}

/// Feeds both lines at the real pace, repeatedly; returns what it wrote. The first frame was exposed at `began`, so that
/// bytes and frames have the flight's own times to each other.
fn feed(
    lines: Lines<'_>,
    flight_s: u64,
    began: Instant,
    first_exposure: Span,
    asked: &AtomicBool,
) -> Vec<Written> {
    let Lines { bytes, mut gps, mut compass } = lines;
    let clock = HostClock::start();
    let mut written = Vec::new();
    for round in 0.. {
        for (since, is_gps, data) in bytes {
            let since_exposure = (*since - first_exposure).s().max(0.0);
            let due = Duration::from_secs(round * flight_s) + Duration::from_secs_f64(since_exposure);
            std::thread::sleep(due.saturating_sub(began.elapsed()));
            if asked.load(Ordering::Acquire) {
                return written;
            }
            written.push(Written { t: clock.now(), is_gps: *is_gps, data: data.clone() });
            // Bytes for a line that nobody reads are lost, as on a real one.
            let _ = if *is_gps { &mut gps } else { &mut compass }.write_all(data);
        }
    }
    written
}

/// Prints how long bytes and frames waited for their stamp.
fn report_stamps(card: &Path, written: &[Written]) -> Result<()> {
    let (mut reads, mut frames) = ([Vec::new(), Vec::new()], Vec::new());
    for flight in fs::read_dir(card.join("FLIGHTS"))? {
        for event in CaptureReader::open(&flight?.path())?.filter_map(|item| item.event) {
            match event.body {
                EventBody::Bytes { source, data } => {
                    reads[usize::from(source == Source::Gps)].push((event.t_recv, data));
                }
                EventBody::Frame(frame) => frames.push((event.t_recv - frame.t_exposure).ms()),
                _ => {}
            }
        }
    }
    let mut bytes = Vec::new();
    for of in written {
        let reads = &reads[usize::from(of.is_gps)];
        let next = reads.partition_point(|(t, _)| *t < of.t);
        // A read that begins with other bytes belongs to an earlier write that waited.
        bytes.extend(
            reads.get(next).filter(|(_, data)| data.starts_with(&of.data)).map(|(t, _)| (*t - of.t).ms()),
        );
    }
    let unmatched = written.len() - bytes.len();
    for (what, mut waits) in [("bytes", bytes), ("frames", frames)] {
        waits.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| waits.get((share * waits.len() as f64) as usize).copied().unwrap_or(f64::NAN);
        println!(
            "{what}, ready to stamped, ms: p50 {:.3}, p99 {:.3}, max {:.3} over {}",
            at(0.5),
            at(0.99),
            waits.last().copied().unwrap_or(f64::NAN),
            waits.len()
        );
    }
    println!("writes without a read of their own: {unmatched} of {}", written.len());
    Ok(())
}

/// Sleeps and reads the clock: returns by how much it woke late, milliseconds, where that was 20 or more. For that time
/// the machine itself made a thread wait.
fn stand_by(asked: &AtomicBool) -> Vec<f64> {
    let (nap, mut late) = (Duration::from_millis(5), Vec::new());
    while !asked.load(Ordering::Acquire) {
        let began = Instant::now();
        std::thread::sleep(nap);
        late.extend(Some((began.elapsed() - nap).as_secs_f64() * 1e3).filter(|ms| *ms >= 20.0));
    }
    late
}

/// Resident memory, megabytes.
#[derive(Clone, Copy, Default)]
struct Resident {
    all: f64,
    /// The daemon's own memory, without mapped files.
    own: f64,
}

impl Resident {
    fn of(pid: u32) -> Result<Self> {
        let status = fs::read_to_string(format!("/proc/{pid}/status"))?;
        let megabytes = |name: &str| -> Result<f64> {
            let text = status.lines().find_map(|line| line.strip_prefix(name)?.strip_suffix("kB"));
            Ok(text.ok_or("no memory in /proc")?.trim().parse::<f64>()? * 1024.0 / 1e6)
        };
        Ok(Self { all: megabytes("VmRSS:")?, own: megabytes("RssAnon:")? })
    }
}

/// Resident memory once a second for this time.
fn watch(daemon: &mut Child, seconds: u64) -> Result<Vec<Resident>> {
    let mut memory = Vec::new();
    let began = Instant::now();
    while began.elapsed() < Duration::from_secs(seconds) {
        std::thread::sleep(Duration::from_secs(1));
        if let Some(status) = daemon.try_wait()? {
            return Err(format!("the daemon ended: {status}").into());
        }
        memory.push(Resident::of(daemon.id())?);
    }
    Ok(memory)
}

/// Processor time of every thread, seconds.
fn tasks(pid: u32) -> Result<Vec<(String, f64)>> {
    let mut tasks = Vec::new();
    for entry in fs::read_dir(format!("/proc/{pid}/task"))? {
        let folder = entry?.path();
        let name = fs::read_to_string(folder.join("comm"))?.trim().to_owned();
        // Time on a processor, nanoseconds: the first field.
        let schedule = fs::read_to_string(folder.join("schedstat"))?;
        let ns: f64 = schedule.split_whitespace().next().unwrap_or("0").parse()?;
        tasks.push((name, ns / 1e9));
    }
    tasks.sort_by(|a, b| b.1.total_cmp(&a.1));
    Ok(tasks)
}

fn field<'a>(line: &'a str, name: &str) -> &'a str {
    let found = line.split_whitespace().find_map(|word| word.strip_prefix(name)?.strip_prefix('='));
    found.unwrap_or("none")
}

fn report(log: &str, seconds: u64, memory: &[Resident], tasks: &[(String, f64)]) -> Result<()> {
    let last = |event: &str| {
        let words = format!("event={event}");
        log.lines().rev().find(|line| line.split_whitespace().any(|word| word == words)).unwrap_or_default()
    };
    let (latencies, health) = (last("latencies"), last("health"));
    println!(
        "exposure to estimate, ms: p50 {}, p99 {}, max {} over {} frames",
        field(latencies, "p50_ms"),
        field(latencies, "p99_ms"),
        field(latencies, "max_ms"),
        field(latencies, "frames")
    );
    println!(
        "dropped before the pipeline: {}; not recorded: {}",
        field(health, "dropped"),
        field(health, "card_dropped")
    );
    let all: f64 = tasks.iter().map(|task| task.1).sum();
    println!("threads: {}", tasks.len());
    println!("processor, share of one core: {:.1} %", all / seconds as f64 * 100.0);
    for (name, used) in tasks.iter().filter(|task| task.1 > 0.0005 * seconds as f64) {
        println!("  {name:15} {:5.1} %", used / seconds as f64 * 100.0);
    }
    let most = |part: &[Resident]| {
        part.iter().fold(Resident::default(), |most, now| if now.all > most.all { *now } else { most })
    };
    let largest = most(memory);
    println!(
        "resident, MB: {:.0} at most, {:.0} of it the daemon's own; at most in each tenth of the time:",
        largest.all, largest.own
    );
    let tenths = memory.chunks(memory.len().div_ceil(10).max(1));
    println!("  {}", tenths.map(|part| format!("{:.0}", most(part).all)).collect::<Vec<_>>().join(" "));
    let load = fs::read_to_string("/proc/loadavg")?;
    println!(
        "load of the machine: {}on {} processors",
        load.split(' ').take(3).map(|l| format!("{l} ")).collect::<String>(),
        std::thread::available_parallelism()?
    );
    println!("last health: {health}");
    Ok(())
}
