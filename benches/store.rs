//! Costs of the store: encoding a frame, committing a second, listing, looking up.

use std::hint::black_box;
use std::sync::Arc;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use windhover::config::{FramePolicy, StoreConfig};
use windhover::io::store::flight_writer::{FlightWriter, SegmentLimits};
use windhover::io::store::format::Compression;
use windhover::io::store::frame_keeper::FrameKeeper;
use windhover::io::store::record::{ChannelDef, RawRecord, Weight};
use windhover::io::store::segment::Head;
use windhover::io::store::volume::Volume;
use windhover::io::store::{flight, inspect};
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::MonoTime;

fn frame() -> FramePayload {
    let (width, height) = (1280usize, 1024usize);
    let mut data = vec![0u8; width * height];
    for v in 0..height {
        for u in 0..width {
            let (x, y) = (u as f32, v as f32);
            let ground =
                110.0 + 30.0 * (x * 0.031).sin() * (y * 0.017).cos() + 18.0 * (x * 0.21 + y * 0.13).sin();
            data[v * width + u] = ground as u8 + (((u * 73_856_093) ^ (v * 19_349_663)) >> 7) as u8 % 9;
        }
    }
    FramePayload {
        index: 0,
        t_exposure: MonoTime::from_ns(0),
        encoding: FrameEncoding::Grey,
        width: width as u32,
        height: height as u32,
        stride: width as u32,
        data: Arc::from(data),
    }
}

fn frames(c: &mut Criterion) {
    let frame = frame();
    let mut group = c.benchmark_group("frame 1280x1024");
    group.throughput(Throughput::Elements(1));
    for frames in [FramePolicy::Jpeg, FramePolicy::Png] {
        let keeper = FrameKeeper::new(&StoreConfig { frames, ..StoreConfig::default() });
        let size = keeper.keep(&frame, None).map_or(0, |f| f.data.len());
        group.bench_function(format!("{frames:?} ({size} bytes)"), |b| {
            b.iter(|| keeper.keep(black_box(&frame), None));
        });
    }
    group.finish();
}

fn second_of(frame_bytes: usize, now_ns: u64) -> Vec<RawRecord> {
    let channel =
        |topic: &str| Arc::new(ChannelDef { schema: vec![1; 2000], ..(*ChannelDef::json(topic)).clone() });
    let (small, large) = (channel("/gps/serial"), channel("/camera/image"));
    let record = |channel: &Arc<ChannelDef>, weight, size: usize, k: u64| RawRecord {
        channel: Arc::clone(channel),
        log_ns: now_ns + k * 10_000_000,
        publish_ns: now_ns,
        sequence: k as u32,
        data: (0..size).map(|i| ((i as u64 * 2_654_435_761) >> 11) as u8).collect::<Vec<_>>().into(),
        weight,
    };
    let mut all: Vec<_> = (0..60).map(|k| record(&small, Weight::Small, 150, k)).collect();
    if frame_bytes > 0 {
        all.extend((0..30).map(|k| record(&large, Weight::Frame, frame_bytes, k)));
    }
    all
}

fn commits(c: &mut Criterion) {
    let mut group = c.benchmark_group("commit a second");
    for (name, frame_bytes) in [("without frames", 0), ("30 frames of 176 kB", 176_000)] {
        let dir = tempfile::tempdir().expect("a directory");
        let limits =
            SegmentLimits { span_ns: 60_000_000_000, bytes: 512 << 20, frame_compression: Compression::None };
        let mut flight =
            FlightWriter::begin(&Volume::new(dir.path()), 1, None, Head::default(), limits).expect("begins");
        let records = second_of(frame_bytes, 1);
        group.sample_size(20);
        group.bench_function(name, |b| {
            b.iter(|| {
                records.iter().for_each(|r| flight.push(r).expect("pushes"));
                flight.commit(1).expect("commits")
            });
        });
    }
    group.finish();
}

fn lists(c: &mut Criterion) {
    let dir = tempfile::tempdir().expect("a directory");
    let volume = Volume::new(dir.path());
    for session in 1..=1000 {
        let name = flight::create_flight(&volume, session, None).expect("creates");
        let info = flight::FlightInfo { session, closed: true, ..flight::FlightInfo::default() };
        let bytes = serde_json::to_vec(&info).expect("is JSON");
        std::fs::write(dir.path().join(flight::FLIGHTS).join(name).join(flight::FLIGHT_FILE), bytes)
            .expect("writes");
    }
    c.bench_function("list 1000 flights", |b| {
        b.iter(|| inspect::list(black_box(dir.path())).expect("lists"))
    });
}

criterion_group!(benches, frames, commits, lists);
criterion_main!(benches);
