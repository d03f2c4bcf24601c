//! A flight without a camera: the helicopter's own state continues, in every output, and the program reports what is
//! missing.

use std::path::{Path, PathBuf};
use std::process::Command;

use prost::Message as _;
use windhover::io::capture::{CaptureReader, CaptureWriter, attached_config};
use windhover::io::proto::windhover as wh;
use windhover_base::msg::EventBody;

/// The small capture without its frames.
fn blind_capture(dir: &Path) -> PathBuf {
    let whole = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures/follow.mcap");
    let config = attached_config(&whole).unwrap().expect("the capture has its configuration");
    let events: Vec<_> = CaptureReader::open(&whole).unwrap().filter_map(|item| item.event).collect();
    let blind = dir.join("blind.mcap");
    let mut writer = CaptureWriter::create(&blind, &config, events[0].t_recv).unwrap();
    for event in events.iter().filter(|event| !matches!(event.body, EventBody::Frame(_))) {
        writer.write(event).unwrap();
    }
    writer.finish().unwrap();
    blind
}

/// Runs the program; gives what it wrote to standard error.
fn windhover(dir: &Path, args: &[&str]) -> String {
    let run = Command::new(env!("CARGO_BIN_EXE_windhover")).args(args).current_dir(dir).output().unwrap();
    let said = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(run.status.success(), "{args:?}: {said}");
    said
}

/// Rows of the table of own states: time, frame, the rest.
fn own_rows(dir: &Path, tables: &str) -> Vec<(i64, String, String)> {
    let text = std::fs::read_to_string(dir.join(tables).join("ownship.csv")).unwrap();
    let row = |line: &str| {
        let mut fields = line.splitn(3, ',').map(str::to_owned);
        let mut field = || fields.next().expect("three fields at least");
        (field().parse().expect("a time"), field(), field())
    };
    text.lines().skip(1).map(row).collect()
}

#[test]
fn own_states_come_at_their_own_rate_in_every_output() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    blind_capture(dir);
    // When a flight without frames is replayed.
    let said = windhover(dir, &["replay", "blind.mcap", "--out", "flight.mcap"]);
    assert!(said.contains("0 frames") && said.contains("no frame was received"), "{said}");
    windhover(dir, &["export", "flight.mcap", "--format", "csv", "--out", "tables"]);
    // Then its table has a row each tenth of a second, without a frame's number.
    let rows = own_rows(dir, "tables");
    assert!(rows.len() > 45, "{} rows", rows.len());
    assert!(rows.iter().all(|(t, frame, _)| t % 100_000_000 == 0 && frame.is_empty()), "{rows:?}");
    assert!(rows.windows(2).all(|w| w[1].0 - w[0].0 == 100_000_000));
    // And a flight replayed again has the same ones.
    windhover(dir, &["replay", "flight.mcap", "--out", "again.mcap"]);
    windhover(dir, &["export", "again.mcap", "--format", "csv", "--out", "again"]);
    assert_eq!(rows, own_rows(dir, "again"));
    // And map, track and page show the helicopter, and the page states that no frame was received.
    for (format, file, words) in
        [("kml", "flight.kml", "<name>helicopter</name>"), ("geojson", "flight.geojson", "\"helicopter\"")]
    {
        windhover(dir, &["export", "flight.mcap", "--format", format, "--out", "maps"]);
        let text = std::fs::read_to_string(dir.join("maps").join(file)).unwrap();
        assert!(text.contains(words), "{file}: {text}");
    }
    windhover(dir, &["report", "flight.mcap", "--out", "report.html"]);
    let page = std::fs::read_to_string(dir.join("report.html")).unwrap();
    assert!(page.contains("No frame was received from the camera") && !page.contains("it is a capture"));
    assert!(page.contains("Height over the datum"), "the helicopter's own charts are there");
}

#[test]
fn the_rate_is_configured_and_frames_keep_their_rows() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let capture = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures/follow.mcap");
    let config = attached_config(&capture).unwrap().expect("the capture has its configuration");
    // Given twenty own states a second.
    let config = config.replace("ownship_hz = 10.0\n", "");
    let config = config.replace("[estimator]\n", "[estimator]\nownship_hz = 20.0\n");
    std::fs::write(dir.join("c.toml"), config).unwrap();
    let capture = capture.to_str().expect("a plain path");
    windhover(dir, &["replay", capture, "--config", "c.toml", "--out", "flight.mcap"]);
    windhover(dir, &["export", "flight.mcap", "--format", "csv", "--out", "tables"]);
    let rows = own_rows(dir, "tables");
    assert!(rows.windows(2).all(|w| w[0].0 <= w[1].0), "in order of time");
    let between: Vec<i64> = rows.iter().filter(|row| row.1.is_empty()).map(|row| row.0).collect();
    assert!(between.len() > 90 && between.windows(2).all(|w| w[1] - w[0] == 50_000_000), "{between:?}");
    // Then each frame from the first own state on has one row, at its exposure.
    let estimates = std::fs::read_to_string(dir.join("tables/estimates.csv")).unwrap();
    let exposures: Vec<(String, String)> = estimates
        .lines()
        .skip(1)
        .filter(|line| line.split(',').nth(2) == Some("ugv"))
        .map(|line| line.split(',').map(str::to_owned))
        .map(|mut fields| (fields.next().expect("a time"), fields.next().expect("a frame")))
        .collect();
    let of_frames: Vec<(String, String)> =
        rows.iter().filter(|row| !row.1.is_empty()).map(|row| (row.0.to_string(), row.1.clone())).collect();
    assert!(of_frames.len() > 20 && exposures.ends_with(&of_frames), "{of_frames:?} {exposures:?}");
}

#[test]
fn messages_carry_the_whole_covariance() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    blind_capture(dir);
    windhover(dir, &["replay", "blind.mcap", "--out", "flight.mcap"]);
    let own: Vec<wh::Ownship> = CaptureReader::open(&dir.join("flight.mcap"))
        .unwrap()
        .filter(|item| item.raw.channel.topic == "/ownship/state")
        .map(|item| wh::Ownship::decode(&item.raw.data[..]).unwrap())
        .collect();
    assert!(own.len() > 45);
    for own in own {
        assert!(own.between_frames && own.covariance.len() == 45, "{own:?}");
        // Row k of the upper triangle of 9 begins with its variance.
        let variance = |k: usize| own.covariance[k * 9 - k * (k.max(1) - 1) / 2];
        for k in 0..3 {
            assert!((variance(k).sqrt() - own.position_sigma_m[k]).abs() < 1e-12);
            assert!((variance(6 + k).sqrt() - own.attitude_sigma_rad[k]).abs() < 1e-12);
            assert!(variance(3 + k) > 0.0);
        }
    }
}
