//! The borders of the commands: outputs never overwrite inputs, foreign content is shown as text and numbers or not at
//! all, and a reader of the output may leave.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use mcap::records::MessageHeader;
use prost::Message as _;
use windhover::io::proto::{schema_of_package, timestamp, windhover as wh};
use windhover_base::time::MonoTime;

use crate::contract::{capture, said, scratch, windhover};

/// The small capture as a flight's directory.
fn flight_dir(dir: &Path) -> PathBuf {
    let flight = dir.join("FL");
    std::fs::create_dir(&flight).unwrap();
    std::fs::copy(capture(), flight.join("000000.mcap")).unwrap();
    flight
}

#[test]
fn no_command_writes_over_what_it_reads_or_did_not_make() {
    let dir = scratch();
    let at = |name: &str| dir.path().join(name);
    let segment = flight_dir(dir.path()).join("000000.mcap");
    std::fs::hard_link(&segment, at("hard.mcap")).unwrap();
    std::os::unix::fs::symlink(&segment, at("soft.mcap")).unwrap();
    std::fs::write(at("gps.log"), "100.0 $GPRMC,a*00\n").unwrap();
    std::fs::write(at("letter.txt"), "to whom it may concern").unwrap();
    let before = std::fs::read(&segment).unwrap();
    let cases: [(&[&str], i32); 13] = [
        (&["replay", "FL", "--out", "FL/000000.mcap"], 2),
        (&["replay", "FL", "--out", "FL/000001.mcap"], 2),
        (&["replay", "FL", "--out", "FL"], 2),
        (&["replay", "FL", "--out", "hard.mcap"], 2),
        (&["replay", "hard.mcap", "--out", "soft.mcap"], 2),
        (&["replay", "FL", "--out", "letter.txt"], 1),
        (&["report", "FL", "--out", "FL"], 2),
        (&["report", "FL", "--out", "FL/000000.mcap"], 2),
        (&["report", "FL", "--out", "letter.txt"], 1),
        (&["import", "--gps", "gps.log", "--out", "gps.log"], 2),
        (&["import", "--gps", "gps.log", "--out", "letter.txt"], 1),
        (&["simulate", "letter.txt", "--duration", "0.2", "--scale", "0.1"], 1),
        (&["calibrate", "board", "--board", "9x6", "--square-m", "0.025", "--out", "letter.txt"], 1),
    ];
    for (args, code) in cases {
        let run = windhover(args, dir.path());
        assert_eq!(run.status.code(), Some(code), "{args:?}: {}", said(&run));
        assert!(
            said(&run).contains(args[args.len() - 1]) || args[0] == "simulate",
            "{args:?}: {}",
            said(&run)
        );
    }
    assert!(std::fs::read(&segment).unwrap() == before, "the flight is as it was");
    assert_eq!(std::fs::read(at("gps.log")).unwrap(), b"100.0 $GPRMC,a*00\n");
    assert_eq!(std::fs::read(at("letter.txt")).unwrap(), b"to whom it may concern");
    // Output of the same command is overwritten, without further files.
    for _ in 0..2 {
        for args in [
            &["simulate", "s.mcap", "--duration", "0.2", "--scale", "0.1"][..],
            &["report", "s.mcap"],
            &["import", "--gps", "gps.log", "--out", "i.mcap"],
        ] {
            let run = windhover(args, dir.path());
            assert!(run.status.success(), "{args:?}: {}", said(&run));
        }
    }
    let beside = dir
        .path()
        .read_dir()
        .unwrap()
        .filter(|entry| entry.as_ref().unwrap().path().extension().is_some_and(|end| end == "part"));
    assert_eq!(beside.count(), 0);
}

/// A flight with hostile names of targets and hostile values.
fn hostile(path: &Path) {
    flight_of(path, &[("=1+1,<b>&\"", 30.0), ("nowhere", f64::NAN), ("nowhere", f64::INFINITY)]);
}

/// A flight of these targets at these latitudes.
fn flight_of(path: &Path, targets: &[(&str, f64)]) {
    let file = std::io::BufWriter::new(std::fs::File::create(path).unwrap());
    let mut writer = mcap::Writer::new(file).unwrap();
    let schema = schema_of_package("windhover");
    let mut sequence = 0;
    for &(name, lat_deg) in targets {
        let schema = writer.add_schema("windhover.TargetState", "protobuf", &schema).unwrap();
        let topic = format!("/target/{name}/state");
        let channel_id = writer.add_channel(schema, &topic, "protobuf", &BTreeMap::new()).unwrap();
        for second in 1..4_u32 {
            let t = MonoTime::from_ns(i64::from(second) * 1_000_000_000);
            let state = wh::TargetState {
                timestamp: Some(timestamp(t)),
                target: name.into(),
                status: wh::TrackStatus::Tracking as i32,
                known: true,
                lat_deg,
                lon_deg: -85.0,
                speed_mps: if lat_deg.is_finite() { 1.0 } else { f64::NEG_INFINITY },
                covariance: vec![f64::NAN; 15],
                ..Default::default()
            };
            let t = t.ns().unsigned_abs();
            let header = MessageHeader { channel_id, sequence, log_time: t, publish_time: t };
            writer.write_to_known_channel(&header, &state.encode_to_vec()).unwrap();
            sequence += 1;
        }
    }
    writer.finish().unwrap();
}

#[test]
fn names_of_others_stay_names_and_what_is_no_number_is_left_out() {
    let dir = scratch();
    hostile(&dir.path().join("h.mcap"));
    for format in ["csv", "kml", "geojson"] {
        let run = windhover(&["export", "h.mcap", "--format", format, "--out", "out"], dir.path());
        assert!(run.status.success(), "{format}: {}", said(&run));
    }
    let read = |name: &str| std::fs::read_to_string(dir.path().join("out").join(name)).unwrap();
    let (csv, kml, geojson) = (read("estimates.csv"), read("flight.kml"), read("flight.geojson"));
    for text in [&csv, &kml, &geojson] {
        let lower = text.to_lowercase();
        assert!(!lower.contains("nan") && !lower.contains("inf"), "{text}");
    }
    assert!(csv.lines().nth(1).unwrap().contains(",0,\"'=1+1,<b>&\"\"\",tracking,"), "{csv}");
    assert!(
        kml.contains("<name>target/=1+1,&lt;b&gt;&amp;&quot;</name>") && !kml.contains("nowhere"),
        "{kml}"
    );
    let parsed: serde_json::Value = serde_json::from_str(&geojson).unwrap();
    assert_eq!(parsed["type"], "FeatureCollection");
    assert_eq!(parsed["features"][0]["properties"]["name"], "target/=1+1,<b>&\"");
    assert!(!geojson.contains("nowhere"));
}

#[test]
fn a_reader_who_goes_ends_a_command_quietly_and_a_full_disk_is_an_error() {
    let dir = scratch();
    std::fs::write(dir.path().join("gps.log"), "$GPRMC,120000,A,3000.0,N,08500.0,W,1.0,90.0,181126,,*1B\n")
        .unwrap();
    image::GrayImage::new(64, 64).save(dir.path().join("a.png")).unwrap();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/windhover.toml");
    std::fs::copy(shipped, dir.path().join("c.toml")).unwrap();
    std::fs::create_dir_all(dir.path().join("card/FLIGHTS")).unwrap();
    let commands: [&[&str]; 9] = [
        &["--help"],
        &["check-config", "c.toml"],
        &["detect", "a.png"],
        &["detect", "a.png", "--json"],
        &["decode", "gps", "gps.log"],
        &["montecarlo", "--samples", "100"],
        &["store", "--path", "card", "list"],
        &["simulate", "--list"],
        &["calibrate", "board", "--board", "9x6", "--square-m", "0.025"],
    ];
    for args in commands {
        let mut command = Command::new(env!("CARGO_BIN_EXE_windhover"));
        command.args(args).current_dir(dir.path()).stderr(Stdio::piped());
        // A pipe whose other end is closed.
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let run = command.stdout(writer).spawn().unwrap().wait_with_output().unwrap();
        assert_eq!(
            (run.status.code(), said(&run).contains("panic")),
            (Some(0), false),
            "{args:?}: {}",
            said(&run)
        );
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let run = command.stdout(full).spawn().unwrap().wait_with_output().unwrap();
        assert_eq!(run.status.code(), Some(1), "{args:?}: {}", said(&run));
        assert!(said(&run).contains("standard output"), "{args:?}: {}", said(&run));
    }
    // A closed standard error does no harm either.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let mut command = Command::new(env!("CARGO_BIN_EXE_windhover"));
    command.args(["replay", &capture(), "--log", "--out", "f.mcap"]).current_dir(dir.path());
    let status = command.stdout(writer.try_clone().unwrap()).stderr(writer).status().unwrap();
    assert_eq!(status.code(), Some(0));
}

#[test]
fn a_recording_names_no_pipe_and_no_folder_names_what_lies_outside() {
    let dir = scratch();
    let at = |name: &str| dir.path().join(name);
    let fifo = at("tile.hgt");
    rustix::fs::mkfifoat(rustix::fs::CWD, &fifo, rustix::fs::Mode::RWXU).unwrap();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/windhover.toml");
    let config = std::fs::read_to_string(shipped).unwrap();
    let terrain = format!("terrain = {:?}", fifo.to_str().unwrap());
    std::fs::write(at("gps.log"), "100.0 $GPRMC,120000,A,3000.0,N,08500.0,W,1.0,90.0,181126,,*1B\n").unwrap();
    // A tile that is a pipe is refused where a person names it, and ignored where a recording does.
    let named = config.replace("elevation_msl_m = 33.0", &terrain);
    assert!(named.contains("terrain = "), "the shipped configuration has an elevation");
    std::fs::write(at("c.toml"), &named).unwrap();
    let began = Instant::now();
    let run = windhover(&["check-config", "c.toml"], dir.path());
    assert_eq!(run.status.code(), Some(78), "{}", said(&run));
    let capture = at("stranger.mcap");
    let event = windhover_base::msg::Event {
        t_recv: MonoTime::from_ns(1_000_000_000),
        seq: 0,
        body: windhover_base::msg::EventBody::Bytes {
            source: windhover_base::msg::Source::Gps,
            data: b"$GPRMC,x\r\n".to_vec(),
        },
    };
    let mut writer = windhover::io::capture::CaptureWriter::create(&capture, &named, event.t_recv).unwrap();
    writer.write(&event).unwrap();
    writer.finish().unwrap();
    let run = windhover(&["replay", "stranger.mcap"], dir.path());
    assert!(run.status.success(), "{}", said(&run));
    // A folder of images names its own.
    std::fs::create_dir(at("frames")).unwrap();
    image::GrayImage::new(4, 4).save(at("private.png")).unwrap();
    for outside in ["../private.png", "/dev/zero", at("private.png").to_str().unwrap()] {
        std::fs::write(at("frames/times.csv"), format!("time_s,file\n1.0,{outside}\n")).unwrap();
        let run = windhover(&["import", "--video", "frames", "--out", "i.mcap"], dir.path());
        assert_eq!(run.status.code(), Some(1), "{outside}: {}", said(&run));
        assert!(said(&run).contains("times.csv:2") && !at("i.mcap").exists(), "{outside}: {}", said(&run));
    }
    assert!(began.elapsed() < Duration::from_secs(60), "nothing was waited for");
}

#[test]
fn a_file_that_is_no_segment_is_skipped_and_reported() {
    let dir = scratch();
    let flight = flight_dir(dir.path());
    std::fs::write(flight.join("._000000.mcap"), "resource fork").unwrap();
    std::fs::write(flight.join("!bad.mcap"), "no recording at all").unwrap();
    rustix::fs::mkfifoat(rustix::fs::CWD, flight.join("000001.mcap"), rustix::fs::Mode::RWXU).unwrap();
    let run = windhover(&["replay", "FL", "--out", "f.mcap"], dir.path());
    let words = said(&run);
    assert!(run.status.success(), "{words}");
    for bad in ["!bad.mcap", "000001.mcap"] {
        assert_eq!(words.lines().filter(|l| l.contains(bad) && l.contains("skipped")).count(), 1, "{words}");
    }
    assert!(!words.contains("._000000"), "{words}");
}

#[test]
fn a_flight_of_a_thousand_targets_is_reported_in_part() {
    let dir = scratch();
    let names: Vec<String> = (0..1_000).map(|n| format!("t{n}")).collect();
    let states: Vec<(&str, f64)> = names.iter().map(|name| (name.as_str(), 30.0)).collect();
    flight_of(&dir.path().join("h.mcap"), &states);
    let run = windhover(&["report", "h.mcap"], dir.path());
    assert!(run.status.success(), "{}", said(&run));
    let page = std::fs::read_to_string(dir.path().join("report.html")).unwrap();
    assert!(page.contains("more than 64 targets") && page.len() < 20_000_000, "{} bytes", page.len());
}

#[test]
fn a_configuration_has_so_many_targets() {
    let dir = scratch();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/windhover.toml");
    let mut config = std::fs::read_to_string(shipped).unwrap();
    for n in 0..40 {
        config += &format!(
            "\n[[target]]\nname = \"more{n}\"\nmodel = \"static\"\n[[target.marker]]\nkind = \"apriltag\"\n\
             family = \"36h11\"\nid = {}\nsize_m = 0.2\nposition_m = [0.0, 0.0, 0.0]\n",
            n + 100
        );
    }
    std::fs::write(dir.path().join("c.toml"), config).unwrap();
    let run = windhover(&["check-config", "c.toml"], dir.path());
    assert_eq!(run.status.code(), Some(78));
    assert!(said(&run).contains("the most for one helicopter is 32"), "{}", said(&run));
}
