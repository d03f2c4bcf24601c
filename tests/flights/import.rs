//! Import: existing recordings become one capture in order of time.

use std::path::Path;

use windhover::app::import::{ImportFailure, Imported, Sources, import};
use windhover::io::capture::{CaptureReader, attached_config};
use windhover::io::import::VideoSource;
use windhover_base::msg::{EventBody, FrameEncoding, Source};

/// What a capture holds: milliseconds since its first event, and what it is.
fn contents(path: &Path) -> Vec<(i64, String)> {
    let events: Vec<_> = CaptureReader::open(path).unwrap().filter_map(|item| item.event).collect();
    let first = events[0].t_recv;
    let name = |body: &EventBody| match body {
        EventBody::Bytes { source: Source::Gps, data: bytes } => {
            format!("gps {}", String::from_utf8_lossy(bytes).trim_end())
        }
        EventBody::Bytes { source: Source::Compass, data: bytes } => {
            format!("compass {}", String::from_utf8_lossy(bytes).trim_end())
        }
        EventBody::Frame(frame) => format!("{:?} {} {}", frame.encoding, frame.index, frame.data.len()),
        other => format!("{other:?}"),
    };
    events.iter().map(|e| (((e.t_recv - first).ms()).round() as i64, name(&e.body))).collect()
}

fn run(folder: &Path, sources: Sources) -> Result<(Imported, Vec<(i64, String)>), ImportFailure> {
    let out = folder.join("capture.mcap");
    let imported = import(&sources, "", &out)?;
    assert_eq!(attached_config(&out).unwrap(), None);
    Ok((imported, contents(&out)))
}

#[test]
fn logs_and_a_folder_of_images_merge_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("gps.log"), "100.0 $GPRMC,a*00\r\nno time here\n100.2 $GPRMC,b*00\n").unwrap();
    std::fs::write(at("compass.log"), "100.1 $C1.0P2.0R3.0*00\n").unwrap();
    std::fs::create_dir(at("frames")).unwrap();
    image::GrayImage::from_pixel(4, 3, image::Luma([7])).save(at("frames/a.png")).unwrap();
    image::GrayImage::from_pixel(4, 3, image::Luma([9])).save(at("frames/b.bmp")).unwrap();
    std::fs::write(at("frames/times.csv"), "time_s,file\n100.15,a.png\n100.25,b.bmp\n").unwrap();

    let sources = Sources {
        gps: Some(at("gps.log")),
        compass: Some(at("compass.log")),
        video: Some(at("frames")),
        ..Sources::default()
    };
    let (imported, got) = run(folder.path(), sources).unwrap();

    assert_eq!((imported.gps_lines, imported.compass_lines, imported.frames), (2, 1, 2));
    assert_eq!(imported.video, Some(VideoSource::Folder));
    assert!(imported.warnings[0].contains("1 line without a time left out, the first at line 2"));
    let times: Vec<i64> = got.iter().map(|(ms, _)| *ms).collect();
    assert_eq!(times, [0, 100, 150, 200, 250]);
    assert_eq!(got[0].1, "gps $GPRMC,a*00");
    assert_eq!(got[1].1, "compass $C1.0P2.0R3.0*00");
    assert!(got[2].1.starts_with("Png 0"));
    assert_eq!(got[4].1, "Grey 1 12");
}

#[test]
fn y4m_keeps_its_luma_and_its_rate() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("video.y4m");
    let mut bytes = b"YUV4MPEG2 W4 H2 F20:1 Ip C420jpeg\n".to_vec();
    for level in 0..3 {
        bytes.extend_from_slice(b"FRAME\n");
        bytes.extend([level; 8]);
        bytes.extend([128; 4]);
    }
    // Cut off in the last frame: two whole ones are left.
    bytes.truncate(bytes.len() - 3);
    std::fs::write(&path, bytes).unwrap();
    let (imported, got) = run(folder.path(), Sources { video: Some(path), ..Sources::default() }).unwrap();
    assert_eq!(imported.video, Some(VideoSource::Y4m));
    assert_eq!(got, [(0, "Grey 0 8".to_owned()), (50, "Grey 1 8".to_owned())]);
}

#[test]
fn tables_of_samples_merge_with_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("gps.log"), "100.0 $GPRMC,a*00\n").unwrap();
    let rows = "100.02,180,0,0,0,0,-9.8\n99.98,0,90,0,0,0,-9.8\n100.04,x,0,0,0,0,\n";
    let header = "time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,acc_x_mps2,acc_y_mps2,acc_z_mps2\n";
    std::fs::write(at("imu.csv"), format!("{header}{rows}")).unwrap();
    std::fs::write(at("ahrs.csv"), "time_s,heading_deg,pitch_deg,roll_deg\n100.01,90,0,0\n").unwrap();
    let sources = Sources {
        gps: Some(at("gps.log")),
        imu: Some(at("imu.csv")),
        attitude: Some(at("ahrs.csv")),
        ..Sources::default()
    };
    let (imported, got) = run(folder.path(), sources).unwrap();
    assert_eq!((imported.imu_samples, imported.attitude_samples), (2, 1));
    assert!(
        imported.warnings[0].contains("imu.csv: 1 row ")
            && imported.warnings[0].contains("the first at line 4")
    );
    let times: Vec<i64> = got.iter().map(|(ms, _)| *ms).collect();
    assert_eq!(times, [0, 20, 30, 40]);
    assert!(got[0].1.starts_with("Inertial") && got[0].1.contains("1.57"), "{}", got[0].1);
    assert!(got[2].1.starts_with("Attitude") && got[2].1.contains("heading_is_true: true"), "{}", got[2].1);
}

/// A chunk of an AVI file.
fn chunk(code: &[u8; 4], body: &[u8]) -> Vec<u8> {
    let mut bytes = code.to_vec();
    bytes.extend((body.len() as u32).to_le_bytes());
    bytes.extend(body);
    bytes.extend(vec![0; body.len() % 2]);
    bytes
}

#[test]
fn motion_jpeg_is_kept_untouched() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("video.avi");
    let mut header = 40_000_u32.to_le_bytes().to_vec();
    header.extend([0; 52]);
    let hdrl = [b"hdrl".to_vec(), chunk(b"avih", &header)].concat();
    let jpeg = [0xff, 0xd8, 1, 2, 3];
    let movi = [b"movi".to_vec(), chunk(b"00dc", &jpeg), chunk(b"00dc", &[]), chunk(b"00dc", &jpeg)].concat();
    let body =
        [b"AVI ".to_vec(), chunk(b"LIST", &hdrl), chunk(b"LIST", &movi), chunk(b"idx1", &[0; 16])].concat();
    std::fs::write(&path, chunk(b"RIFF", &body)).unwrap();

    let (imported, got) = run(folder.path(), Sources { video: Some(path), ..Sources::default() }).unwrap();

    assert_eq!(imported.video, Some(VideoSource::MotionJpeg));
    // The empty chunk is a dropped frame: its time passes.
    let jpeg_name = |index| format!("{:?} {index} 5", FrameEncoding::Jpeg);
    assert_eq!(got, [(0, jpeg_name(0)), (80, jpeg_name(1))]);
}

#[test]
fn what_is_wrong_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("gps.log");
    std::fs::write(&log, "$GPRMC\n$GPGGA\n").unwrap();
    let sources = Sources { gps: Some(log), ..Sources::default() };
    let error = run(folder.path(), sources).unwrap_err().to_string();
    assert!(error.contains("gps.log:1") && error.contains("starts with a time"), "{error}");

    let frames = folder.path().join("frames");
    std::fs::create_dir(&frames).unwrap();
    std::fs::write(frames.join("times.csv"), "time_s,file\n1.0;a.png\n").unwrap();
    let sources = Sources { video: Some(frames), ..Sources::default() };
    let error = run(folder.path(), sources).unwrap_err().to_string();
    assert!(error.contains("times.csv:2"), "{error}");

    assert!(matches!(run(folder.path(), Sources::default()), Err(ImportFailure::Nothing)));
}
