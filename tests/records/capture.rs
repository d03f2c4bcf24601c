//! Captures: the content is read back, whatever happened to the file in between.

use std::path::Path;

use windhover::io::capture::{CaptureReader, CaptureWriter, attached_config};
use windhover_base::msg::{Event, EventBody, FrameEncoding, FramePayload, Source};
use windhover_base::time::{MonoTime, Span};

const CONFIG: &str = "# a configuration\n";

fn at(ms: i64) -> MonoTime {
    MonoTime::from_ns(1_795_014_245_000_000_000) + Span::from_ns(ms * 1_000_000)
}

/// Five seconds of all three sources, and a loss.
fn events() -> Vec<Event> {
    let mut events = Vec::new();
    for i in 0..100_i64 {
        let body = match i % 4 {
            0 => EventBody::Bytes { source: Source::Gps, data: format!("$GPGGA,{i}").into_bytes() },
            1 => EventBody::Bytes { source: Source::Compass, data: vec![0xff, i as u8, 0] },
            2 => EventBody::Frame(FramePayload {
                index: (i / 4) as u32,
                t_exposure: at(i * 50 - 7),
                encoding: if i % 8 == 2 { FrameEncoding::Grey } else { FrameEncoding::Jpeg },
                width: if i % 8 == 2 { 4 } else { 0 },
                height: if i % 8 == 2 { 2 } else { 0 },
                stride: if i % 8 == 2 { 4 } else { 0 },
                data: vec![i as u8; 8].into(),
            }),
            _ => EventBody::Dropped { source: Source::Camera, count: 3 },
        };
        events.push(Event { t_recv: at(i * 50), seq: i as u64, body });
    }
    events
}

fn write(path: &Path) {
    let mut writer = CaptureWriter::create(path, CONFIG, at(0)).unwrap();
    for event in events() {
        writer.write(&event).unwrap();
    }
    writer.finish().unwrap();
}

fn read(path: &Path) -> (Vec<Event>, Vec<String>) {
    let mut reader = CaptureReader::open(path).unwrap();
    let events = reader.by_ref().filter_map(|item| item.event).collect();
    (events, reader.take_warnings())
}

#[test]
fn what_goes_in_comes_out() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("capture.mcap");
    write(&path);
    let (got, warnings) = read(&path);
    assert_eq!(format!("{got:?}"), format!("{:?}", events()));
    assert!(warnings.is_empty(), "{warnings:?}");
    assert_eq!(attached_config(&path).unwrap().as_deref(), Some(CONFIG));
}

#[test]
fn a_cut_anywhere_leaves_a_prefix_and_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole.mcap");
    write(&whole);
    let bytes = std::fs::read(&whole).unwrap();
    let all: Vec<String> = events().iter().map(|e| format!("{e:?}")).collect();
    let cut = folder.path().join("cut.mcap");
    let mut most = 0;
    for length in (8..bytes.len()).step_by(37) {
        std::fs::write(&cut, &bytes[..length]).unwrap();
        let (got, warnings) = read(&cut);
        let got: Vec<String> = got.iter().map(|e| format!("{e:?}")).collect();
        assert_eq!(got, all[..got.len()], "cut at {length}");
        assert!(got.len() == all.len() || !warnings.is_empty(), "cut at {length} went unnoticed");
        most = most.max(got.len());
    }
    assert_eq!(most, all.len());
}

#[test]
fn a_wrong_byte_costs_a_chunk_at_most_and_never_the_program() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("hit.mcap");
    write(&path);
    let bytes = std::fs::read(&path).unwrap();
    for at in (8..bytes.len()).step_by(53) {
        let mut hit = bytes.clone();
        hit[at] ^= 0x55;
        std::fs::write(&path, &hit).unwrap();
        let (got, _) = read(&path);
        assert!(got.len() <= events().len());
        let _ = attached_config(&path).unwrap();
    }
}

#[test]
fn a_stamp_that_cannot_be_costs_its_message() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("capture.mcap");
    let mut writer = CaptureWriter::create(&path, CONFIG, at(0)).unwrap();
    let event = |t_recv| Event { t_recv, seq: 0, body: EventBody::SourceUp(Source::Gps) };
    for t_recv in [at(0), at(50), MonoTime::from_ns(i64::MAX)] {
        writer.write(&event(t_recv)).unwrap();
    }
    writer.finish().unwrap();
    let (got, warnings) = read(&path);
    assert_eq!(got.iter().map(|event| event.t_recv).collect::<Vec<_>>(), [at(0), at(50)]);
    assert!(matches!(&warnings[..], [one] if one.contains("damaged and skipped")), "{warnings:?}");
}

#[test]
fn other_files_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notes.mcap");
    std::fs::write(&path, "dear diary").unwrap();
    let error = CaptureReader::open(&path).err().expect("not a recording").to_string();
    assert!(error.contains("notes.mcap") && error.contains("not an MCAP"), "{error}");
    let error = CaptureReader::open(folder.path().join("none").as_path()).err().expect("absent").to_string();
    assert!(error.contains("none"), "{error}");
}
