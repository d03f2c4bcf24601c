//! Hostile MCAP files: a reader's memory depends on the file's content, not on the lengths that it states.

use std::alloc::{GlobalAlloc, Layout, System};
use std::collections::BTreeMap;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use mcap::records::{Channel, op};
use windhover::io::capture::{CaptureReader, attached_config};
use windhover::io::mcap_read::McapReader;
use windhover::io::store::format::{
    Compression, MAGIC, put_channel, put_chunk, put_message, put_record, put_schema, put_str, put_u16,
    put_u64,
};
use windhover::io::store::scan::SegmentFile;

/// Counts what is allocated, and the most there ever was.
struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

fn took(bytes: usize) {
    MOST.fetch_max(NOW.fetch_add(bytes, Ordering::Relaxed) + bytes, Ordering::Relaxed);
}

// SAFETY: every call is passed on unchanged to the system's allocator; the counters are atomics.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        took(layout.size());
        // SAFETY: the caller's obligations are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the pointer came from the system's allocator, by `alloc` above.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const MB: usize = 1 << 20;

/// Largest number of megabytes that `work` allocated in addition.
fn megabytes(work: impl FnOnce()) -> usize {
    let before = NOW.load(Ordering::Relaxed);
    MOST.store(before, Ordering::Relaxed);
    work();
    MOST.load(Ordering::Relaxed).saturating_sub(before).div_ceil(MB)
}

/// Reads it in every way; returns the number of messages.
fn read_all(path: &Path) -> usize {
    let messages = McapReader::open(path).unwrap().count();
    assert!(CaptureReader::open(path).unwrap().count() <= messages);
    let _ = attached_config(path).unwrap();
    let segment = SegmentFile::open(path).unwrap();
    let _ = (segment.sealed().is_some(), segment.salvage().chunks.len());
    messages
}

fn channel(id: u16, topic: &str) -> Channel {
    let (message_encoding, metadata) = (String::new(), BTreeMap::new());
    Channel { id, schema_id: 1, topic: topic.into(), message_encoding, metadata }
}

fn chunk(out: &mut Vec<u8>, records: &[u8]) {
    put_chunk(out, records, (0, 0), Compression::Zstd).unwrap();
}

/// A file of these bytes behind the magic, and the most megabytes reading it took.
fn cost(bytes: &[u8]) -> (usize, usize) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("hostile.mcap");
    std::fs::write(&path, [&MAGIC, bytes].concat()).unwrap();
    let mut messages = 0;
    let most = megabytes(|| messages = read_all(&path));
    (messages, most)
}

/// One test: allocations are counted for the whole process.
#[test]
fn what_a_file_claims_costs_nothing() {
    many_channels_share_a_long_schema();
    strings_that_claim_gigabytes();
    records_that_claim_more_than_a_sparse_file_holds();
    bombs_of_definitions_and_of_messages();
    a_wreck_does_not_fill_memory_with_warnings();
}

fn many_channels_share_a_long_schema() {
    let mut bytes = Vec::new();
    put_schema(&mut bytes, 1, "long", "protobuf", &vec![7; 8 * MB]);
    for id in 1..1000 {
        put_channel(&mut bytes, &channel(id, &format!("/{id}")));
        put_message(&mut bytes, id, 0, 0, 0, b"x");
    }
    let (messages, most) = cost(&bytes);
    assert_eq!(messages, 999);
    assert!(most < 48, "{most} MB for one schema of 8 MB");
}

fn strings_that_claim_gigabytes() {
    let mut bytes = Vec::new();
    for code in 0..0x10 {
        put_record(&mut bytes, code, |b| b.extend([0xff; 80]));
        put_record(&mut bytes, code, |b| b.extend([0x7f; 80]));
    }
    let mut inside = Vec::new();
    put_record(&mut inside, op::CHANNEL, |b| {
        put_u16(b, 1);
        put_u16(b, 1);
        b.extend(u32::MAX.to_le_bytes());
    });
    chunk(&mut bytes, &inside);
    // A chunk of a few bytes that states an uncompressed size at the limit, and above it.
    for says in [1u64 << 28, 1 << 62] {
        put_record(&mut bytes, op::CHUNK, |b| {
            put_u64(b, 0);
            put_u64(b, 0);
            put_u64(b, says);
            b.extend([0; 4]);
            put_str(b, "lz4");
            put_u64(b, 4);
            b.extend([4, 34, 77, 24]);
        });
    }
    let (messages, most) = cost(&bytes);
    assert_eq!(messages, 0);
    assert!(most < 16, "{most} MB for a few hundred bytes");
}

fn records_that_claim_more_than_a_sparse_file_holds() {
    let folder = tempfile::tempdir().unwrap();
    for (code, length) in [(op::ATTACHMENT, 6u64 << 30), (op::CHUNK, 6 << 30), (op::MESSAGE, 6 << 30)] {
        let path = folder.path().join(format!("{code}.mcap"));
        let mut file = std::fs::File::create(&path).unwrap();
        file.write_all(&MAGIC).unwrap();
        file.write_all(&[code]).unwrap();
        file.write_all(&length.to_le_bytes()).unwrap();
        file.seek(SeekFrom::Start(17 + length)).unwrap();
        let mut after = Vec::new();
        put_channel(&mut after, &channel(1, "/after"));
        put_message(&mut after, 1, 0, 0, 0, b"still read");
        file.write_all(&after).unwrap();
        drop(file);
        let mut messages = 0;
        // Not salvaged: six gigabytes of pages would be looked at one by one.
        let most = megabytes(|| {
            messages = McapReader::open(&path).unwrap().count();
            assert_eq!(attached_config(&path).unwrap(), None);
        });
        assert_eq!(messages, 1, "op code {code}: what follows is read");
        assert!(most < 16, "op code {code}: {most} MB");
    }
}

fn bombs_of_definitions_and_of_messages() {
    let mut bytes = Vec::new();
    let topic = "x".repeat(8 * MB);
    for bomb in 0..30u16 {
        let mut inside = Vec::new();
        (0..4).for_each(|k| put_channel(&mut inside, &channel(bomb * 4 + k, &topic)));
        chunk(&mut bytes, &inside);
    }
    assert!(bytes.len() < MB, "the bomb is small: {}", bytes.len());
    let path = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(path.path(), [&MAGIC, &bytes[..]].concat()).unwrap();
    let mut warnings = Vec::new();
    let most = megabytes(|| {
        let mut reader = McapReader::open(path.path()).unwrap();
        assert_eq!(reader.by_ref().count(), 0);
        warnings = reader.take_warnings();
    });
    assert!(most < 64 + 4 * 32, "{most} MB of 960");
    assert!(warnings.iter().any(|w| w.contains("more schemas and channels")), "{warnings:?}");

    let mut inside = Vec::new();
    put_channel(&mut inside, &channel(1, "/tiny"));
    (0..1_000_000).for_each(|n| put_message(&mut inside, 1, n, 0, 0, b""));
    let mut bytes = Vec::new();
    (0..3).for_each(|_| chunk(&mut bytes, &inside));
    std::fs::write(path.path(), [&MAGIC, &bytes[..]].concat()).unwrap();
    drop(inside);
    let most = megabytes(|| assert_eq!(McapReader::open(path.path()).unwrap().count(), 3_000_000));
    assert!(most < 128, "{most} MB to stream 3,000,000 messages");
    let most = megabytes(|| assert_eq!(CaptureReader::open(path.path()).unwrap().count(), 3_000_000));
    assert!(most < 640, "{most} MB to put them in order");
}

fn a_wreck_does_not_fill_memory_with_warnings() {
    let mut bytes = Vec::new();
    (0..200_000).for_each(|_| put_record(&mut bytes, op::SCHEMA, |_| {}));
    let (messages, most) = cost(&bytes);
    assert_eq!(messages, 0);
    assert!(most < 16, "{most} MB");
}
