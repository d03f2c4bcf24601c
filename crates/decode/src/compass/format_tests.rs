//! The readings of each format's sentences.

use super::*;
use crate::sentence::framed;
use crate::ubx::ubx_framed;

pub(super) fn said(format: CompassFormat, body: &str) -> Result<Option<CompassReading>, Refusal> {
    let framed = framed(body);
    let sentence = Sentence::of_line(framed.as_bytes())?;
    match reader(format) {
        Reader::Sentences(read)
        | Reader::SentencesOrBare(read, _)
        | Reader::Receiver { sentence: read, .. } => read(&sentence, &mut DecodeCounts::default()),
        Reader::Packets | Reader::Records(_) => panic!("these are not sentences"),
    }
}

fn reading(format: CompassFormat, body: &str) -> (Option<f64>, Option<f64>, Option<f64>, bool, bool) {
    let r = said(format, body).expect("a sound sentence").expect("a reading");
    (r.heading_deg, r.pitch_deg, r.roll_deg, r.heading_is_true, r.is_valid())
}

#[test]
fn tcm2_words_and_error_bits() {
    let word = "C328.3P28.4R-12.4X55.11Y12.33Z-18.43T22.3";
    let all = (Some(328.3), Some(28.4), Some(-12.4), false, true);
    assert_eq!(reading(CompassFormat::Tcm2, word), all);
    assert_eq!(
        reading(CompassFormat::Tcm2, &format!("{word}E010")),
        all,
        "a command error is not the reading's"
    );
    assert_eq!(reading(CompassFormat::Tcm2, &format!("{word}E400")), all, "nor one of the memory");
    let no_heading = (None, Some(28.4), Some(-12.4), false, false);
    assert_eq!(reading(CompassFormat::Tcm2, &format!("{word}E001")), no_heading);
    assert_eq!(reading(CompassFormat::Tcm2, &format!("{word}E004")), no_heading);
    let nothing = (None, None, None, false, false);
    assert_eq!(reading(CompassFormat::Tcm2, &format!("{word}E002")), nothing);
    assert_eq!(reading(CompassFormat::Tcm2, &format!("{word}EC06")), nothing);
    assert_eq!(reading(CompassFormat::Tcm2, "C12.0"), (Some(12.0), None, None, false, true));
    assert_eq!(reading(CompassFormat::Tcm2, "HCHDM,41.5,M"), (Some(41.5), None, None, false, true));
}

#[test]
fn tcm2_damage() {
    for body in ["C", "C12.0P", "C12..0", "C400.0", "C12.0P195.0", "C12.0E01", "C12.0EXYZ", "C1-2"] {
        assert!(!matches!(said(CompassFormat::Tcm2, body), Ok(Some(_))), "{body}");
    }
}

#[test]
fn oceanserver_words_have_tags_of_two_letters() {
    let word = "C320.5P0.2R-18.3T19.0Mx12.5My-3.0Mz40.0Ax0.01Ay0.0Az1.0";
    assert_eq!(reading(CompassFormat::Os5000, word), (Some(320.5), Some(0.2), Some(-18.3), false, true));
    assert_eq!(reading(CompassFormat::Os5000, "OHPR,320.5,0.2,-18.3,19.0").0, Some(320.5));
    assert_eq!(reading(CompassFormat::Os5000, "HCHDT,320.5,T"), (Some(320.5), None, None, true, true));
}

#[test]
fn honeywell_alarms() {
    let normal = reading(CompassFormat::Hmr3000, "PTNTHPR,85.9,N,-0.9,M,0.8,O");
    assert_eq!(normal, (Some(85.9), Some(-0.9), Some(0.8), false, true), "warnings are not alarms");
    let heading = reading(CompassFormat::Hmr3000, "PTNTHPR,85.9,P,-0.9,N,0.8,N");
    assert_eq!(heading, (None, Some(-0.9), Some(0.8), false, false));
    let roll = reading(CompassFormat::Hmr3000, "PTNTHPR,85.9,N,-0.9,N,0.8,L");
    assert_eq!(roll, (None, Some(-0.9), None, false, false));
}

#[test]
fn revolution_counts_are_parts_of_a_turn() {
    let (heading, pitch, roll, _, valid) =
        reading(CompassFormat::Revolution, "PTNTHTM,16384,N,182,N,-182,N,13641,2454");
    assert_eq!((heading, valid), (Some(90.0), true));
    assert!((pitch.expect("given") - 1.0).abs() < 1e-3 && (roll.expect("given") + 1.0).abs() < 1e-3);
    assert_eq!(said(CompassFormat::Revolution, "HCXDR,A,171,D,PITCH,A,-37,D,ROLL"), Ok(None));
}

#[test]
fn pashr_has_roll_first() {
    let body = "PASHR,204132.000,010.51,T,+00.39,-00.79,-00.84,0.151,0.075,0.555,1,0";
    assert_eq!(reading(CompassFormat::Pashr, body), (Some(10.51), Some(-0.79), Some(0.39), true, true));
    let lost = "PASHR,204132.000,010.51,T,+00.39,-00.79,-00.84,0.151,0.075,0.555,0,0";
    assert_eq!(reading(CompassFormat::Pashr, lost), (None, Some(-0.79), Some(0.39), true, false));
    assert_eq!(said(CompassFormat::Pashr, "PASHR,ATT,100.0,1.0,2.0,3.0,0.1,0.1,0"), Ok(None));
}

#[test]
fn nmea_headings_and_transducers() {
    assert_eq!(reading(CompassFormat::Nmea, "HCHDG,359.0,2.0,E,3.4,W").0, Some(1.0));
    assert_eq!(reading(CompassFormat::Nmea, "HCHDG,,,,,"), (None, None, None, false, false));
    assert_eq!(reading(CompassFormat::Nmea, "GPHDT,274.07,T"), (Some(274.07), None, None, true, true));
    assert_eq!(reading(CompassFormat::Nmea, "GPTHS,274.0,V"), (None, None, None, true, false));
    let tilt = reading(CompassFormat::Nmea, "HCXDR,A,-1.5,D,PITCH,A,2.5,D,ROLL,G,367,,MAGX");
    assert_eq!(tilt, (None, Some(-1.5), Some(2.5), false, true));
    assert_eq!(said(CompassFormat::Nmea, "GPRMC,1,2"), Ok(None));
}

#[test]
fn a_field_that_does_not_decide_is_left_out_alone() {
    use CompassFormat::{Nmea, Os5000, Tcm2, Vectornav};
    for (format, body, field) in [
        (Nmea, "HCHDG,98.3,0.5,,12.6,W", "HDG deviation"),
        (Nmea, "HCHDG,98.3,999.9,E,,", "HDG deviation"),
        (Nmea, "HCHDG,98.3,x,E,,", "HDG deviation"),
        (Nmea, "PRDID,999,1.5,98.3", "pitch between antennas"),
        (Nmea, "PTNL,AVR,181059.6,98.3,Yaw,1.0,Tilt,x,Roll,60.191,3,2.5,6", "roll between antennas"),
        (Nmea, "PASHR,204132.000,98.3,T,-999.9,-00.79,-00.84,0.151,0.075,0.555,1,0", "PASHR roll"),
        (Tcm2, "C98.3P28.4R-12.4T9999999999", "a value beside heading, pitch and roll"),
        (Os5000, "C98.3P0.2R-18.3T--5", "a value beside heading, pitch and roll"),
        (Vectornav, "VNYMR,98.3,1.0,2.0,0,0,0,0,0,-9.8,nan,0,0", "rates"),
        (Vectornav, "VNYMR,98.3,1.0,2.0,0,0,0,5000,0,-9.8,0,0,0", "forces"),
    ] {
        let (out, counts) = readings(format, format!("{}\r\n", framed(body)).as_bytes());
        let [read] = &out[..] else { panic!("{body}: {counts}") };
        assert_eq!(read.reading.heading_deg, Some(98.3), "{body}");
        assert_eq!(counts.left_out().collect::<Vec<_>>(), [(field, 1)], "{body}");
    }
    let (out, counts) = readings(Nmea, format!("{}\r\n", framed("HCHDG,98.3,0.0,,,")).as_bytes());
    assert_eq!((out[0].reading.heading_deg, counts.left_out().count()), (Some(98.3), 0), "nothing is lost");
    let (out, counts) =
        readings(Nmea, format!("{}\r\n", framed("YXXDR,A,999,D,PTCH,A,2.5,D,ROLL")).as_bytes());
    assert_eq!((out[0].reading.roll_deg, counts.left_out().next()), (Some(2.5), Some(("XDR pitch", 1))));
}

fn readings(format: CompassFormat, bytes: &[u8]) -> (Vec<ReceivedAttitude>, DecodeCounts) {
    let (mut decoder, mut out) = (CompassDecoder::new(format), Vec::new());
    decoder.push(bytes, MonoTime::from_ns(5), &mut out);
    decoder.flush(&mut out);
    (out, decoder.counts().clone())
}

#[test]
fn a_sample_has_radians_and_its_place_in_time() {
    let bytes = format!("junk{}\r\n$C", framed("C180.0P-2.0R1.0"));
    let (out, counts) = readings(CompassFormat::Tcm2, bytes.as_bytes());
    assert_eq!(out.len(), 1, "{counts}");
    let tilt = out[0].sample.tilt.expect("both angles are given");
    assert!((out[0].sample.heading.expect("given") - std::f64::consts::PI).abs() < 1e-12);
    assert!((tilt.pitch + 2f64.to_radians()).abs() < 1e-12 && (tilt.roll - 1f64.to_radians()).abs() < 1e-12);
    assert_eq!((out[0].bytes, out[0].bytes_after, counts.noise_bytes), (20, 3, 4));
}

#[test]
fn bare_lines_count_only_from_a_device_that_never_sends_checksums() {
    let (out, _) = readings(CompassFormat::Os5000, b"12.5,1.0,-2.0,20.0\r\n");
    assert_eq!(out[0].reading.heading_deg, Some(12.5));
    let mixed = format!("{}\r\n12.5,1.0,-2.0,20.0\r\n", framed("OHPR,12.5,1.0,-2.0,20.0"));
    let (out, counts) = readings(CompassFormat::Os5000, mixed.as_bytes());
    assert_eq!((out.len(), counts.refused(Refusal::NoChecksum)), (1, 1), "{counts}");
}

#[test]
fn tilt_needs_both_angles() {
    let reading = CompassReading { pitch_deg: Some(1.0), ..CompassReading::default() };
    assert!(reading.sample().tilt.is_none() && reading.is_valid());
}

fn bursts(bodies: &[&str], times: usize) -> String {
    let burst: String = bodies.iter().map(|body| framed(body) + "\r\n").collect();
    burst.repeat(times)
}

#[test]
fn angles_in_sentences_of_their_own_make_one_reading() {
    let bodies = ["APXDR,A,3.873,D,ROLL", "APHDM,218.652,M", "APXDR,A,0.145,D,PTCH"];
    for rotated in 0..3 {
        let mut bodies = bodies;
        bodies.rotate_left(rotated);
        for times in [1, 2, 9] {
            let (out, counts) = readings(CompassFormat::Nmea, bursts(&bodies, times).as_bytes());
            assert_eq!((out.len(), counts.used), (times, 3 * times as u64), "{counts}");
            for received in out {
                let CompassReading { heading_deg, pitch_deg, roll_deg, .. } = received.reading;
                assert_eq!((heading_deg, pitch_deg, roll_deg), (Some(218.652), Some(0.145), Some(3.873)));
            }
        }
    }
}

#[test]
fn a_heading_reported_in_several_ways_counts_once() {
    let all = ["HCHDG,101.1,,,7.1,W", "HCHDM,101.1,M", "HCHDT,94.0,T", "HCTHS,94.0,A"];
    for ways in 1..=4 {
        let (out, counts) = readings(CompassFormat::Nmea, bursts(&all[..ways], 20).as_bytes());
        assert_eq!((out.len(), counts.used, counts.ignored), (20, 20, 20 * (ways as u64 - 1)), "{counts}");
        assert!(out.iter().all(|received| received.reading.heading_deg == Some(101.1)));
    }
    let derived_only = bursts(&["HCHDG,,,,,", "HCHDT,94.0,T"], 3);
    let (out, _) = readings(CompassFormat::Nmea, derived_only.as_bytes());
    let first = out[0].reading;
    assert_eq!(
        (out.len(), first.heading_deg, first.heading_is_true, first.is_valid()),
        (3, Some(94.0), true, true)
    );
}

#[test]
fn what_repeats_a_whole_attitude_says_nothing_more() {
    let bodies = ["PTNTHPR,85.9,N,-0.9,N,0.8,N", "HCHDG,85.9,,,,", "HCXDR,A,-0.9,D,PITCH,A,0.8,D,ROLL"];
    for rotated in 0..3 {
        let mut bodies = bodies;
        bodies.rotate_left(rotated);
        let (out, counts) = readings(CompassFormat::Hmr3000, bursts(&bodies, 10).as_bytes());
        assert_eq!(out.len(), 10, "{counts}");
        assert!(
            out.iter().all(|received| received.sample.tilt.is_some() && received.sample.heading.is_some())
        );
    }
}

#[test]
fn a_reading_is_complete_with_its_last_sentence_once_its_end_is_known() {
    let (mut decoder, mut out) = (CompassDecoder::new(CompassFormat::Nmea), Vec::new());
    let bodies = ["HCHDG,101.1,,,,", "HCXDR,A,1.5,D,PITCH", "HCXDR,A,2.5,D,ROLL"];
    // The recording starts in the middle of a burst, 33 ms from burst to burst, 6 ms from sentence to sentence.
    for n in 1..60 {
        let (burst, sentence) = (n / 3, n % 3);
        let t = MonoTime::from_ns(burst * 33_000_000 + sentence * 6_000_000);
        decoder.push(bursts(&bodies[sentence as usize..][..1], 1).as_bytes(), t, &mut out);
        if burst >= 12 {
            let last = out.last().expect("some were output");
            assert_eq!(last.t_recv == t, sentence == 2, "sentence {n}");
            assert!(last.sample.heading.is_some() && last.sample.tilt.is_some());
            if sentence == 2 {
                assert_eq!(last.t_first, MonoTime::from_ns(burst * 33_000_000), "it began with its heading");
            }
        }
    }
    // The last reading of a device that falls silent is output.
    decoder.push(bursts(&bodies[..1], 1).as_bytes(), MonoTime::from_ns(2_000_000_000), &mut out);
    let before = out.len();
    decoder.tick(MonoTime::from_ns(2_400_000_000), &mut out);
    assert_eq!(out.len(), before + 1);
}

#[test]
fn vectornav_tells_angles_or_a_quaternion() {
    let reported = (Some(85.123), Some(-0.9), Some(0.8), false, true);
    for body in [
        "VNYPR,+085.123,-000.900,+000.800",
        "VNYMR,+085.123,-000.900,+000.800,+01.0640,-00.2531,+03.0614,+00.005,+00.344,-09.758,-0.001,-0.001,-0.001",
        "VNYBA,+085.123,-000.900,+000.800,+00.1,+00.2,+00.3,0,0,0",
    ] {
        assert_eq!(reading(CompassFormat::Vectornav, body), reported, "{body}");
    }
    assert_eq!(reading(CompassFormat::Vectornav, "VNYPR,-090.000,+001.0,-002.0").0, Some(270.0));
    // A rotation by 90 degrees about down, then by 30 about the right wing.
    let half = std::f64::consts::FRAC_PI_4;
    let (s, c, p) = (half.sin(), half.cos(), 15f64.to_radians());
    let body = format!(
        "VNQMR,{:.6},{:.6},{:.6},{:.6},0,0,0,0,0,0,0,0,0",
        -s * p.sin(),
        c * p.sin(),
        s * p.cos(),
        c * p.cos()
    );
    let (heading, pitch, roll, ..) = reading(CompassFormat::Vectornav, &body);
    for (angle, wanted) in [(heading, 90.0), (pitch, 30.0), (roll, 0.0)] {
        assert!((angle.expect("given") - wanted).abs() < 1e-3, "{angle:?}");
    }
    assert_eq!(said(CompassFormat::Vectornav, "VNQTN,0.5,0.5,0.5,0.6"), Err(Refusal::OutOfRange));
    for (body, expected) in [
        ("VNYPR,nan,-000.900,+000.800", (None, Some(-0.9), Some(0.8))),
        ("VNYPR,+085.123,+inf,+000.800", (Some(85.123), None, Some(0.8))),
        ("VNYPR,+085.123,-000.900,+900.0", (Some(85.123), Some(-0.9), None)),
    ] {
        let (heading, pitch, roll, ..) = reading(CompassFormat::Vectornav, body);
        assert_eq!((heading, pitch, roll), expected, "{body}");
    }
    assert!(said(CompassFormat::Vectornav, "VNYPR,nan,nan,nan").is_err());
    let ins = |status| {
        format!(
            "VNINS,333811.902862,1694,{status},+009.500,-004.754,-000.225,+32.95602815,-096.7,160.4,0,0,0,1.0,0.1,0.1"
        )
    };
    assert_eq!(
        reading(CompassFormat::Vectornav, &ins("0002")),
        (Some(9.5), Some(-4.754), Some(-0.225), true, true)
    );
    assert_eq!(reading(CompassFormat::Vectornav, &ins("0000")).0, None, "it is not aligned");
    assert_eq!(said(CompassFormat::Vectornav, "VNMAG,1.0,2.0,3.0"), Ok(None));
}

#[test]
fn headings_between_antennas_are_true() {
    for (body, wanted) in [
        ("GNHPR,040400.00,201.75,+1.20,000.00,4,33,1.00,0004", (Some(201.75), None, None, true, true)),
        ("GNHPR,040400.00,201.75,+1.20,000.00,0,33,1.00,0004", (None, None, None, true, false)),
        (
            "PTNL,AVR,181059.6,+149.4688,Yaw,+0.0134,Tilt,,,60.191,3,2.5,6",
            (Some(149.4688), None, None, true, true),
        ),
        (
            "PTNL,AVR,212405.20,-10.5,Yaw,+1.5,Tilt,-2.5,Roll,12.575,3,1.4,16",
            (Some(349.5), Some(1.5), Some(-2.5), true, true),
        ),
        ("PTNL,AVR,212405.20,+10.5,Yaw,+1.5,Tilt,-2.5,Roll,12.575,0,1.4,16", (None, None, None, true, false)),
        ("PSAT,HPR,184051.50,281.1,1.7,-0.4,N", (Some(281.1), Some(1.7), Some(-0.4), true, true)),
        ("PSSN,HRP,142820.2,010120,127.5,,-1.5,0.1,,0.2,12,2,E", (Some(127.5), None, None, true, true)),
        (
            "PSSN,HRP,142820.2,010120,127.5,0.5,-1.5,0.1,0.1,0.2,12,2,E",
            (Some(127.5), Some(-1.5), Some(0.5), true, true),
        ),
        ("PSSN,HRP,142820.2,010120,,,,,,,12,0,E", (None, None, None, true, false)),
        ("PRDID,-001.31,+007.81,047.31", (Some(47.31), Some(-1.31), Some(7.81), true, true)),
    ] {
        assert_eq!(reading(CompassFormat::Nmea, body), wanted, "{body}");
    }
    for body in ["PTNL,AVR,1", "PSAT,HPR,1", "GNHPR", "PRDID,1,2", "PTNL,AVR,1,400.0,Yaw,0,Tilt,,,1,3,1,1"] {
        assert!(said(CompassFormat::Nmea, body).is_err(), "{body}");
    }
    for body in ["PTNL,GGK,1,2", "PSAT,GBS,1,2", "PSSN,SNC,1"] {
        assert_eq!(said(CompassFormat::Nmea, body), Ok(None), "{body}");
    }
}

/// All readings of a format from bytes.
pub(super) fn all(format: CompassFormat, bytes: &[u8]) -> (Vec<CompassReading>, DecodeCounts) {
    let (mut decoder, mut out) = (CompassDecoder::new(format), Vec::new());
    decoder.push(bytes, MonoTime::default(), &mut out);
    decoder.flush(&mut out);
    (out.iter().map(|received| received.reading).collect(), decoder.counts().clone())
}

/// NAV-RELPOSNED of this version with this heading, 1e-5 degrees, and these flags.
fn relative(version: u8, heading: i32, flags: u32) -> Vec<u8> {
    let mut payload = vec![0; 64];
    payload[0] = version;
    payload[24..28].copy_from_slice(&heading.to_le_bytes());
    payload[60..].copy_from_slice(&flags.to_le_bytes());
    ubx_framed(1, 0x3C, &payload)
}

#[test]
fn ublox_tells_the_heading_between_its_antennas() {
    let sentence =
        (framed("GNGGA,150405.00,3842.2,N,00911.0,W,4,17,0.6,43.0,M,50.0,M,,") + "\r\n").into_bytes();
    for format in [CompassFormat::Ubx, CompassFormat::Nmea] {
        // Fix, relative position and heading valid, with float or fixed ambiguities.
        for flags in [0x117, 0x10D | 0x200] {
            let bytes = [sentence.clone(), relative(1, 20_175_000, flags), sentence.clone()].concat();
            let (out, counts) = all(format, &bytes);
            assert!(
                (out[0].heading_deg.expect("reported") - 201.75).abs() < 1e-9 && out[0].heading_is_true,
                "{counts}"
            );
            assert_eq!((out.len(), out[0].pitch_deg, counts.refused_total()), (1, None, 0), "{counts}");
        }
        // Without any one of the flags the reading is not used.
        for missing in [0x001, 0x004, 0x010, 0x100] {
            let (out, counts) = all(format, &relative(1, 20_175_000, 0x115 & !missing));
            assert_eq!(
                (out[0].heading_deg, out[0].is_valid(), counts.flagged),
                (None, false, 1),
                "{missing:x}"
            );
        }
        assert_eq!(all(format, &relative(1, 40_000_000, 0x117)).1.refused(Refusal::OutOfRange), 1);
        // The eighth generation's packet is shorter and has no heading.
        assert_eq!(all(format, &ubx_framed(1, 0x3C, &[0; 40])).1.ignored, 1);
    }
    let (out, counts) = all(CompassFormat::Ubx, &(framed("GNHDT,10.0,T") + "\r\n").into_bytes());
    assert!(out.is_empty() && counts.noise_bytes > 0, "{counts}");
}

#[test]
fn headings_of_sentences_beside_packets_are_read() {
    let hpr = (framed("GNHPR,040400.00,201.75,+1.20,000.00,4,33,1.00,0004") + "\r\n").into_bytes();
    let noise = ubx_framed(2, 0x15, &[b'$'; 300]);
    let bytes: Vec<u8> = (0..5).flat_map(|_| [noise.clone(), hpr.clone()].concat()).collect();
    let (out, counts) = all(CompassFormat::Nmea, &bytes);
    assert_eq!((out.len(), counts.refused_total(), counts.ignored), (5, 0, 5), "{counts}");
}
