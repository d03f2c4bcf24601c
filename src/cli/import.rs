//! `windhover import --gps FILE --compass FILE --imu FILE --attitude FILE --log FILE --bag FILE --video FILE|FOLDER --out CAPTURE.mcap`

use std::path::PathBuf;

use super::{CliError, CliResult, place};
use crate::app::{config_file, import};
use crate::cli::out::note;
use crate::io::import::parse_time;
use crate::io::mcap_write::Maker;
use crate::io::new_file::Inputs;
use crate::text::{counted, one_line};
use windhover_base::time::MonoTime;

/// Make a capture from existing recordings: serial logs with a time on each line, logs of autopilots, bags of ROS, a
/// video.
#[derive(clap::Args, Debug)]
#[command(
    after_help = "Serial logs: each line starts with a time (seconds since any epoch, ISO 8601 with T or a blank, or
as gpspipe -t writes it) and a blank or tab, then the received bytes. Tables: comma-separated, with a header; the
sections [imu] and [attitude] of the configuration describe the sensors' mounting and noise. Video: a folder
of images with times.csv (time_s,file), Motion
JPEG in AVI, Y4M, or any format that an installed ffmpeg reads. All times are on one clock. Logs and bags become the
MAVLink messages of an autopilot: the section [autopilot] of the configuration selects which of them are used.

Example:
  windhover import --gps gps.log --compass compass.log --video frames/ \\
                   --config windhover.toml --out capture.mcap
  windhover import --log flight.ulg --video flight.mp4 --video-start 2026-11-18T15:04:05.2Z --out capture.mcap
  windhover import --bag flight.bag --out capture.mcap"
)]
pub(super) struct Args {
    /// Log of the GPS receiver's line
    #[arg(long, value_name = "FILE")]
    gps: Option<PathBuf>,
    /// Log of the compass's line
    #[arg(long, value_name = "FILE")]
    compass: Option<PathBuf>,
    /// Table of rates and forces: time_s, gyro_x_dps … gyro_z_dps, acc_x_mps2 … acc_z_mps2
    #[arg(long, value_name = "FILE")]
    imu: Option<PathBuf>,
    /// Table of a second source of attitude: time_s, heading_deg (true), pitch_deg, roll_deg
    #[arg(long, value_name = "FILE")]
    attitude: Option<PathBuf>,
    /// Log of an autopilot: PX4's ULog, ArduPilot's .bin, a ground station's .tlog; or DJI's .SRT of the video
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// Bag of ROS 1, or of ROS 2 (MCAP or SQLite; a file or the bag's folder): images, NavSatFix, Imu, MagneticField
    #[arg(long, value_name = "FILE|FOLDER")]
    bag: Option<PathBuf>,
    /// Topic of the bag to use; may be given several times [default: for each kind the one with the shortest name]
    #[arg(long, value_name = "NAME", requires = "bag")]
    topic: Vec<String>,
    /// Video file, or folder of images with times.csv
    #[arg(long, value_name = "FILE|FOLDER")]
    video: Option<PathBuf>,
    /// Time of a video file's first frame [default: from its .SRT, else the first line of the logs]
    #[arg(long, value_name = "TIME", value_parser = time)]
    video_start: Option<MonoTime>,
    /// Configuration to attach, so that the capture can be replayed without another file
    #[arg(long)]
    config: Option<PathBuf>,
    /// Capture to write
    #[arg(long, value_name = "CAPTURE")]
    out: PathBuf,
}

fn time(text: &str) -> Result<MonoTime, String> {
    parse_time(text)
        .ok_or_else(|| format!("{text:?} is not a time: give seconds or a date and time (ISO 8601)"))
}

pub(super) fn run(args: &Args) -> CliResult {
    let config = match &args.config {
        Some(file) => {
            config_file::load(file).map_err(CliError::config)?.to_toml().map_err(CliError::config)?
        }
        None => String::new(),
    };
    let read = [
        &args.gps,
        &args.compass,
        &args.imu,
        &args.attitude,
        &args.log,
        &args.bag,
        &args.video,
        &args.config,
    ];
    let inputs = Inputs::of(read.into_iter().filter_map(|path| path.as_deref()));
    place::check(&args.out, &inputs, &Maker::Capture.marks())?;
    let sources = import::Sources {
        gps: args.gps.clone(),
        compass: args.compass.clone(),
        imu: args.imu.clone(),
        attitude: args.attitude.clone(),
        log: args.log.clone(),
        bag: args.bag.clone(),
        topics: args.topic.clone(),
        video: args.video.clone(),
        video_start: args.video_start,
    };
    let imported = import::import(&sources, &config, &args.out).map_err(|error| match error {
        import::ImportFailure::Nothing | import::ImportFailure::Twice => CliError::usage(error),
        other => CliError::failed(other),
    })?;
    for warning in &imported.warnings {
        note!("windhover: {}", one_line(warning));
    }
    let samples = [
        (imported.imu_samples, "IMU sample"),
        (imported.attitude_samples, "attitude sample"),
        (imported.packets, "MAVLink packet"),
    ];
    let samples = samples.into_iter().filter(|(count, _)| *count > 0);
    let mut samples: String = samples.map(|(count, name)| format!(", {}", counted(count, name))).collect();
    let [fixes, attitudes, inertial] = imported.measured;
    if imported.measured != [0; 3] {
        samples += &format!(" ({fixes} fixes, {attitudes} attitudes, {inertial} inertial samples)");
    }
    note!(
        "imported {}, {}{samples} and {} over {:.1} s",
        counted(imported.gps_lines, "GPS line"),
        counted(imported.compass_lines, "compass line"),
        counted(imported.frames as usize, "frame"),
        imported.length.s()
    );
    note!("wrote {}", args.out.display());
    Ok(())
}
