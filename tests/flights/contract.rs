//! The command line against its contract: exit codes, messages, help, tables and JSON of the binary.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

const COMMANDS: [&[&str]; 27] = [
    &[],
    &["run"],
    &["replay"],
    &["import"],
    &["export"],
    &["refine"],
    &["report"],
    &["simulate"],
    &["detect"],
    &["decode"],
    &["decode", "gps"],
    &["decode", "compass"],
    &["calibrate"],
    &["calibrate", "board"],
    &["calibrate", "intrinsics"],
    &["calibrate", "boresight"],
    &["montecarlo"],
    &["store"],
    &["store", "list"],
    &["store", "verify"],
    &["store", "repair"],
    &["store", "rebuild"],
    &["keys"],
    &["keys", "payload"],
    &["keys", "revoke"],
    &["ground"],
    &["check-config"],
];

pub fn windhover(args: &[&str], dir: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_windhover")).args(args).current_dir(dir).output().expect("it starts")
}

pub fn said(run: &Output) -> String {
    String::from_utf8_lossy(&run.stderr).into_owned()
}

pub fn capture() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures/follow.mcap");
    path.to_str().expect("a plain path").to_owned()
}

pub fn scratch() -> tempfile::TempDir {
    tempfile::tempdir().expect("a scratch directory")
}

#[test]
fn help_answers_on_every_level() {
    let dir = scratch();
    for command in COMMANDS {
        let run = windhover(&[command, &["--help"][..]].concat(), dir.path());
        let text = String::from_utf8_lossy(&run.stdout).into_owned();
        assert_eq!(run.status.code(), Some(0), "{command:?}");
        assert!(text.contains("Usage: windhover"), "{command:?}: {text}");
        // Commands that people start with show an example.
        if command.len() == 1 && !["store", "keys", "calibrate"].contains(&command[0]) {
            assert!(text.contains("Example"), "{command:?} shows no example");
        }
    }
}

#[test]
fn failures_say_what_and_exit_as_agreed() {
    let dir = scratch();
    let (capture, in_dir) = (capture(), |name: &str| dir.path().join(name));
    std::fs::write(in_dir("wrong.toml"), "[gps]\ndevice = \"/dev/ttyS0\"\nbawd = 4800\n").expect("writable");
    std::fs::write(in_dir("photo.png"), "no picture").expect("writable");
    let cases: [(&[&str], i32, &[&str]); 18] = [
        (&["fly"], 2, &["fly"]),
        (&["replay"], 2, &["CAPTURE"]),
        (&["replay", "none.mcap"], 1, &["none.mcap"]),
        (&["replay", "wrong.toml"], 1, &["wrong.toml", "MCAP"]),
        (&["replay", &capture, "--config", "none.toml"], 78, &["none.toml"]),
        (&["replay", &capture, "--config", "wrong.toml"], 78, &["wrong.toml", "line 3", "bawd"]),
        (&["check-config", "wrong.toml"], 78, &["wrong.toml", "line 3", "bawd"]),
        (&["run", "--config", "none.toml"], 78, &["none.toml"]),
        (&["montecarlo", "--config", "wrong.toml"], 78, &["line 3"]),
        (&["montecarlo", "--samples", "0"], 2, &["--samples"]),
        (&["export", &capture, "--format", "csv", "--out", "tables"], 1, &["windhover replay"]),
        (&["report", "none.mcap"], 1, &["none.mcap"]),
        (&["refine", "none.mcap"], 1, &["none.mcap"]),
        (&["refine", &capture, "--out", "refined.mcap"], 1, &["windhover replay"]),
        (&["detect", "photo.png"], 1, &["photo.png"]),
        (&["calibrate", "intrinsics", "photo.png", "--board", "9x6"], 2, &["--square-m"]),
        (&["calibrate", "boresight", &capture], 1, &["replay"]),
        (&["simulate", "x.mcap", "--scenario", "nowhere"], 2, &["nowhere", "--list"]),
    ];
    for (args, code, words) in cases {
        let run = windhover(args, dir.path());
        let text = said(&run);
        assert_eq!(run.status.code(), Some(code), "{args:?}: {text}");
        assert!(words.iter().all(|w| text.contains(w)), "{args:?}: {text}");
        if code != 2 {
            assert!(text.trim_end().lines().count() <= 2, "{args:?}: {text}");
        }
    }
    assert!(!in_dir("tables").exists(), "a capture leaves no empty tables behind");
}

#[test]
fn a_flight_that_cannot_be_written_ends_the_replay() {
    // Given a place that cannot be written and a capture longer than what is read ahead.
    let dir = scratch();
    // When it is replayed, then it ends and names the file, rather than waiting without end.
    let run = windhover(&["replay", &capture(), "--out", "no/such/place.mcap"], dir.path());
    assert_eq!(run.status.code(), Some(1));
    assert!(said(&run).contains("no/such/place.mcap"), "{}", said(&run));
}

#[test]
fn values_that_cannot_be_are_refused_with_line_and_key() {
    let dir = scratch();
    let shipped = include_str!("../../config/windhover.toml");
    let cases = [
        ("baud = 38400", "baud = 0", "gps.baud"),
        ("width = 1280", "width = 0", "camera.width"),
        ("image_top = \"forward\"", "image_top = \"up\"", "forward"),
        ("wheelbase_m = 1.2", "wheelbase_m = nan", "target.wheelbase_m"),
        ("size_m = 0.48", "size_m = -0.48", "size_m"),
        ("device = \"/dev/ttyS1\"", "device = \"/dev/ttyS0\"", "compass.device"),
    ];
    for (from, to, key) in cases {
        assert!(shipped.contains(from), "{from}");
        let text = shipped.replacen(from, to, 1);
        let line = 1 + shipped.lines().position(|l| l.starts_with(from)).expect("it stands there");
        std::fs::write(dir.path().join("c.toml"), &text).expect("writable");
        let run = windhover(&["check-config", "c.toml"], dir.path());
        assert_eq!(run.status.code(), Some(78), "{to}");
        let words = said(&run);
        assert!(words.contains(key) && words.lines().count() <= 2, "{to}: {words}");
        // Where a key is in several tables of one name, its line is not given.
        if text.matches("[[target.marker]]").count() == 1 || !to.starts_with("size_m") {
            assert!(words.contains(&format!("line {line},")), "{to}, line {line}: {words}");
        }
    }
}

/// A flight of the small capture, exported.
fn exported(dir: &Path) -> PathBuf {
    let flight = dir.join("flight.mcap");
    let flight = flight.to_str().expect("a plain path");
    assert!(windhover(&["replay", &capture(), "--out", flight], dir).status.success());
    assert!(windhover(&["export", flight, "--format", "csv", "--out", "tables"], dir).status.success());
    dir.join("tables")
}

/// The head of a table and its rows.
fn table(path: &Path) -> (String, Vec<Vec<String>>) {
    let text = std::fs::read_to_string(path).expect("exported");
    let mut lines = text.lines();
    let head = lines.next().expect("a header").to_owned();
    (head, lines.map(|l| l.split(',').map(str::to_owned).collect()).collect())
}

#[test]
fn tables_have_the_columns_agreed() {
    let dir = scratch();
    let tables = exported(dir.path());
    let state =
        "time_ns,frame,target,status,north_m,east_m,heading_rad,speed_mps,yaw_rate_radps,lat_deg,lon_deg";
    let covariance = "p_nn,p_ne,p_nh,p_nv,p_nw,p_ee,p_eh,p_ev,p_ew,p_hh,p_hv,p_hw,p_vv,p_vw,p_ww";
    let heads = [
        ("estimates.csv", format!("{state},{covariance}")),
        ("smoothed.csv", format!("{state},{covariance}")),
        ("paper.csv", state.to_owned()),
        (
            "detections.csv",
            "time_ns,frame,kind,family,id,hamming,margin,center_u,center_v,u0,v0,u1,v1,u2,v2,u3,v3"
                .to_owned(),
        ),
        (
            "ownship.csv",
            "time_ns,frame,lat_deg,lon_deg,height_m,north_m,east_m,down_m,vn_mps,ve_mps,vd_mps,qw,qx,qy,qz"
                .to_owned(),
        ),
        ("datum.csv", "lat_deg,lon_deg,height_m".to_owned()),
    ];
    for (name, head) in heads {
        let (found, rows) = table(&tables.join(name));
        assert_eq!(found, head, "{name}");
        assert!(!rows.is_empty() && rows.iter().all(|r| r.len() == head.split(',').count()), "{name}");
    }
}

#[test]
fn states_are_in_the_units_and_ranges_agreed() {
    let dir = scratch();
    let tables = exported(dir.path());
    let (_, rows) = table(&tables.join("estimates.csv"));
    let figure = |row: &[String], k: usize| row[k].parse::<f64>().expect("a figure");
    // One row a frame, in order, unknown ones empty.
    let frames: Vec<usize> = rows.iter().map(|r| r[1].parse().expect("a number")).collect();
    assert_eq!(frames, (0..frames.len()).collect::<Vec<_>>());
    let held: Vec<_> = rows.iter().filter(|r| r[3] == "tracking").collect();
    assert!(held.len() > 10);
    for row in &rows {
        assert!(["acquiring", "tracking", "coasting", "lost"].contains(&row[3].as_str()), "{}", row[3]);
    }
    for row in held {
        let heading = figure(row, 6);
        assert!(heading > -std::f64::consts::PI && heading <= std::f64::consts::PI);
        for k in [9, 10] {
            let decimals = row[k].split('.').nth(1).map_or(0, str::len);
            assert!(decimals >= 9, "{}", row[k]);
        }
        // The upper triangle row by row: the diagonal is positive, correlations stay within one.
        let p = |r: usize, c: usize| figure(row, 11 + r * 5 - r * (r + 1) / 2 + c);
        for r in 0..5 {
            assert!(p(r, r) > 0.0);
            for c in r + 1..5 {
                assert!(p(r, c).abs() <= (p(r, r) * p(c, c)).sqrt() * 1.000_001, "{r}{c}: {row:?}");
            }
        }
    }
    // ned_from_body is a unit quaternion.
    for row in table(&tables.join("ownship.csv")).1.iter().filter(|r| !r[11].is_empty()) {
        let norm: f64 = (11..15).map(|k| figure(row, k).powi(2)).sum();
        assert!((norm - 1.0).abs() < 1e-6);
    }
}

#[test]
fn json_has_the_fields_agreed() {
    let dir = scratch();
    let run = windhover(&["montecarlo", "--json", "--samples", "5000"], dir.path());
    let json: Value = serde_json::from_slice(&run.stdout).expect("one object");
    for key in ["sigma_n_m", "sigma_e_m", "r50_m", "r95_m", "max_m"] {
        assert!(json[key].as_f64().is_some_and(|v| v > 0.0), "{key}: {json}");
    }
    assert_eq!((json["distribution"].as_str(), json["samples"].as_u64()), (Some("normal"), Some(5000)));

    std::fs::write(
        dir.path().join("gps.log"),
        "$GPGGA,150405.00,3004.17629,N,08534.52348,W,1,08,1.0,33.0,M,-27.0,M,,*64\r\n",
    )
    .expect("writable");
    let run = windhover(&["decode", "gps", "gps.log", "--json"], dir.path());
    assert!(run.status.success(), "{}", said(&run));
    for line in String::from_utf8_lossy(&run.stdout).lines() {
        let epoch: Value = serde_json::from_str(line).expect("one object a line");
        for key in [
            "utc",
            "fix",
            "lat_deg",
            "lon_deg",
            "alt_msl_m",
            "geoid_m",
            "speed_mps",
            "course_deg",
            "vel_ned_mps",
            "hpe_m",
            "vpe_m",
            "sats",
            "hdop",
        ] {
            assert!(epoch.get(key).is_some(), "{key}: {line}");
        }
    }

    image::GrayImage::new(64, 48).save(dir.path().join("blank.png")).expect("writable");
    let run = windhover(&["detect", "blank.png", "--json"], dir.path());
    let json: Value = serde_json::from_slice(&run.stdout).expect("one object");
    assert_eq!(json["image"], "blank.png");
    assert!(json["ms"].as_f64().is_some() && json["detections"] == Value::Array(Vec::new()));
}

#[test]
fn a_log_in_which_nothing_is_understood_is_an_error() {
    let dir = scratch();
    let noise: Vec<u8> = (0..20_000u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let logs: [(&str, &[u8]); 3] =
        [("noise.log", &noise), ("empty.log", b""), ("text.log", b"dear diary,\r\ntoday we flew.\r\n")];
    for (log, bytes) in logs {
        std::fs::write(dir.path().join(log), bytes).expect("writable");
        for device in ["gps", "compass"] {
            let run = windhover(&["decode", device, log, "--json"], dir.path());
            assert_eq!(run.status.code(), Some(1), "{device} {log}");
            let said = said(&run);
            assert!(said.contains(log) && said.contains("it has nothing decodable"), "{said}");
            assert!(said.contains("0 used"), "the counts are still printed: {said}");
        }
    }
}
