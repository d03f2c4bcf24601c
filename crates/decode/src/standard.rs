//! Standard NMEA sentences, read one by one with the `nmea` crate and checked.
//!
//! The time, the position and the status (validity, or the kind of fix) decide about a sentence: it is refused where
//! one of them is impossible. Any other impossible field is left out alone, and counted by its name.
//!
//! | sentence | deciding | used where valid | checked only |
//! |---|---|---|---|
//! | RMC | time, status, position | speed, course, date, mode (also: RTK) | variation |
//! | GGA | time, position | quality (also: RTK), satellites, HDOP, altitude, geoid | |
//! | GNS | time, position | modes (also: RTK), satellites, HDOP, altitude, geoid | |
//! | GLL | time, status, position | mode | |
//! | GSA | kind of fix | satellites, HDOP | PDOP, VDOP |
//! | VTG | | course, speed (knots, else km/h), mode | magnetic course |
//! | ZDA | time | day, month, year | |
//! | GST | time | one-sigma of latitude, longitude, altitude | the ellipse |
//!
//! Unknown modes of GNS count as no measured fix; an unknown mode beside a status (RMC, GLL) or of VTG is left out, so that the
//! status decides; an unknown quality of GGA leaves the decision to the other
//! sentences of its epoch. Fields that are not listed are not read.
//!
//! The crate is used without its state, because it merges sentences of different times. It splits angles at fixed
//! columns, accepts impossible values (altitude "NaN") and refuses a whole sentence for one unusual field. So positions
//! are read here, and the crate gets the sentence with the fields that it needs, checked and in a form that it reads.

use chrono::Datelike;
use nalgebra::Vector3;
use nmea::ParseResult;
use nmea::sentences::{FixType, GgaData, GllData, GnsData, GsaData, RmcData, VtgData, ZdaData};

use super::counts::Refusal;
use super::report::{Date, Kind, Report, Solution, angle_deg, time_of_day_ns};
use super::sentence::{Sentence, framed, number};
use windhover_base::msg::FixKind;

/// Largest one-sigma of a position, m: a larger one means that the error is not known.
const SIGMA_MAX_M: f64 = 1.0e5;

/// Metres a second in a knot.
const KNOT_MPS: f64 = 1852.0 / 3600.0;

/// The report of a standard sentence; `None` where it has no part of a fix.
pub(super) fn read(sentence: &Sentence<'_>) -> Result<Option<Report>, Refusal> {
    let Some(kind) = sentence.formatter().and_then(kind_of) else {
        return Ok(None);
    };
    if sentence.fields() < fields_min(kind) {
        return Err(Refusal::Malformed);
    }
    let mut report = Report::new(kind);
    if kind == Kind::Gst {
        of_gst(&mut report, sentence)?;
        return Ok(Some(report));
    }
    if let Some(field) = time_field(kind) {
        report.time_of_day_ns = time_of_day_ns(sentence.field(field))?;
    }
    let position_deg = position_deg(kind, sentence)?;
    let readable = framed(&readable_body(kind, sentence, &mut report));
    match nmea::parse_str(&readable) {
        Ok(ParseResult::RMC(data)) => of_rmc(&mut report, &data, sentence),
        Ok(ParseResult::GGA(data)) => of_gga(&mut report, &data, sentence),
        Ok(ParseResult::GLL(data)) => of_gll(&mut report, &data, sentence),
        Ok(ParseResult::GNS(data)) => of_gns(&mut report, &data, sentence),
        Ok(ParseResult::GSA(data)) => of_gsa(&mut report, &data, sentence)?,
        Ok(ParseResult::VTG(data)) => of_vtg(&mut report, &data, sentence),
        Ok(ParseResult::ZDA(data)) => of_zda(&mut report, &data),
        _ if kind == Kind::Gsa => gsa_by_fields(&mut report, sentence)?,
        _ => return Err(Refusal::Malformed),
    }
    if report.valid != Some(false) {
        report.position_deg = position_deg;
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
        "GST" => Kind::Gst,
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

/// Fewest fields of a sentence: up to the last that every version of it has.
const fn fields_min(kind: Kind) -> usize {
    match kind {
        Kind::Rmc | Kind::Gga => 9,
        Kind::Gns => 10,
        Kind::Vtg | Kind::Gst => 8,
        Kind::Gll => 6,
        Kind::Zda => 4,
        _ => 2,
    }
}

/// Fields passed to the crate: later ones are not read, and empty fields replace missing ones.
const fn fields_read(kind: Kind) -> Option<usize> {
    match kind {
        Kind::Rmc => Some(12),
        Kind::Gga | Kind::Gns => Some(13),
        Kind::Gll => Some(7),
        Kind::Vtg => Some(9),
        Kind::Zda => Some(6),
        _ => None,
    }
}

/// An optional number: its field, its name, its range.
type Optional = (usize, &'static str, f64, f64);

const fn optional_numbers(kind: Kind) -> &'static [Optional] {
    match kind {
        Kind::Rmc => &[
            (7, "RMC speed", 0.0, 2_000.0),
            (8, "RMC course", 0.0, 360.0),
            (10, "RMC magnetic variation", 0.0, 180.0),
        ],
        Kind::Gga => &[
            (7, "GGA satellites", 0.0, 999.0),
            (8, "GGA HDOP", 0.0, 9_999.0),
            (9, "GGA altitude", -20_000.0, 100_000.0),
            (11, "GGA geoid", -1_000.0, 1_000.0),
        ],
        Kind::Gns => &[
            (7, "GNS satellites", 0.0, 999.0),
            (8, "GNS HDOP", 0.0, 9_999.0),
            (9, "GNS altitude", -20_000.0, 100_000.0),
            (10, "GNS geoid", -1_000.0, 1_000.0),
        ],
        Kind::Gsa => {
            &[(15, "GSA PDOP", 0.0, 9_999.0), (16, "GSA HDOP", 0.0, 9_999.0), (17, "GSA VDOP", 0.0, 9_999.0)]
        }
        Kind::Vtg => &[
            (1, "VTG course", 0.0, 360.0),
            (3, "VTG magnetic course", 0.0, 360.0),
            (5, "VTG speed in knots", 0.0, 2_000.0),
            (7, "VTG speed in km/h", 0.0, 4_000.0),
        ],
        Kind::Zda => {
            &[(2, "ZDA day", 1.0, 31.0), (3, "ZDA month", 1.0, 12.0), (4, "ZDA year", 1_980.0, 9_999.0)]
        }
        _ => &[],
    }
}

/// Latitude and longitude as the sentence gives them, valid or not.
fn position_deg(kind: Kind, sentence: &Sentence<'_>) -> Result<Option<(f64, f64)>, Refusal> {
    let Some(lat) = latitude_field(kind) else {
        return Ok(None);
    };
    let lat_deg = angle_deg(sentence.field(lat), sentence.field(lat + 1), "N", "S")?;
    let lon_deg = angle_deg(sentence.field(lat + 2), sentence.field(lat + 3), "E", "W")?;
    if lat_deg.is_some() != lon_deg.is_some() {
        return Err(Refusal::Malformed);
    }
    Ok(lat_deg.zip(lon_deg))
}

/// The body in a form that the crate reads, without impossible fields; these go to `report`.
fn readable_body(kind: Kind, sentence: &Sentence<'_>, report: &mut Report) -> String {
    let mut fields: Vec<String> = sentence.body.split(',').map(|field| field.trim().to_owned()).collect();
    for &(index, name, low, high) in optional_numbers(kind) {
        if let Some(field) = fields.get_mut(index) {
            let value = report.optional(name, number(field, low, high));
            // Adding zero removes the sign of −0.
            *field = value.map_or_else(String::new, |value| (value + 0.0).to_string());
        }
    }
    if matches!(kind, Kind::Gga | Kind::Gns) && fields[7].contains('.') {
        report.left_out.push(if kind == Kind::Gga { "GGA satellites" } else { "GNS satellites" });
        fields[7].clear();
    }
    if let Some(last) = fields_read(kind) {
        fields.resize(last + 1, String::new());
    }
    if let Some(time) = time_field(kind).and_then(|index| fields.get_mut(index))
        && !time.is_empty()
    {
        let whole = time.find('.').unwrap_or(time.len());
        time.insert_str(0, &"000000"[whole.min(6)..]);
        if time.get(4..6) == Some("60") {
            time.replace_range(4..6, "59");
        }
    }
    if let Some(lat) = latitude_field(kind) {
        fields.iter_mut().skip(lat).take(4).for_each(String::clear);
    }
    match kind {
        Kind::Rmc => readable_rmc(&mut fields, report),
        Kind::Gga => readable_gga(&mut fields, report),
        Kind::Gns => readable_gns(&mut fields),
        Kind::Gll => fields[7] = "N".to_owned(),
        Kind::Zda => readable_zda(&mut fields, report),
        Kind::Vtg => [2, 4, 6, 8, 9].into_iter().for_each(|unit| fields[unit].clear()),
        _ => {}
    }
    fields.join(",")
}

/// The date only where it is valid (000000 means none yet), and no variation.
fn readable_rmc(fields: &mut [String], report: &mut Report) {
    let date = &mut fields[9];
    if date.len() == 5 {
        date.insert(0, '0');
    }
    if Date::of_ddmmyy(date).is_none() {
        if !date.bytes().all(|byte| byte == b'0') {
            report.left_out.push("RMC date");
        }
        date.clear();
    }
    if !fields[10].is_empty() && !matches!(fields[11].as_str(), "E" | "W") {
        report.left_out.push("RMC magnetic variation");
    }
    fields[10..].iter_mut().for_each(String::clear);
}

/// A quality that the crate knows, metres only, and no fields of the corrections.
fn readable_gga(fields: &mut [String], report: &mut Report) {
    match fields[6].as_str() {
        "0" | "1" | "2" | "3" | "4" | "5" | "6" | "7" | "8" => {}
        // A fix with corrections from satellites, in NovAtel's numbering.
        "9" => fields[6] = "2".to_owned(),
        other => {
            if !other.is_empty() {
                report.left_out.push("GGA quality");
            }
            fields[6] = "0".to_owned();
        }
    }
    for (value, name) in [(9, "GGA altitude"), (11, "GGA geoid")] {
        if !fields[value].is_empty() && !matches!(fields[value + 1].as_str(), "" | "M") {
            report.left_out.push(name);
            fields[value].clear();
        }
        fields[value + 1].clear();
    }
    fields[13].clear();
}

/// The modes are read by their letters; the crate knows at most two of them, and needs a count.
fn readable_gns(fields: &mut [String]) {
    fields[6] = "N".to_owned();
    if fields[7].is_empty() {
        fields[7] = "0".to_owned();
    }
    fields[11..].iter_mut().for_each(String::clear);
}

/// Only a valid date, and no zone: some write its sign, and the time is UTC anyway.
fn readable_zda(fields: &mut [String], report: &mut Report) {
    let date = &fields[2..5];
    let whole = |field: &String| field.parse::<u16>().unwrap_or(0);
    let (day, month) = (u8::try_from(whole(&date[0])), u8::try_from(whole(&date[1])));
    let real = |(day, month)| Date::new(i32::from(whole(&date[2])), month, day).is_some();
    if !day.ok().zip(month.ok()).is_some_and(real) {
        if date.iter().all(|field| !field.is_empty()) {
            report.left_out.push("ZDA date");
        }
        fields[2..5].iter_mut().for_each(String::clear);
    }
    fields[5..].iter_mut().for_each(String::clear);
}

/// Modes in which a receiver has measured its position: autonomous, differential, precise, RTK.
/// Estimated, manual and simulated are not fixes.
fn mode_is_measured(mode: &str) -> bool {
    mode.is_empty() || mode.chars().any(|letter| matches!(letter, 'A' | 'D' | 'F' | 'P' | 'R'))
}

/// Whether a mode beside a status leaves the status in force. An unknown one is left out: the status decides.
fn mode_agrees(report: &mut Report, name: &'static str, mode: &str) -> bool {
    let known = mode.is_empty() || mode.chars().any(|letter| "ADFPREMSN".contains(letter));
    if !known {
        report.left_out.push(name);
    }
    !known || mode_is_measured(mode)
}

/// How a measured position was obtained, by the letters of its modes, one for each constellation: as good as the worst
/// of those that took part.
fn solution_of_modes(modes: &str) -> Option<Solution> {
    let letters = modes.chars().filter(|letter| *letter != 'N');
    let solutions = letters.map(|letter| match letter {
        'R' => Solution::RtkFixed,
        'F' => Solution::RtkFloat,
        _ => Solution::Code,
    });
    solutions.min()
}

fn of_rmc(report: &mut Report, data: &RmcData, sentence: &Sentence<'_>) {
    let valid = mode_agrees(report, "RMC mode", sentence.field(12)) && sentence.field(2) != "V";
    report.valid = Some(valid);
    report.date = data.fix_date.and_then(|date| Date::new(date.year(), date.month() as u8, date.day() as u8));
    if valid {
        report.solution = solution_of_modes(sentence.field(12));
        report.speed_mps = data.speed_over_ground.map(|knots| decimal(knots) * KNOT_MPS);
        report.course_deg = data.true_course.map(decimal);
    }
}

fn of_gga(report: &mut Report, data: &GgaData, sentence: &Sentence<'_>) {
    let quality_known = matches!(sentence.field(6).as_bytes(), [b'0'..=b'9']);
    let measured = data.fix_type.is_some_and(|fix| {
        !matches!(fix, FixType::Invalid | FixType::Estimated | FixType::Manual | FixType::Simulation)
    });
    // A fix without satellites, or of unknown quality, is a fix only if another sentence says so.
    let decided = quality_known && (!measured || data.fix_satellites != Some(0));
    report.valid = decided.then_some(measured);
    report.solution = decided.then_some(match data.fix_type {
        Some(FixType::Rtk) => Solution::RtkFixed,
        Some(FixType::FloatRtk) => Solution::RtkFloat,
        _ => Solution::Code,
    });
    report.sats = data.fix_satellites;
    report.hdop = data.hdop.map(decimal);
    if report.valid != Some(false) {
        report.alt_msl_m = data.altitude.map(decimal);
        report.geoid_m = data.geoid_separation.map(decimal);
    }
}

fn of_gns(report: &mut Report, data: &GnsData, sentence: &Sentence<'_>) {
    let mode = sentence.field(6);
    let measured = !mode.is_empty() && mode_is_measured(mode);
    report.valid = Some(measured);
    report.solution = solution_of_modes(mode).filter(|_| measured);
    let count_given = !sentence.field(7).is_empty() && !report.left_out.contains(&"GNS satellites");
    report.sats = count_given.then_some(u32::from(data.nsattelites));
    report.hdop = data.hdop.map(decimal);
    if measured {
        report.alt_msl_m = data.alt.map(decimal);
        report.geoid_m = data.geoid_separation.map(decimal);
    }
}

fn of_gll(report: &mut Report, data: &GllData, sentence: &Sentence<'_>) {
    report.valid = Some(mode_agrees(report, "GLL mode", sentence.field(7)) && data.valid);
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
    report.hdop = sentence.number(16, 0.0, 9_999.0).unwrap_or(None);
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
    if mode_agrees(report, "VTG mode", sentence.field(9)) {
        let by_kmh = || sentence.number(7, 0.0, 4_000.0).unwrap_or(None).map(|kmh| kmh / 3.6);
        report.speed_mps = data.speed_over_ground.map(|knots| decimal(knots) * KNOT_MPS).or_else(by_kmh);
        report.course_deg = data.true_course.map(decimal);
    }
}

/// Errors: time, range residuals, ellipse (two axes and their direction), latitude, longitude, altitude.
fn of_gst(report: &mut Report, sentence: &Sentence<'_>) -> Result<(), Refusal> {
    report.time_of_day_ns = time_of_day_ns(sentence.field(1))?;
    let mut sigma =
        |name, field| report.optional(name, sentence.number(field, 0.0, SIGMA_MAX_M)).filter(|s| *s > 0.0);
    let across = sigma("GST latitude", 6).zip(sigma("GST longitude", 7));
    let up = sigma("GST altitude", 8);
    // Without an altitude the solution is two-dimensional, and its height is not used.
    report.position_sigma_m =
        across.map(|(north, east)| Vector3::new(north, east, up.unwrap_or(SIGMA_MAX_M)));
    Ok(())
}

fn of_zda(report: &mut Report, data: &ZdaData) {
    report.date =
        data.utc_date().and_then(|date| Date::new(date.year(), date.month() as u8, date.day() as u8));
}

/// The decimal as it was written: the crate stores single precision, whose shortest form it is.
fn decimal(value: f32) -> f64 {
    value.to_string().parse().unwrap_or(f64::from(value))
}

#[cfg(test)]
#[path = "standard_tests.rs"]
mod tests;
