//! Compass sentences and packets in every supported format.

use super::compass_binary::{write_pni, write_rvc, write_ubx, write_witmotion};
use super::garmin::write_sentence;
use windhover_base::msg::AttitudeSample;
use windhover_base::settings::CompassFormat;
use windhover_base::time::UtcTime;

/// Data for a format in addition to the reading.
#[derive(Clone, Copy, Debug)]
pub(super) struct WireContext {
    pub(super) format: CompassFormat,
    /// Degrees, east positive: for formats with a true heading or the variation.
    pub(super) declination_deg: f64,
    /// For formats with a time of day.
    pub(super) utc: UtcTime,
}

/// Appends one reading as the device sends it. A reading without a heading is marked as invalid.
pub(super) fn write_reading(sample: &AttitudeSample, context: &WireContext, line: &mut Vec<u8>) {
    let valid = sample.heading.is_some() && sample.tilt.is_some();
    let heading = sample.heading.unwrap_or(0.0).to_degrees().rem_euclid(360.0);
    let tilt = sample.tilt.unwrap_or_default();
    let (pitch, roll) = (tilt.pitch.to_degrees(), tilt.roll.to_degrees());
    let h = wrapped(heading, 1);
    let body = match context.format {
        CompassFormat::Tcm2 => {
            // 006: both inclinometer and magnetometer out of range.
            format!("C{h:.1}P{pitch:.1}R{roll:.1}{}", if valid { "" } else { "E006" })
        }
        CompassFormat::Os5000 => format!("C{h:.1}P{pitch:.1}R{roll:.1}T21.5"),
        CompassFormat::Hmr3000 if valid => format!("PTNTHPR,{h:.1},N,{pitch:.1},N,{roll:.1},N"),
        CompassFormat::Hmr3000 => "PTNTHPR,,P,,P,,P".into(),
        CompassFormat::Revolution => {
            let status = if valid { 'N' } else { 'P' };
            let counts = |degrees: f64| (degrees * 65_536.0 / 360.0).round() as i64;
            let turn = counts(heading) % 65_536;
            let (p, r) = (counts(pitch), counts(roll));
            format!("PTNTHTM,{turn},{status},{p},{status},{r},{status},13641,2454")
        }
        CompassFormat::Pashr => {
            let c = context.utc.civil();
            let time = format!("{:02}{:02}{:02}.{:03}", c.hour, c.minute, c.second, c.nanosecond / 1_000_000);
            let t = wrapped((heading + context.declination_deg).rem_euclid(360.0), 2);
            let quality = u8::from(valid);
            format!("PASHR,{time},{t:.2},T,{roll:+.2},{pitch:+.2},+0.00,0.300,0.300,0.500,{quality}")
        }
        // A device without a heading sends no angles.
        CompassFormat::Vectornav if !valid => "VNYPR,,,".into(),
        CompassFormat::Vectornav => {
            let yaw = if heading > 180.0 { heading - 360.0 } else { heading };
            format!("VNYPR,{yaw:+08.3},{pitch:+08.3},{roll:+08.3}")
        }
        CompassFormat::Nmea => {
            let (size, letter) =
                (context.declination_deg.abs(), if context.declination_deg < 0.0 { 'W' } else { 'E' });
            if !valid {
                return;
            }
            write_sentence(line, &format!("HCHDG,{h:.1},,,{size:.1},{letter}"));
            format!("HCXDR,A,{pitch:.1},D,PITCH,A,{roll:.1},D,ROLL")
        }
        CompassFormat::Pni => return write_pni(heading, pitch, roll, valid, line),
        CompassFormat::Ubx => {
            return write_ubx((heading + context.declination_deg).rem_euclid(360.0), valid, line);
        }
        CompassFormat::Witmotion if !valid => return,
        CompassFormat::Witmotion => return write_witmotion(heading, pitch, roll, line),
        CompassFormat::Bno08xRvc if !valid => return,
        CompassFormat::Bno08xRvc => return write_rvc(heading, pitch, roll, line),
    };
    write_sentence(line, &body);
}

/// `degrees` rounded to this many digits, 360 becoming 0.
fn wrapped(degrees: f64, digits: i32) -> f64 {
    let scale = 10_f64.powi(digits);
    ((degrees * scale).round() / scale).rem_euclid(360.0)
}
