//! Standard sentences: fields, what is left out of them, what is refused.

use proptest::prelude::*;

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
fn times_and_dates_read_the_same_without_leading_zeros() {
    for (plain, padded) in [
        (
            "GPRMC,93021.20,A,530.0,N,100.0,E,0.1,,10226,,,A",
            "GPRMC,093021.20,A,530.0,N,100.0,E,0.1,,010226,,,A",
        ),
        (
            "GPGGA,3021,530.0,N,100.0,E,1,8,1.1,10.0,M,,M,,",
            "GPGGA,003021,530.0,N,100.0,E,1,8,1.1,10.0,M,,M,,",
        ),
        ("GNGNS,1,530.0,N,100.0,E,AN,8,1.1,10.0,,,", "GNGNS,000001,530.0,N,100.0,E,AN,8,1.1,10.0,,,"),
        ("GPGLL,530.0,N,100.0,E,0.50,A,A", "GPGLL,530.0,N,100.0,E,000000.50,A,A"),
        ("GPZDA,93021,1,2,2026,,", "GPZDA,093021,01,02,2026,,"),
    ] {
        let read = report(plain);
        assert_eq!(read, report(padded), "{plain}");
        assert!(read.left_out.is_empty() && read.time_of_day_ns.is_some(), "{plain}");
    }
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
    assert_eq!(said("GPRMC,251112,A,3030.0,N,08530.0,W,0.1,,010226,,"), Err(Refusal::OutOfRange));
    assert_eq!(said("GPRMC,101112"), Err(Refusal::Malformed));
    assert_eq!(said("GPGSA,A,7"), Err(Refusal::Malformed));
}

#[test]
fn a_field_that_cannot_be_is_left_out_alone() {
    let rmc = |motion: &str, variation: &str| {
        format!("GPRMC,101112,A,3030.0,N,08530.0,W,{motion},010226,{variation},A")
    };
    let gga = |fields: &str| format!("GPGGA,101112,3030.0,N,08530.0,W,{fields},,");
    for (body, left_out) in [
        (rmc("5.0,90.0", "999.9000,E"), "RMC magnetic variation"),
        (rmc("5.0,90.0", "0,N"), "RMC magnetic variation"),
        (rmc("5.0,90.0", "3.4,"), "RMC magnetic variation"),
        (rmc("5.0,-45", ","), "RMC course"),
        (rmc("5.0,360.01", ","), "RMC course"),
        (rmc("-5.0,90.0", ","), "RMC speed"),
        (gga("1,08,10000,43.0,M,50.0,M"), "GGA HDOP"),
        (gga("1,08,1.1,NaN,M,50.0,M"), "GGA altitude"),
        (gga("1,08,1.1,43.0,f,50.0,M"), "GGA altitude"),
        (gga("1,8.5,1.1,43.0,M,50.0,M"), "GGA satellites"),
        (gga("x,08,1.1,43.0,M,50.0,M"), "GGA quality"),
    ] {
        let report = report(&body);
        assert_eq!(report.left_out, [left_out], "{body}");
        assert_eq!(report.position_deg, Some((30.5, -85.5)), "{body}");
        assert_eq!(report.time_of_day_ns, Some(36_672_000_000_000), "{body}");
        if body.starts_with("GPRMC") {
            assert_eq!((report.valid, report.date), (Some(true), Date::new(2026, 2, 1)), "{body}");
            assert_eq!(report.speed_mps.is_some(), left_out != "RMC speed", "{body}");
            assert_eq!(report.course_deg.is_some(), left_out != "RMC course", "{body}");
        } else {
            let altitude = (left_out != "GGA altitude").then_some(43.0);
            assert_eq!((report.alt_msl_m, report.geoid_m), (altitude, Some(50.0)), "{body}");
            assert_eq!(report.valid, (left_out != "GGA quality").then_some(true), "{body}");
        }
    }
}

#[test]
fn what_nobody_needs_is_not_read() {
    assert_eq!(report("GPZDA,120000.00,18,11,2026,+00,00").date, Date::new(2026, 11, 18));
    assert_eq!(report("GPZDA,120000.00,18,11,2026,-15,99").date, Date::new(2026, 11, 18));
    let nowhere = report("GPZDA,120000.00,31,02,2026,00,00");
    assert_eq!((nowhere.date, nowhere.left_out), (None, vec!["ZDA date"]));
    let long = report(
        "GPGGA,101112.000000,3030.000000000000,N,08530.000000000000,W,9,08,1.100000,43.000000,M,50.000000,M,12.0,0123",
    );
    assert_eq!((long.valid, long.position_deg), (Some(true), Some((30.5, -85.5))));
    assert_eq!((long.alt_msl_m, long.hdop, long.left_out.len()), (Some(43.0), Some(1.1), 0));
    let metric = report("GPVTG,90.0,T,,M,999999,N,36.0,K,A");
    assert_eq!((metric.speed_mps, metric.left_out), (Some(10.0), vec!["VTG speed in knots"]));
}

#[test]
fn a_gns_has_a_mode_for_each_constellation() {
    for modes in ["A", "AN", "NNR", "RRRR", "DDDDDD", "XXA"] {
        let gns = report(&format!("GNGNS,120000.00,3030.0,N,08530.0,W,{modes},14,0.6,50.1,48.0,1.0,0000,V"));
        assert_eq!(gns.valid, Some(true), "{modes}");
        assert_eq!(gns.position_deg, Some((30.5, -85.5)), "{modes}");
        assert_eq!((gns.alt_msl_m, gns.geoid_m, gns.sats), (Some(50.1), Some(48.0), Some(14)), "{modes}");
    }
    for modes in ["", "N", "NNNN", "EEE", "MS"] {
        let gns = report(&format!("GNGNS,120000.00,3030.0,N,08530.0,W,{modes},,,50.1,48.0"));
        assert_eq!((gns.valid, gns.position_deg, gns.sats), (Some(false), None, None), "{modes}");
    }
}

/// A valid sentence of each kind with a position, and the fields that decide about it.
const POSITIONED: [(&str, &[usize]); 4] = [
    ("GPRMC,101112,A,3030.0,N,08530.0,W,5.0,90.0,010226,3.4,W,A,V", &[1, 2, 3, 4, 5, 6, 12]),
    ("GPGGA,101112,3030.0,N,08530.0,W,1,08,1.1,43.0,M,50.0,M,1.0,0001", &[1, 2, 3, 4, 5]),
    ("GNGNS,101112,3030.0,N,08530.0,W,AAN,14,0.6,50.1,48.0,1.0,0000,V", &[1, 2, 3, 4, 5, 6]),
    ("GPGLL,3030.0,N,08530.0,W,101112,A,A", &[1, 2, 3, 4, 5, 6, 7]),
];

proptest! {
    #[test]
    fn no_field_but_those_that_decide_takes_the_position(
        which in 0usize..4,
        at in 0usize..20,
        junk in "[-+.0-9A-Za-z ]{0,24}",
    ) {
        let (body, deciding) = POSITIONED[which];
        let mut fields: Vec<&str> = body.split(',').collect();
        let at = 1 + at % (fields.len() - 1);
        prop_assume!(!deciding.contains(&at));
        fields[at] = &junk;
        let report = report(&fields.join(","));
        prop_assert!(report.valid != Some(false) || Kind::Gga == report.kind);
        prop_assert_eq!(report.position_deg.is_some(), report.valid != Some(false));
        prop_assert_eq!(report.time_of_day_ns, Some(36_672_000_000_000));
        prop_assert!(report.left_out.len() <= 1);
    }
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
