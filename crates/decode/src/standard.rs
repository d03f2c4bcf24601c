//! Standard NMEA sentences, read by the `nmea` crate one by one and checked.
//!
//! The crate is used without its state: it merges sentences of different times. It also accepts
//! what cannot be (latitude 99°, altitude "NaN") and refuses what is legitimate (a leap second, GLL
//! before NMEA 2.3, GSA of a two-dimensional fix without VDOP, an RMC with the date 000000), so
//! fields are checked before and such sentences are put into a form it reads.

use chrono::Datelike;
use nmea::ParseResult;
use nmea::sentences::{FixType, GgaData, GllData, GnsData, GsaData, RmcData, VtgData, ZdaData};

use super::counts::Refusal;
use super::report::{Date, Kind, Report, angle_deg, time_of_day_ns};
use super::sentence::{Sentence, framed};
use windhover_base::msg::FixKind;

/// Metres a second in a knot.
const KNOT_MPS: f64 = 1852.0 / 3600.0;

/// What a standard sentence says; `None` where it says nothing of a fix.
pub(super) fn read(sentence: &Sentence<'_>) -> Result<Option<Report>, Refusal> {
    let Some(kind) = sentence.formatter().and_then(kind_of) else {
        return Ok(None);
    };
    check_numbers(kind, sentence)?;
    let mut report = Report::new(kind);
    if let Some(field) = time_field(kind) {
        report.time_of_day_ns = time_of_day_ns(sentence.field(field))?;
    }
    let readable = framed(&readable_body(kind, sentence));
    match nmea::parse_str(&readable) {
        Ok(ParseResult::RMC(data)) => of_rmc(&mut report, &data, sentence),
        Ok(ParseResult::GGA(data)) => of_gga(&mut report, &data),
        Ok(ParseResult::GLL(data)) => of_gll(&mut report, &data, sentence),
        Ok(ParseResult::GNS(data)) => of_gns(&mut report, &data, sentence),
        Ok(ParseResult::GSA(data)) => of_gsa(&mut report, &data, sentence)?,
        Ok(ParseResult::VTG(data)) => of_vtg(&mut report, &data, sentence),
        Ok(ParseResult::ZDA(data)) => of_zda(&mut report, &data),
        _ if kind == Kind::Gsa => gsa_by_fields(&mut report, sentence)?,
        _ => return Err(Refusal::Malformed),
    }
    Ok(Some(report))
}

fn kind_of(formatter: &str) -> Option<Kind> {
    Some(match formatter {
        "RMC" => Kind::Rmc,
        "GGA" => Kind::Gga,
        "GNS" => Kind::Gns,
        "GLL" => Kind::Gll,
        "GSA" => Kind::Gsa,
        "VTG" => Kind::Vtg,
        "ZDA" => Kind::Zda,
        _ => return None,
    })
}

const fn time_field(kind: Kind) -> Option<usize> {
    match kind {
        Kind::Rmc | Kind::Gga | Kind::Gns | Kind::Zda => Some(1),
        Kind::Gll => Some(5),
        _ => None,
    }
}

/// Field of the latitude; N/S, longitude and E/W follow it.
const fn latitude_field(kind: Kind) -> Option<usize> {
    match kind {
        Kind::Rmc => Some(3),
        Kind::Gga | Kind::Gns => Some(2),
        Kind::Gll => Some(1),
        _ => None,
    }
}

/// Fields that must be numbers, with the range they can have.
const fn number_fields(kind: Kind) -> &'static [(usize, f64, f64)] {
    match kind {
        // knots; degrees; degrees
        Kind::Rmc => &[(7, 0.0, 2_000.0), (8, 0.0, 360.0), (10, 0.0, 180.0)],
        // satellites; HDOP; metres; metres
        Kind::Gga => &[(7, 0.0, 99.0), (8, 0.0, 9_999.0), (9, -20_000.0, 100_000.0), (11, -1_000.0, 1_000.0)],
        Kind::Gns => &[(7, 0.0, 99.0), (8, 0.0, 9_999.0), (9, -20_000.0, 100_000.0), (10, -1_000.0, 1_000.0)],
        Kind::Gsa => &[(15, 0.0, 9_999.0), (16, 0.0, 9_999.0), (17, 0.0, 9_999.0)],
        // degrees; degrees; knots; km/h
        Kind::Vtg => &[(1, 0.0, 360.0), (3, 0.0, 360.0), (5, 0.0, 2_000.0), (7, 0.0, 4_000.0)],
        _ => &[],
    }
}

fn check_numbers(kind: Kind, sentence: &Sentence<'_>) -> Result<(), Refusal> {
    for &(index, low, high) in number_fields(kind) {
        sentence.number(index, low, high)?;
    }
    if let Some(lat) = latitude_field(kind) {
        let lat_deg = angle_deg(sentence.field(lat), sentence.field(lat + 1), "N", "S")?;
        let lon_deg = angle_deg(sentence.field(lat + 2), sentence.field(lat + 3), "E", "W")?;
        if lat_deg.is_some() != lon_deg.is_some() {
            return Err(Refusal::Malformed);
        }
    }
    Ok(())
}

/// The body in a form the crate reads; the same as it came for all but the cases named above.
fn readable_body(kind: Kind, sentence: &Sentence<'_>) -> String {
    let mut fields: Vec<String> = sentence.body.split(',').map(|field| field.trim().to_owned()).collect();
    if let Some(time) = time_field(kind).and_then(|index| fields.get_mut(index))
        && time.get(4..6) == Some("60")
    {
        time.replace_range(4..6, "59");
    }
    if let Some(lat) = latitude_field(kind).filter(|&lat| sentence.field(lat).is_empty()) {
        // A letter without its number, as some receivers send before the first fix.
        fields.iter_mut().skip(lat).take(4).for_each(String::clear);
    }
    if kind == Kind::Rmc
        && let Some(date) = fields.get_mut(9)
        && Date::of_ddmmyy(date).is_none()
    {
        date.clear();
    }
    if kind == Kind::Gll && sentence.fields() == 6 {
        fields.push(if sentence.field(6) == "A" { "A" } else { "N" }.to_owned());
    }
    fields.join(",")
}

/// Modes in which a receiver has measured its position: autonomous, differential, precise, RTK.
/// Estimated, manual and simulated are not fixes.
fn mode_is_measured(mode: &str) -> bool {
    mode.is_empty() || mode.chars().any(|letter| matches!(letter, 'A' | 'D' | 'F' | 'P' | 'R'))
}

fn of_rmc(report: &mut Report, data: &RmcData, sentence: &Sentence<'_>) {
    let valid = sentence.field(2) != "V" && mode_is_measured(sentence.field(12));
    report.valid = Some(valid);
    report.date = data.fix_date.and_then(|date| Date::new(date.year(), date.month() as u8, date.day() as u8));
    if valid {
        report.position_deg = data.lat.zip(data.lon);
        report.speed_mps = data.speed_over_ground.map(|knots| decimal(knots) * KNOT_MPS);
        report.course_deg = data.true_course.map(decimal);
    }
}

fn of_gga(report: &mut Report, data: &GgaData) {
    let measured = data.fix_type.is_some_and(|fix| {
        !matches!(fix, FixType::Invalid | FixType::Estimated | FixType::Manual | FixType::Simulation)
    });
    // A fix of no satellites is one only if another sentence says so.
    report.valid = (!measured || data.fix_satellites != Some(0)).then_some(measured);
    report.sats = data.fix_satellites;
    report.hdop = data.hdop.map(decimal);
    if measured {
        report.position_deg = data.latitude.zip(data.longitude);
        report.alt_msl_m = data.altitude.map(decimal);
        report.geoid_m = data.geoid_separation.map(decimal);
    }
}

fn of_gns(report: &mut Report, data: &GnsData, sentence: &Sentence<'_>) {
    let mode = sentence.field(6);
    let measured = !mode.is_empty() && mode_is_measured(mode);
    report.valid = Some(measured);
    report.sats = Some(u32::from(data.nsattelites));
    report.hdop = data.hdop.map(decimal);
    if measured {
        report.position_deg = data.lat.zip(data.lon);
        report.alt_msl_m = data.alt.map(decimal);
        report.geoid_m = data.geoid_separation.map(decimal);
    }
}

fn of_gll(report: &mut Report, data: &GllData, sentence: &Sentence<'_>) {
    let valid = data.valid && mode_is_measured(sentence.field(7));
    report.valid = Some(valid);
    if valid {
        report.position_deg = data.latitude.zip(data.longitude);
    }
}

fn of_gsa(report: &mut Report, data: &GsaData, sentence: &Sentence<'_>) -> Result<(), Refusal> {
    report.fix = Some(gsa_fix(sentence)?);
    report.sats_listed = Some(data.fix_sats_prn.len() as u32);
    report.hdop = data.hdop.map(decimal);
    Ok(())
}

/// GSA where the crate refuses it: a two-dimensional fix has no VDOP.
fn gsa_by_fields(report: &mut Report, sentence: &Sentence<'_>) -> Result<(), Refusal> {
    report.fix = Some(gsa_fix(sentence)?);
    report.sats_listed = Some((3..=14).filter(|&index| !sentence.field(index).is_empty()).count() as u32);
    report.hdop = sentence.number(16, 0.0, 9_999.0)?;
    Ok(())
}

fn gsa_fix(sentence: &Sentence<'_>) -> Result<FixKind, Refusal> {
    match sentence.field(2) {
        "1" => Ok(FixKind::None),
        "2" => Ok(FixKind::TwoD),
        "3" => Ok(FixKind::ThreeD),
        _ => Err(Refusal::Malformed),
    }
}

fn of_vtg(report: &mut Report, data: &VtgData, sentence: &Sentence<'_>) {
    if mode_is_measured(sentence.field(9)) {
        report.speed_mps = data.speed_over_ground.map(|knots| decimal(knots) * KNOT_MPS);
        report.course_deg = data.true_course.map(decimal);
    }
}

fn of_zda(report: &mut Report, data: &ZdaData) {
    report.date =
        data.utc_date().and_then(|date| Date::new(date.year(), date.month() as u8, date.day() as u8));
}

/// The decimal that was written: the crate keeps single precision, whose shortest form is it.
fn decimal(value: f32) -> f64 {
    value.to_string().parse().unwrap_or(f64::from(value))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(body: &str) -> Result<Option<Report>, Refusal> {
        read(&Sentence { body })
    }

    fn report(body: &str) -> Report {
        said(body).expect("a sound sentence").expect("a sentence of a fix")
    }

    #[test]
    fn units_and_signs() {
        let rmc = report("GPRMC,101112.2,A,3030.0000,S,08530.0000,W,010.0,090.5,010226,003.4,W,D");
        assert_eq!(rmc.position_deg, Some((-30.5, -85.5)));
        assert_eq!(rmc.course_deg, Some(90.5));
        assert!((rmc.speed_mps.expect("a speed") - 5.1444).abs() < 1e-4);
        assert_eq!(rmc.date, Date::new(2026, 2, 1));
        assert_eq!(rmc.time_of_day_ns, Some(36_672_200_000_000));
        let gga = report("GPGGA,101112,3030.0,N,08530.0,E,2,08,1.1,1577.4,M,-24.6,M,,");
        assert_eq!(
            (gga.alt_msl_m, gga.geoid_m, gga.hdop, gga.sats),
            (Some(1577.4), Some(-24.6), Some(1.1), Some(8))
        );
    }

    #[test]
    fn what_the_crate_refuses_and_is_legitimate() {
        assert_eq!(report("GPGLL,3030.0,N,08530.0,W,101112,A").valid, Some(true));
        assert_eq!(report("GPGLL,3030.0,N,08530.0,W,101112,V").position_deg, None);
        let flat = report("GPGSA,A,2,01,03,,14,,,,,,,,,3.1,3.0,");
        assert_eq!((flat.fix, flat.hdop, flat.sats_listed), (Some(FixKind::TwoD), Some(3.0), Some(3)));
        let leap = report("GPGGA,235960.4,3030.0,N,08530.0,E,1,08,1.1,10.0,M,0.0,M,,");
        assert_eq!(leap.time_of_day_ns, Some(86_400_400_000_000));
        let undated = report("GPRMC,101112,A,3030.0,N,08530.0,W,0.1,,000000,,");
        assert_eq!((undated.date, undated.valid, undated.course_deg), (None, Some(true), None));
    }

    #[test]
    fn what_cannot_be_is_refused() {
        assert_eq!(said("GPGGA,101112,9912.0,N,08530.0,E,1,08,1.1,10.0,M,0.0,M,,"), Err(Refusal::OutOfRange));
        assert_eq!(said("GPGGA,101112,3030.0,N,08530.0,E,1,08,1.1,NaN,M,0.0,M,,"), Err(Refusal::Malformed));
        assert_eq!(said("GPRMC,251112,A,3030.0,N,08530.0,W,0.1,,010226,,"), Err(Refusal::OutOfRange));
        assert_eq!(said("GPRMC,101112"), Err(Refusal::Malformed));
        assert_eq!(said("GPGSA,A,7"), Err(Refusal::Malformed));
    }

    #[test]
    fn estimates_are_not_fixes() {
        assert_eq!(report("GPRMC,101112,A,3030.0,N,08530.0,W,0.1,,010226,,,E").valid, Some(false));
        let gga = report("GPGGA,101112,3030.0,N,08530.0,E,6,00,50.0,10.0,M,0.0,M,,");
        assert_eq!((gga.valid, gga.position_deg, gga.alt_msl_m), (Some(false), None, None));
        assert_eq!(report("GPVTG,,T,,M,,N,,K,N").speed_mps, None);
    }

    #[test]
    fn other_sentences_say_nothing_of_a_fix() {
        assert_eq!(said("GPGSV,1,1,01,02,60,319,36"), Ok(None));
        assert_eq!(said("PGRMT,x"), Ok(None));
    }
}
