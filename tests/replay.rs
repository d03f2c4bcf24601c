//! The captures beside this file, replayed: the outputs equal the goldens, and are the same twice.
//!
//! A golden changes only in a commit that gives the reason. To make them again after such a change: `cargo test --test
//! replay -- --ignored make_goldens` The captures themselves, with their truth, are made by `cargo test --test replay
//! -- --ignored make_captures` (their goldens must be made again afterwards).

use std::path::{Path, PathBuf};

use windhover::app::export::{self, Format};
use windhover::app::replay;

/// Name (the scenario), seed. Six seconds at six frames a second, three fifths of the resolution.
const CAPTURES: [(&str, u64); 3] = [("follow", 11), ("two-vehicles", 12), ("elevation-compass", 13)];
/// Files of the export that are held against goldens.
const TABLES: [&str; 3] = ["estimates.csv", "smoothed.csv", "detections.csv"];

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures")
}

fn capture(name: &str) -> PathBuf {
    folder().join(format!("{name}.mcap"))
}

/// Replays a capture and exports its tables into `out`.
fn tables(name: &str, out: &Path) -> Vec<String> {
    let config = replay::config_of(&capture(name)).expect("the capture has its configuration");
    let flight = out.join(format!("{name}.mcap"));
    replay::replay(&capture(name), &config, Some(&flight), false, &mut |_| {}).expect("it replays");
    let tables = out.join(name);
    export::export(&flight, Format::Csv, &tables).expect("it exports");
    TABLES.iter().map(|table| read(&tables.join(table))).collect()
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn golden(name: &str, table: &str) -> PathBuf {
    folder().join(name).join(table)
}

/// Numbers may differ by another processor's rounding; everything else must be equal.
fn same(field: &str, wanted: &str) -> bool {
    match (field.parse::<f64>(), wanted.parse::<f64>()) {
        (Ok(got), Ok(want)) => (got - want).abs() <= 1e-5 + 1e-4 * want.abs(),
        _ => field == wanted,
    }
}

fn compare(name: &str, table: &str, got: &str, want: &str) {
    for (number, (got, want)) in got.lines().zip(want.lines()).enumerate() {
        let equal = got.split(',').count() == want.split(',').count()
            && got.split(',').zip(want.split(',')).all(|(got, want)| same(got, want));
        assert!(equal, "{name}/{table} line {}:\n got {got}\nwant {want}", number + 1);
    }
    assert_eq!(got.lines().count(), want.lines().count(), "{name}/{table}: number of lines");
}

#[test]
fn outputs_equal_the_goldens_and_repeat() {
    for (name, _) in CAPTURES {
        let (first, second) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let got = tables(name, first.path());
        for (table, got) in TABLES.iter().zip(&got) {
            compare(name, table, got, &read(&golden(name, table)));
        }
        assert!(got == tables(name, second.path()), "{name}: two replays differ");
    }
}

/// Column `key` of a table as figures, by (frame, target if there is such a column).
fn column(table: &str, key: &str, target: Option<&str>) -> Vec<(u64, f64)> {
    let mut lines = table.lines();
    let header: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let place = |name: &str| header.iter().position(|h| *h == name);
    let (frame, key) = (place("frame").expect("frames"), place(key).expect("the column"));
    let of_target = place("target");
    lines
        .map(|line| line.split(',').collect::<Vec<_>>())
        .filter(|fields| match (of_target, target) {
            (Some(at), Some(name)) => fields[at] == name,
            _ => true,
        })
        .filter_map(|fields| Some((fields[frame].parse().ok()?, fields[key].parse().ok()?)))
        .collect()
}

/// The goldens are right, not only unchanged: position within the receiver's error, heading within
/// the compass's, as soon as the filter has settled.
#[test]
fn goldens_agree_with_the_truth() {
    for (name, _) in CAPTURES {
        let estimates = read(&golden(name, "estimates.csv"));
        let truth = read(&folder().join(format!("{name}.truth.csv")));
        for (key, limit) in [("lat_deg", 5e-5), ("lon_deg", 6e-5), ("heading_rad", 0.2), ("speed_mps", 0.6)] {
            let true_values = column(&truth, key, None);
            let mut errors: Vec<f64> = column(&estimates, key, Some("ugv"))
                .iter()
                .filter(|(frame, _)| *frame >= 18)
                .filter_map(|(frame, value)| {
                    let (_, want) = true_values.iter().find(|(k, _)| k == frame)?;
                    let error = value - want;
                    Some(
                        if key == "heading_rad" { windhover_base::geo::wrap_angle(error) } else { error }
                            .abs(),
                    )
                })
                .collect();
            errors.sort_by(f64::total_cmp);
            assert!(errors.len() >= 14, "{name}: {} estimates from 3 s on", errors.len());
            let median = errors[errors.len() / 2];
            assert!(median < limit, "{name}: {key} off by {median} in the middle of the frames");
        }
    }
}

#[test]
#[ignore = "makes the goldens anew"]
fn make_goldens() {
    for (name, _) in CAPTURES {
        let out = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder().join(name)).unwrap();
        for (table, text) in TABLES.iter().zip(tables(name, out.path())) {
            std::fs::write(golden(name, table), text).unwrap();
        }
    }
}

#[test]
#[ignore = "makes the captures anew"]
fn make_captures() {
    for (name, seed) in CAPTURES {
        let status = std::process::Command::new(env!("CARGO_BIN_EXE_windhover"))
            .args(["simulate", "--scenario", name, "--seed", &seed.to_string()])
            .args(["--duration", "6", "--fps", "6", "--scale", "0.6", "--quality", "80"])
            .arg(capture(name))
            .status()
            .unwrap();
        assert!(status.success(), "{name}");
        let size = std::fs::metadata(capture(name)).unwrap().len();
        assert!(size < 4_000_000, "{name} has {size} bytes");
    }
}
