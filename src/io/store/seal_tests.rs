//! Segments cut and damaged at many places, sealed, and read by a strict reader.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use super::flight;
use super::format::Compression;
use super::record::{ChannelDef, Definitions, RawRecord, Weight};
use super::scan::SegmentFile;
use super::seal::{Sealing, seal_segment};
use super::segment::{Head, SegmentWriter};
use super::volume::Volume;

const PER_CHUNK: u32 = 7;

fn channel(topic: &str) -> Arc<ChannelDef> {
    Arc::new(ChannelDef {
        topic: topic.into(),
        schema_name: format!("test.{}", topic.len()),
        schema_encoding: "protobuf".into(),
        schema: vec![7; 600],
        message_encoding: "protobuf".into(),
        backfill: false,
        frame_numbers: false,
    })
}

/// Message `i` of a segment, of a size that makes chunks cross pages irregularly.
fn record(channels: &[Arc<ChannelDef>], i: u32) -> RawRecord {
    let data: Vec<u8> = (0..200 + (i as usize * 7919) % 3000).map(|k| (k as u32 ^ (i * 31)) as u8).collect();
    RawRecord {
        channel: Arc::clone(&channels[i as usize % channels.len()]),
        log_ns: 1_000_000_000 + u64::from(i) * 100_000_000,
        publish_ns: 1_000_000_000 + u64::from(i) * 100_000_000,
        sequence: i,
        data: data.into(),
        weight: Weight::Small,
    }
}

/// Writes segment `number` with `chunks` chunks; returns its bytes and where each commit ended.
fn write_segment(volume: &Volume, number: u32, chunks: u32, finish: bool) -> (Vec<u8>, Vec<u64>) {
    let channels = [channel("/gps/serial"), channel("/camera/image"), channel("/target/ugv/state")];
    let mut definitions = Definitions::default();
    for channel in &channels {
        definitions.number(channel);
    }
    let head = Head {
        config: "[gps]\n".repeat(40),
        metadata: BTreeMap::from([("session".into(), "3".into())]),
        time_ns: 1_000_000_000,
    };
    let name = flight::segment_name(number);
    let mut segment =
        SegmentWriter::create(volume, ("F", &name), &head, &definitions, Compression::Lz4).unwrap();
    let mut ends = Vec::new();
    for chunk in 0..chunks {
        for i in 0..PER_CHUNK {
            segment.push(&mut definitions, &record(&channels, chunk * PER_CHUNK + i)).unwrap();
        }
        segment.commit().unwrap();
        ends.push(segment.len());
    }
    if finish {
        segment.finish(&definitions).unwrap();
    }
    (std::fs::read(volume.path(&format!("F/{name}"))).unwrap(), ends)
}

/// Sequence numbers of all messages, read by the `mcap` crate with all its checks.
fn read_strictly(path: &Path) -> BTreeSet<u32> {
    let bytes = std::fs::read(path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().expect("has a summary");
    let options = mcap::read::Options::ValidateChunkCrcs.into();
    let linear: BTreeSet<u32> = mcap::MessageStream::new_with_options(&bytes, options)
        .unwrap()
        .map(|message| message.unwrap().sequence)
        .collect();
    let mut indexed = BTreeSet::new();
    for chunk in &summary.chunk_indexes {
        for (_, entries) in summary.read_message_indexes(&bytes, chunk).unwrap() {
            for entry in entries {
                indexed.insert(summary.seek_message(&bytes, chunk, &entry).unwrap().sequence);
            }
        }
    }
    assert_eq!(linear, indexed, "the index has the same messages");
    assert_eq!(summary.stats.expect("has statistics").message_count, linear.len() as u64);
    for index in &summary.attachment_indexes {
        assert_eq!(mcap::read::attachment(&bytes, index).unwrap().name, "config.toml");
    }
    linear
}

fn fresh() -> (tempfile::TempDir, Volume) {
    let dir = tempfile::tempdir().unwrap();
    let volume = Volume::new(dir.path());
    volume.create_dir("F").unwrap();
    (dir, volume)
}

#[test]
fn a_finished_segment_needs_nothing() {
    let (_dir, volume) = fresh();
    write_segment(&volume, 0, 4, true);
    assert_eq!(seal_segment(&volume, "F", "000000.mcap", true).unwrap(), Sealing::Whole);
    assert_eq!(read_strictly(&volume.path("F/000000.mcap")).len(), 4 * PER_CHUNK as usize);
    let sealed = SegmentFile::open(&volume.path("F/000000.mcap")).unwrap().sealed().unwrap();
    assert_eq!(sealed.metadata["session"], "3");
    assert_eq!(sealed.topics["/gps/serial"].first_ns, 1_000_000_000);
}

#[test]
fn a_segment_cut_anywhere_keeps_every_whole_chunk() {
    let (_dir, volume) = fresh();
    let (bytes, ends) = write_segment(&volume, 0, 4, true);
    let path = volume.path("F/000000.mcap");
    for cut in (0..bytes.len()).step_by(397).chain(ends.iter().map(|e| *e as usize)) {
        std::fs::write(&path, &bytes[..cut]).unwrap();
        let sealing = seal_segment(&volume, "F", "000000.mcap", false).unwrap();
        let committed = ends.iter().filter(|end| **end as usize <= cut).count();
        if sealing == Sealing::Removed {
            assert_eq!(committed, 0, "cut at {cut}");
            continue;
        }
        let read = read_strictly(&path);
        assert!(read.len() >= committed * PER_CHUNK as usize, "cut at {cut}: {} of {committed}", read.len());
        assert_eq!(read.len() % PER_CHUNK as usize, 0, "cut at {cut}");
        assert_eq!(seal_segment(&volume, "F", "000000.mcap", true).unwrap(), Sealing::Whole, "cut at {cut}");
    }
}

#[test]
fn a_segment_holed_anywhere_keeps_every_other_chunk() {
    let (_dir, volume) = fresh();
    let (bytes, ends) = write_segment(&volume, 0, 6, true);
    let path = volume.path("F/000000.mcap");
    for page in 0..bytes.len() / 4096 {
        for fill in [0x00, 0xFF, 0x5A] {
            let mut holed = bytes.clone();
            holed[page * 4096..(page + 1) * 4096].fill(fill);
            std::fs::write(&path, &holed).unwrap();
            seal_segment(&volume, "F", "000000.mcap", true).unwrap();
            let read = read_strictly(&path);
            // The last page of commits is summary; a page affects one commit, or the head.
            let hit = ends.iter().filter(|end| (page as u64 * 4096) < **end).count().min(1);
            assert!(
                read.len() >= (6 - hit) * PER_CHUNK as usize,
                "page {page} filled with {fill}: {} messages",
                read.len()
            );
        }
    }
}

#[test]
fn a_lost_head_is_found_again_in_the_neighbour() {
    let (_dir, volume) = fresh();
    let (bytes, ends) = write_segment(&volume, 0, 2, false);
    write_segment(&volume, 1, 2, true);
    // Head and first chunk, and with them every definition in the file, are lost.
    let mut holed = bytes;
    holed[..ends[0] as usize].fill(0);
    let path = volume.path("F/000000.mcap");
    std::fs::write(&path, &holed).unwrap();
    let sealing = seal_segment(&volume, "F", "000000.mcap", false).unwrap();
    assert!(matches!(sealing, Sealing::Rewritten { chunks: 1, .. }), "{sealing:?}");
    let kept: Vec<u32> = read_strictly(&path).into_iter().collect();
    assert_eq!(kept, (PER_CHUNK..2 * PER_CHUNK).collect::<Vec<_>>());
}

#[test]
fn arbitrary_bytes_never_panic_and_never_become_data() {
    use rand::{RngCore, SeedableRng};
    let (_dir, volume) = fresh();
    let (bytes, _) = write_segment(&volume, 0, 3, true);
    let path = volume.path("F/000000.mcap");
    let seed = 20_261_122;
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    for round in 0..150 {
        let mut damaged = bytes.clone();
        for _ in 0..1 + random.next_u32() % 12 {
            let at = random.next_u32() as usize % damaged.len();
            damaged[at] ^= (1 + random.next_u32() % 255) as u8;
        }
        std::fs::write(&path, &damaged).unwrap();
        let sealing = seal_segment(&volume, "F", "000000.mcap", true).unwrap();
        if sealing != Sealing::Removed {
            let read = read_strictly(&path);
            assert!(read.iter().all(|i| *i < 3 * PER_CHUNK), "seed {seed} round {round}");
        } else {
            std::fs::write(&path, &bytes).unwrap();
        }
    }
}
