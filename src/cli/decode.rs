//! `windhover decode gps|compass FILE`

use std::fmt::Display;
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{CliError, CliResult};
use crate::cli::out::{note, written};
use windhover_base::msg::GnssEpoch;
use windhover_base::settings::{CompassFormat, GpsFormat};
use windhover_base::time::{MonoTime, NS_PER_S, UtcTime};
use windhover_decode::{
    CompassDecoder, CompassReading, DecodeCounts, GnssDecoder, ReceivedAttitude, ReceivedEpoch,
};

/// Decode a raw serial log: the values of the receiver or compass, and what was refused.
///
/// A log without any decodable data is an error.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover decode gps gps.log
  windhover decode compass compass.log --format tcm2 --json
  stty -F /dev/ttyS0 38400 raw && timeout 10 cat /dev/ttyS0 > gps.log   # to record such a log")]
pub(super) struct Args {
    #[command(subcommand)]
    device: Device,
}

#[derive(clap::Subcommand, Debug)]
enum Device {
    /// Epochs of a GPS receiver
    Gps(GpsArgs),
    /// Readings of a digital compass
    Compass(CompassArgs),
}

#[derive(clap::Args, Debug)]
struct GpsArgs {
    /// Serial log
    file: PathBuf,
    /// One JSON object for each epoch
    #[arg(long)]
    json: bool,
    /// Format of the receiver: NMEA with Garmin's own sentences, u-blox's packets, or either
    #[arg(long, value_enum, default_value = "auto")]
    format: Speech,
    /// Also accept sentences without a checksum, from a receiver that sends none
    #[arg(long)]
    checksum_optional: bool,
}

#[derive(clap::ValueEnum, Clone, Copy, Debug)]
enum Speech {
    Auto,
    Nmea,
    Ubx,
}

impl From<Speech> for GpsFormat {
    fn from(speech: Speech) -> Self {
        match speech {
            Speech::Auto => Self::Auto,
            Speech::Nmea => Self::Nmea,
            Speech::Ubx => Self::Ubx,
        }
    }
}

#[derive(clap::Args, Debug)]
struct CompassArgs {
    /// Serial log
    file: PathBuf,
    /// One JSON object for each reading
    #[arg(long)]
    json: bool,
    /// Format of the compass; by default the format that decodes most of the log
    #[arg(long, value_parser = formats())]
    format: Option<CompassFormat>,
    /// Also accept sentences without a checksum, from a device that sends none
    #[arg(long)]
    checksum_optional: bool,
}

/// Formats by their names in the configuration.
fn formats() -> impl clap::builder::TypedValueParser<Value = CompassFormat> {
    use clap::builder::TypedValueParser;
    clap::builder::PossibleValuesParser::new(CompassFormat::ALL.map(CompassFormat::name))
        .try_map(|name| name.parse::<CompassFormat>())
}

pub(super) fn run(args: &Args) -> CliResult {
    let mut out = std::io::BufWriter::new(std::io::stdout().lock());
    let (file, likely) = match &args.device {
        Device::Gps(gps) => (&gps.file, "a GPS receiver's log, recorded at the right speed"),
        Device::Compass(compass) if compass.format.is_some() => {
            (&compass.file, "of the format given by --format")
        }
        Device::Compass(compass) => (&compass.file, "a compass's log, recorded at the right speed"),
    };
    let counts = match &args.device {
        Device::Gps(gps) => decode_gps(&read(&gps.file)?, gps, &mut out),
        Device::Compass(compass) => decode_compass(&read(&compass.file)?, compass, &mut out),
    };
    let counts = counts.and_then(|counts| out.flush().map(|()| counts));
    let counts = written(counts)?;
    note!("{counts}");
    if counts.understood_nothing() {
        let file = file.display();
        return Err(CliError::failed(format!("{file}: it has nothing decodable: is it {likely}?")));
    }
    Ok(())
}

fn read(file: &Path) -> Result<Vec<u8>, CliError> {
    std::fs::read(file).map_err(|error| CliError::failed(format!("{}: {error}", file.display())))
}

/// One JSON object for each epoch, in the contract's order.
#[derive(Serialize)]
struct EpochJson {
    utc: Option<String>,
    fix: &'static str,
    lat_deg: Option<f64>,
    lon_deg: Option<f64>,
    alt_msl_m: Option<f64>,
    geoid_m: Option<f64>,
    speed_mps: Option<f64>,
    course_deg: Option<f64>,
    vel_ned_mps: Option<[Option<f64>; 3]>,
    hpe_m: Option<f64>,
    vpe_m: Option<f64>,
    sats: Option<u32>,
    hdop: Option<f64>,
}

impl EpochJson {
    fn of(epoch: &GnssEpoch) -> Self {
        Self {
            utc: utc_text(epoch),
            fix: epoch.fix.name(),
            lat_deg: epoch.lat_deg,
            lon_deg: epoch.lon_deg,
            alt_msl_m: epoch.alt_msl_m,
            geoid_m: epoch.geoid_m,
            speed_mps: epoch.speed_mps,
            course_deg: epoch.course_deg,
            vel_ned_mps: epoch.vel_ned_mps.map(|v| [Some(v.x), Some(v.y), epoch.vel_has_down.then_some(v.z)]),
            hpe_m: epoch.hpe_m,
            vpe_m: epoch.vpe_m,
            sats: epoch.sats,
            hdop: epoch.hdop,
        }
    }
}

/// UTC with its date; second 60 of a leap minute as the receiver reported it.
fn utc_text(epoch: &GnssEpoch) -> Option<String> {
    let utc = epoch.utc?;
    if epoch.time_of_day_ns.is_some_and(|ns| ns >= 86_400 * NS_PER_S) {
        let second_before = UtcTime::from_unix_ns(utc.unix_ns() - NS_PER_S).to_string();
        return Some(second_before.replacen(":59.", ":60.", 1));
    }
    Some(utc.to_string())
}

fn decode_gps(bytes: &[u8], args: &GpsArgs, out: &mut impl Write) -> std::io::Result<DecodeCounts> {
    let (json, required) = (args.json, !args.checksum_optional);
    let decoder = GnssDecoder::patient().of_format(args.format.into());
    let (mut decoder, mut received) = (decoder.checksums_required(required), Vec::new());
    decoder.push(bytes, MonoTime::default(), &mut received);
    decoder.flush(&mut received);
    if !json {
        writeln!(
            out,
            "{:<24} {:>4} {:>13} {:>14} {:>9} {:>8} {:>7} {:>6} {:>23} {:>6} {:>6} {:>4} {:>5}",
            "utc",
            "fix",
            "lat_deg",
            "lon_deg",
            "alt_msl_m",
            "geoid_m",
            "m/s",
            "course",
            "vel_ned_mps",
            "hpe_m",
            "vpe_m",
            "sats",
            "hdop"
        )?;
    }
    for ReceivedEpoch { epoch, .. } in &received {
        if json {
            let line = serde_json::to_string(&EpochJson::of(epoch)).map_err(std::io::Error::other)?;
            writeln!(out, "{line}")?;
        } else {
            epoch_row(epoch, out)?;
        }
    }
    Ok(decoder.counts().clone())
}

fn epoch_row(epoch: &GnssEpoch, out: &mut impl Write) -> std::io::Result<()> {
    let fixed = |value: Option<f64>, digits: usize| value.map(|value| format!("{value:.digits$}"));
    let velocity = epoch.vel_ned_mps.map(|v| {
        let down = if epoch.vel_has_down { format!("{:.2}", v.z) } else { "-".to_owned() };
        format!("{:.2} {:.2} {down}", v.x, v.y)
    });
    writeln!(
        out,
        "{:<24} {:>4} {:>13} {:>14} {:>9} {:>8} {:>7} {:>6} {:>23} {:>6} {:>6} {:>4} {:>5}",
        or_dash(utc_text(epoch)),
        epoch.fix.name(),
        or_dash(fixed(epoch.lat_deg, 8)),
        or_dash(fixed(epoch.lon_deg, 8)),
        or_dash(fixed(epoch.alt_msl_m, 2)),
        or_dash(fixed(epoch.geoid_m, 2)),
        or_dash(fixed(epoch.speed_mps, 2)),
        or_dash(fixed(epoch.course_deg, 1)),
        or_dash(velocity),
        or_dash(fixed(epoch.hpe_m, 1)),
        or_dash(fixed(epoch.vpe_m, 1)),
        or_dash(epoch.sats),
        or_dash(fixed(epoch.hdop, 1)),
    )
}

fn or_dash(value: Option<impl Display>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

/// One JSON object for each reading, in the contract's order.
#[derive(Serialize)]
struct ReadingJson {
    heading_deg: Option<f64>,
    pitch_deg: Option<f64>,
    roll_deg: Option<f64>,
    #[serde(rename = "true")]
    is_true: bool,
    valid: bool,
}

fn decode_compass(bytes: &[u8], args: &CompassArgs, out: &mut impl Write) -> std::io::Result<DecodeCounts> {
    let (json, required) = (args.json, !args.checksum_optional);
    let (received, counts) = match args.format {
        Some(format) => decode_as(bytes, format, required),
        None => likeliest(bytes, required),
    };
    if !json {
        writeln!(
            out,
            "{:>11} {:>9} {:>9} {:>5} {:>5}",
            "heading_deg", "pitch_deg", "roll_deg", "true", "valid"
        )?;
    }
    for ReceivedAttitude { reading, .. } in
        received.iter().filter(|received| !received.reading.is_inertial_only())
    {
        let CompassReading { heading_deg, pitch_deg, roll_deg, heading_is_true, .. } = *reading;
        let valid = reading.is_valid();
        if json {
            let object = ReadingJson { heading_deg, pitch_deg, roll_deg, is_true: heading_is_true, valid };
            writeln!(out, "{}", serde_json::to_string(&object).map_err(std::io::Error::other)?)?;
        } else {
            let angle = |value: Option<f64>| or_dash(value.map(|deg| format!("{deg:.2}")));
            let (heading, pitch, roll) = (angle(heading_deg), angle(pitch_deg), angle(roll_deg));
            writeln!(out, "{heading:>11} {pitch:>9} {roll:>9} {heading_is_true:>5} {valid:>5}")?;
        }
    }
    Ok(counts)
}

fn decode_as(bytes: &[u8], format: CompassFormat, required: bool) -> (Vec<ReceivedAttitude>, DecodeCounts) {
    let (mut decoder, mut received) = (CompassDecoder::new(format).checksums_required(required), Vec::new());
    decoder.push(bytes, MonoTime::default(), &mut received);
    decoder.flush(&mut received);
    (received, decoder.counts().clone())
}

/// The decoding in the format that decodes most: first by complete attitudes, then by any readings. A device's own
/// format takes precedence over plain NMEA.
fn likeliest(bytes: &[u8], required: bool) -> (Vec<ReceivedAttitude>, DecodeCounts) {
    let own = CompassFormat::ALL.into_iter().filter(|format| *format != CompassFormat::Nmea);
    let understood = |received: &[ReceivedAttitude]| {
        let angles = |r: &CompassReading| [r.heading_deg, r.pitch_deg, r.roll_deg].iter().flatten().count();
        received.iter().map(|received| angles(&received.reading)).sum::<usize>()
    };
    let mut best = decode_as(bytes, CompassFormat::Nmea, required);
    for format in own {
        let other = decode_as(bytes, format, required);
        if understood(&other.0) > understood(&best.0) {
            best = other;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gps_json(text: &str) -> Vec<serde_json::Value> {
        let mut out = Vec::new();
        let args =
            GpsArgs { file: PathBuf::new(), json: true, format: Speech::Auto, checksum_optional: false };
        decode_gps(text.as_bytes(), &args, &mut out).expect("memory can be written");
        String::from_utf8_lossy(&out).lines().map(|line| serde_json::from_str(line).expect("JSON")).collect()
    }

    #[test]
    fn an_epoch_is_one_object_with_null_where_nothing_was_said() {
        let rmc = "$GPRMC,150405.2,A,3004.17608,N,08534.52362,W,000.2,358.5,181126,003.4,W,D*01\r\n";
        let objects = gps_json(rmc);
        assert_eq!(objects.len(), 1);
        let epoch = &objects[0];
        assert_eq!(epoch["utc"], "2026-11-18T15:04:05.200Z");
        assert_eq!((&epoch["fix"], &epoch["alt_msl_m"]), (&"2d".into(), &serde_json::Value::Null));
        assert_eq!(epoch["vel_ned_mps"][2], serde_json::Value::Null);
        assert_eq!(epoch.as_object().map(serde_json::Map::len), Some(13));
    }

    #[test]
    fn a_leap_second_is_printed_as_the_receiver_reports_it() {
        let epoch = GnssEpoch {
            utc: Some(UtcTime::from_unix_ns(1_483_228_800_500_000_000)),
            time_of_day_ns: Some(86_400_500_000_000),
            ..GnssEpoch::default()
        };
        assert_eq!(utc_text(&epoch).as_deref(), Some("2016-12-31T23:59:60.500Z"));
    }

    #[test]
    fn the_format_of_a_compass_log_is_recognised() {
        let mut out = Vec::new();
        let mut args =
            CompassArgs { file: PathBuf::new(), json: true, format: None, checksum_optional: false };
        let line = b"$PTNTHTM,14223,N,169,N,-43,N,13641,2454*15\r\n";
        let counts = decode_compass(line, &args, &mut out);
        assert_eq!(counts.map(|counts| counts.used).ok(), Some(1));
        let object: serde_json::Value = serde_json::from_slice(&out).expect("JSON");
        assert!((object["heading_deg"].as_f64().expect("a figure") - 78.13).abs() < 0.01);
        assert_eq!((&object["true"], &object["valid"]), (&false.into(), &true.into()));
        // Without its checksum a sentence is not used, unless that is accepted.
        for (is_accepted, used) in [(false, 0), (true, 1)] {
            args.checksum_optional = is_accepted;
            let counts = decode_compass(&line[..line.len() - 5], &args, &mut Vec::new()).expect("memory");
            assert_eq!(counts.used, 0, "it has no end");
            let bare = [&line[..line.len() - 5], b"\r\n"].concat();
            assert_eq!(decode_compass(&bare, &args, &mut Vec::new()).expect("memory").used, used);
        }
    }
}
