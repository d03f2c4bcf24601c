//! Garmin 18x-5Hz sentences: RMC, GGA, PGRME and PGRMV of an epoch.

use std::fmt::Write as _;

use nalgebra::Vector3;

use super::scenario::Scenario;
use windhover_base::msg::{FixKind, GnssEpoch};
use windhover_base::time::UtcTime;

/// Knots in a metre a second.
const KN_PER_MPS: f64 = 3_600.0 / 1_852.0;

/// Appends the sentences of an epoch as the receiver sends them.
pub(super) fn write_epoch(scenario: &Scenario, epoch: &GnssEpoch, line: &mut Vec<u8>) {
    let Some(utc) = epoch.utc else { return };
    let position = position_fields(epoch);
    let fix = epoch.fix != FixKind::None;
    write_sentence(line, &rmc(scenario, epoch, utc, &position));
    write_sentence(line, &gga(epoch, utc, &position));
    if fix {
        let (hpe, vpe) = (epoch.hpe_m.unwrap_or(0.0), epoch.vpe_m.unwrap_or(0.0));
        let epe = hpe.hypot(vpe);
        write_sentence(line, &format!("PGRME,{hpe:.1},M,{vpe:.1},M,{epe:.1},M"));
    } else {
        write_sentence(line, "PGRME,,M,,M,,M");
    }
    match epoch.vel_ned_mps {
        Some(v) if fix => {
            let digits = scenario.gps.velocity_decimals as usize;
            let (east, north, up) = (v.y, v.x, -v.z);
            write_sentence(line, &format!("PGRMV,{east:.digits$},{north:.digits$},{up:.digits$}"));
        }
        _ => write_sentence(line, "PGRMV,,,"),
    }
}

/// Frames a body as `$body*HH\r\n`: HH is the exclusive or of the body's bytes.
pub(super) fn write_sentence(line: &mut Vec<u8>, body: &str) {
    let sum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    line.extend_from_slice(format!("${body}*{sum:02X}\r\n").as_bytes());
}

fn time_of_day(utc: UtcTime) -> String {
    let c = utc.civil();
    format!("{:02}{:02}{:02}.{}", c.hour, c.minute, c.second, c.nanosecond / 100_000_000)
}

/// `ddmm.mmmmm,N,dddmm.mmmmm,E`, or the same commas with nothing between.
fn position_fields(epoch: &GnssEpoch) -> String {
    let (Some(lat), Some(lon)) = (epoch.lat_deg, epoch.lon_deg) else { return ",,,".into() };
    let mut fields = String::with_capacity(28);
    for (degrees, width, (positive, negative)) in [(lat, 2, ('N', 'S')), (lon, 3, ('E', 'W'))] {
        // In whole hundred-thousandths of a minute, so that 59.999996 minutes carry into the degree.
        let units = (degrees.abs() * 6e6).round() as u64;
        let (whole, minutes) = (units / 6_000_000, (units % 6_000_000) as f64 / 1e5);
        let letter = if degrees < 0.0 { negative } else { positive };
        let comma = if width == 2 { "," } else { "" };
        let _ = write!(fields, "{whole:0width$}{minutes:08.5},{letter}{comma}");
    }
    fields
}

fn rmc(scenario: &Scenario, epoch: &GnssEpoch, utc: UtcTime, position: &str) -> String {
    let c = utc.civil();
    let date = format!("{:02}{:02}{:02}", c.day, c.month, c.year.rem_euclid(100));
    let declination = scenario.declination_deg;
    let variation = format!("{:05.1},{}", declination.abs(), if declination < 0.0 { 'W' } else { 'E' });
    let time = time_of_day(utc);
    let velocity = epoch.vel_ned_mps.unwrap_or_else(Vector3::zeros);
    if epoch.fix == FixKind::None {
        return format!("GPRMC,{time},V,,,,,,,{date},{variation},N");
    }
    let knots = velocity.x.hypot(velocity.y) * KN_PER_MPS;
    let course = epoch.course_deg.unwrap_or(0.0);
    format!("GPRMC,{time},A,{position},{knots:05.1},{course:05.1},{date},{variation},D")
}

fn gga(epoch: &GnssEpoch, utc: UtcTime, position: &str) -> String {
    let (time, sats) = (time_of_day(utc), epoch.sats.unwrap_or(0));
    match (epoch.fix, epoch.alt_msl_m, epoch.geoid_m) {
        (FixKind::None, _, _) | (_, None, _) | (_, _, None) => {
            format!("GPGGA,{time},{position},0,{sats:02},,,M,,M,,")
        }
        (_, Some(alt), Some(geoid)) => {
            let hdop = epoch.hdop.unwrap_or(1.0);
            format!("GPGGA,{time},{position},2,{sats:02},{hdop:.1},{alt:.1},M,{geoid:.1},M,,")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Sample, SensorSuite, World};

    #[test]
    fn sentences_have_the_form_of_the_manual() {
        let scenario = Scenario::named("gps-outage").expect("known");
        let suite = SensorSuite::new(std::sync::Arc::new(World::new(scenario.clone(), 4)));
        let mut without_fix = 0;
        for sample in suite {
            let Sample::Gnss { stamped, .. } = sample else { continue };
            let mut line = Vec::new();
            write_epoch(&scenario, &stamped.value, &mut line);
            let text = String::from_utf8(line).expect("ASCII");
            let sentences: Vec<_> = text.split_terminator("\r\n").collect();
            assert_eq!(sentences.len(), 4);
            let fields: Vec<usize> = sentences.iter().map(|s| s.split(',').count()).collect();
            assert_eq!(fields, [13, 15, 7, 4], "{text}");
            if stamped.value.fix == FixKind::None {
                without_fix += 1;
                assert!(sentences[0].contains(",V,,,,,,,"), "{text}");
            } else {
                assert!(sentences[0].contains(",A,3004.") && sentences[0].contains(",N,08534."), "{text}");
                assert!(text.len() <= 223, "longer than the manual's longest: {}", text.len());
            }
        }
        assert!((24..=26).contains(&without_fix), "{without_fix}");
    }
}
