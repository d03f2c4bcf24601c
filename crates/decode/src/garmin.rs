//! Garmin's own sentences: PGRME, PGRMV, PGRMF (source: Garmin's technical specifications of the
//! GPS 15x to 18x families).

use nalgebra::Vector3;

use super::counts::Refusal;
use super::report::{Date, Kind, Report, angle_deg, time_of_day_ns};
use super::sentence::Sentence;
use windhover_base::msg::FixKind;

/// The report of a Garmin sentence; `None` where it has no part of a fix.
pub(super) fn read(sentence: &Sentence<'_>) -> Result<Option<Report>, Refusal> {
    match sentence.address() {
        "PGRME" => of_pgrme(sentence).map(Some),
        "PGRMV" => of_pgrmv(sentence).map(Some),
        "PGRMF" => of_pgrmf(sentence).map(Some),
        _ => Ok(None),
    }
}

/// Errors: horizontal, M, vertical, M, overall, M. Empty without a fix.
fn of_pgrme(sentence: &Sentence<'_>) -> Result<Report, Refusal> {
    if sentence.fields() < 4 {
        return Err(Refusal::Malformed);
    }
    let mut report = Report::new(Kind::Pgrme);
    report.hpe_m = report.optional("PGRME horizontal error", sentence.number(1, 0.0, 1e6));
    report.vpe_m = report.optional("PGRME vertical error", sentence.number(3, 0.0, 1e6));
    Ok(report)
}

/// Velocity: east, north, up, m/s (in this order: it agrees with RMC's speed and course).
fn of_pgrmv(sentence: &Sentence<'_>) -> Result<Report, Refusal> {
    if sentence.fields() < 3 {
        return Err(Refusal::Malformed);
    }
    let mut report = Report::new(Kind::Pgrmv);
    let axis = |index| sentence.number(index, -1_000.0, 1_000.0);
    if let (Some(east), Some(north), Some(up)) = (axis(1)?, axis(2)?, axis(3)?) {
        report.vel_ned_mps = Some(Vector3::new(north, east, 0.0 - up));
    }
    Ok(report)
}

/// Fix: week, time of week, ddmmyy, hhmmss, leap seconds, latitude, N/S, longitude, E/W, A/M, fix 0/1/2, speed km/h,
/// course, PDOP, TDOP. The ten-bit week is not used, because the sentence has the date.
fn of_pgrmf(sentence: &Sentence<'_>) -> Result<Report, Refusal> {
    if sentence.fields() < 13 {
        return Err(Refusal::Malformed);
    }
    let mut report = Report::new(Kind::Pgrmf);
    report.date = Date::of_ddmmyy(sentence.field(3));
    if report.date.is_none() && sentence.field(3).bytes().any(|byte| byte != b'0') {
        report.left_out.push("PGRMF date");
    }
    report.time_of_day_ns = time_of_day_ns(sentence.field(4))?;
    let lat_deg = angle_deg(sentence.field(6), sentence.field(7), "N", "S")?;
    let lon_deg = angle_deg(sentence.field(8), sentence.field(9), "E", "W")?;
    let speed_kmh = report.optional("PGRMF speed", sentence.number(12, 0.0, 10_000.0));
    let course_deg = report.optional("PGRMF course", sentence.number(13, 0.0, 360.0));
    let fix = match sentence.field(11) {
        "" | "0" => FixKind::None,
        "1" => FixKind::TwoD,
        "2" => FixKind::ThreeD,
        _ => return Err(Refusal::Malformed),
    };
    report.valid = Some(fix != FixKind::None);
    report.fix = Some(fix);
    if fix != FixKind::None {
        report.position_deg = lat_deg.zip(lon_deg);
        report.speed_mps = speed_kmh.map(|kmh| kmh / 3.6);
        report.course_deg = course_deg;
    }
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(body: &str) -> Report {
        read(&Sentence { body }).expect("a sound sentence").expect("a sentence of a fix")
    }

    #[test]
    fn velocity_is_east_north_up_on_the_wire() {
        assert_eq!(report("PGRMV,-2.5,-1.1,0.3").vel_ned_mps, Some(Vector3::new(-1.1, -2.5, -0.3)));
        assert_eq!(report("PGRMV,,,").vel_ned_mps, None);
    }

    #[test]
    fn errors_are_horizontal_then_vertical() {
        let errors = report("PGRME,15.0,M,45.0,M,25.0,M");
        assert_eq!((errors.hpe_m, errors.vpe_m), (Some(15.0), Some(45.0)));
        assert_eq!(report("PGRME,,M,,M,,M").hpe_m, None);
    }

    #[test]
    fn a_fix_sentence_has_its_own_units() {
        let fix = report("PGRMF,223,424802,010226,140002,13,3030.0000,N,08530.0000,W,A,2,36,090,2,1");
        assert_eq!(fix.position_deg, Some((30.5, -85.5)));
        assert_eq!((fix.speed_mps, fix.course_deg, fix.fix), (Some(10.0), Some(90.0), Some(FixKind::ThreeD)));
        assert_eq!(fix.date, Date::new(2026, 2, 1));
    }

    #[test]
    fn a_field_that_does_not_decide_is_left_out_alone() {
        let errors = report("PGRME,-1.0,M,45.0,M,25.0,M");
        assert_eq!((errors.hpe_m, errors.vpe_m), (None, Some(45.0)));
        assert_eq!(errors.left_out, ["PGRME horizontal error"]);
        let fix = report("PGRMF,x,424802,310226,140002,13,3030.0000,N,08530.0000,W,A,2,36,090,x,1");
        assert_eq!((fix.date, fix.position_deg), (None, Some((30.5, -85.5))));
        assert_eq!(fix.left_out, ["PGRMF date"]);
    }

    #[test]
    fn damage_is_refused() {
        for body in ["PGRME", "PGRMV,1,2", "PGRMV,1,x,3", "PGRMF,1,2,3"] {
            assert!(read(&Sentence { body }).is_err(), "{body}");
        }
    }
}
