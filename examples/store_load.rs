//! Records a synthetic flight as the daemon would, and prints the costs.
//!
//! `cargo run --release --example store_load -- DIR [--seconds S] [--fps F] [--frames POLICY] [--estimates-hz H]
//! [--acks]`
//!
//! Prints processor time by thread, bytes handed to the block layer (`/proc/self/io`), bytes of data, commit times.
//! With `--acks` it prints `ack N` whenever numbered GPS lines up to N are known to be durable, which the kill -9 test
//! checks.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use clap::Parser;
use windhover::config::{FramePolicy, StoreConfig};
use windhover::io::clock::HostClock;
use windhover::io::records::{Record, Schema, topic};
use windhover::io::store::index::{Change, Index, QueuedRecord};
use windhover::io::store::volume::Volume;
use windhover::io::store::{Store, StoreHandle};
use windhover_base::msg::{Event, EventBody, FrameEncoding, FramePayload, Source};
use windhover_base::time::{MonoTime, Span};

#[derive(Parser)]
struct Args {
    /// Directory of the store
    dir: std::path::PathBuf,
    /// How long
    #[arg(long, default_value_t = 30.0)]
    seconds: f64,
    /// Frames a second, 1280×1024 grey; 0 for none
    #[arg(long, default_value_t = 30.0)]
    fps: f64,
    /// jpeg, png, zstd, region or none
    #[arg(long, default_value = "jpeg")]
    frames: String,
    /// Numbered estimates a second
    #[arg(long, default_value_t = 15.0)]
    estimates_hz: f64,
    /// Megabytes that must stay free
    #[arg(long, default_value_t = 64)]
    floor_mb: u64,
    /// Only the index: one commit for each second of `--seconds`, with `--estimates-hz` records, as fast as possible
    #[arg(long)]
    index_only: bool,
    /// Print what is durable
    #[arg(long)]
    acks: bool,
}

const WIDTH: usize = 1280;
const HEIGHT: usize = 1024;

/// A ground with texture and sensor noise, so that JPEG has its usual work: sums of sines and a hash.
fn picture(shift: usize) -> Arc<[u8]> {
    let mut data = vec![0; WIDTH * HEIGHT];
    for v in 0..HEIGHT {
        for u in 0..WIDTH {
            let (x, y) = ((u + shift) as f32, v as f32);
            let ground =
                110.0 + 30.0 * (x * 0.031).sin() * (y * 0.017).cos() + 18.0 * (x * 0.21 + y * 0.13).sin();
            let noise = (((u * 73_856_093) ^ (v * 19_349_663) ^ (shift * 83_492_791)) >> 7) as u8 % 9;
            data[v * WIDTH + u] = ground as u8 + noise;
        }
    }
    data.into()
}

/// Processor time by thread name, seconds.
fn thread_times() -> BTreeMap<String, f64> {
    let mut times = BTreeMap::new();
    for task in std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten() {
        let Ok(stat) = std::fs::read_to_string(task.path().join("stat")) else { continue };
        let Some((head, tail)) = stat.rsplit_once(')') else { continue };
        let name = head.split_once('(').map_or("", |(_, name)| name).to_owned();
        let fields: Vec<&str> = tail.split_whitespace().collect();
        let ticks = |at: usize| fields.get(at).and_then(|f| f.parse::<f64>().ok()).unwrap_or(0.0);
        *times.entry(name).or_default() += (ticks(11) + ticks(12)) / 100.0;
    }
    times
}

fn bytes_to_block_layer() -> u64 {
    let io = std::fs::read_to_string("/proc/self/io").unwrap_or_default();
    io.lines().find_map(|l| l.strip_prefix("write_bytes: ")?.parse().ok()).unwrap_or(0)
}

struct Feeder {
    handle: StoreHandle,
    clock: HostClock,
    pictures: Vec<Arc<[u8]>>,
    bytes: u64,
    fed: u32,
    frames: u32,
    estimates: u32,
}

impl Feeder {
    fn event(&mut self, seq: u64, body: EventBody) {
        self.handle.event(&Event { t_recv: self.clock.now(), seq, body });
    }

    fn serial(&mut self) {
        let line = format!("$GPGGA,{:08},4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n", self.fed);
        self.bytes += 2 * line.len() as u64;
        self.event(
            u64::from(self.fed),
            EventBody::Bytes { source: Source::Gps, data: line.clone().into_bytes() },
        );
        self.event(
            u64::from(self.fed),
            EventBody::Bytes { source: Source::Compass, data: line.into_bytes() },
        );
        self.fed += 1;
    }

    fn frame(&mut self) {
        let data = Arc::clone(&self.pictures[self.frames as usize % self.pictures.len()]);
        let t_exposure = self.clock.now();
        let (width, height, stride) = (WIDTH as u32, HEIGHT as u32, WIDTH as u32);
        let encoding = FrameEncoding::Grey;
        let frame = FramePayload { index: self.frames, t_exposure, encoding, width, height, stride, data };
        self.event(u64::from(self.frames), EventBody::Frame(frame));
        self.frames += 1;
    }

    fn estimate(&mut self) {
        let now = self.clock.now();
        let data: Vec<u8> = (0..160u32).map(|k| (k * self.estimates) as u8).collect();
        self.bytes += data.len() as u64;
        let topic = topic::target_state("ugv").into();
        let record = Record { topic, schema: Schema::TargetState, log_time: now, publish_time: now, data };
        self.handle.record(Arc::new(record), Some(self.estimates));
        self.estimates += 1;
    }
}

/// Feeds at the requested rates; prints acknowledgements meanwhile.
fn feed(args: &Args, feeder: &mut Feeder, began: MonoTime) {
    let handle = feeder.handle.clone();
    // Lines fed before a commit ended are durable after the next one: the encoder is not later than that.
    let (mut seen, mut before) = (handle.status().last_commit_ns, None);
    loop {
        let elapsed = (feeder.clock.now() - began).s();
        if elapsed >= args.seconds {
            return;
        }
        while f64::from(feeder.fed) < elapsed * 20.0 {
            feeder.serial();
        }
        while args.fps > 0.0 && f64::from(feeder.frames) < elapsed * args.fps {
            feeder.frame();
        }
        while f64::from(feeder.estimates) < elapsed * args.estimates_hz {
            feeder.estimate();
        }
        let commit = handle.status().last_commit_ns;
        if args.acks && commit != seen {
            seen = commit;
            if let Some(n) = before.replace(feeder.fed) {
                println!("ack {n}");
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Commits queue records to an index alone; prints bytes to the block layer for each byte of data.
fn index_only(args: &Args) {
    let index = Index::open(&args.dir.join("index")).expect("a directory to write to");
    let (mut bytes, before) = (0, bytes_to_block_layer());
    let each = args.estimates_hz as u32;
    for commit in 0..args.seconds as u32 {
        let record = |n: u32| QueuedRecord {
            topic: topic::target_state("ugv"),
            schema: Schema::TargetState.name().into(),
            log_ns: u64::from(n) << 26,
            publish_ns: u64::from(n) << 26,
            data: (0..160u32).map(|k| (k.wrapping_mul(n) >> 2) as u8).collect(),
        };
        let changes: Vec<Change> =
            (commit * each..(commit + 1) * each).map(|n| Change::Queue(1, n, record(n))).collect();
        bytes += changes.len() as u64 * (160 + 17 + 20 + 16 + 2 + 9);
        index.apply(&changes).expect("commits");
    }
    drop(index);
    let written = bytes_to_block_layer() - before;
    println!(
        "index: {bytes} bytes of records, {written} to the block layer: {:.2}",
        written as f64 / bytes as f64
    );
}

fn main() {
    let args = Args::parse();
    if args.index_only {
        return index_only(&args);
    }
    let policy: FramePolicy =
        serde_json::from_value(args.frames.clone().into()).expect("jpeg, png, zstd, region or none");
    let config = StoreConfig {
        frames: policy,
        free_floor_mb: args.floor_mb,
        free_target_mb: 0,
        ..StoreConfig::default()
    };
    let clock = HostClock::start();
    let (store, notices) =
        Store::start_on(Volume::new(Path::new(&args.dir)), &config, "[gps]\n".into(), clock);
    let pictures = if args.fps > 0.0 { (0..8).map(|i| picture(i * 5)).collect() } else { Vec::new() };
    let handle = store.handle();
    let mut feeder =
        Feeder { handle: handle.clone(), clock, pictures, bytes: 0, fed: 0, frames: 0, estimates: 0 };
    let (io_before, began) = (bytes_to_block_layer(), clock.now());
    feed(&args, &mut feeder, began);
    let times = thread_times();
    let status = handle.status();
    store.stop();
    let seconds: f64 = (clock.now() - began).s().max(Span::from_ms(1.0).s());
    for notice in notices.try_iter() {
        println!("{}: {notice}", notice.name());
    }
    let segments = handle.status().bytes_written;
    let written = bytes_to_block_layer() - io_before;
    println!(
        "{seconds:.1} s, {} frames, {} serial lines, {} estimates",
        feeder.frames,
        feeder.fed * 2,
        feeder.estimates
    );
    for (name, used) in times.iter().filter(|(name, _)| name.starts_with("store")) {
        println!("{name}: {:.1} % of a core", used / seconds * 100.0);
    }
    println!(
        "segments {segments} bytes, block layer {written} bytes: {:.3}",
        written as f64 / segments.max(1) as f64
    );
    println!(
        "commit p99 {:.1} ms, max {:.1} ms; {} messages dropped",
        status.fsync_p99_ms, status.fsync_max_ms, status.dropped_messages
    );
}
