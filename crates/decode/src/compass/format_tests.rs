//! What each format's sentences say.

use super::*;
use crate::sentence::framed;

fn said(format: CompassFormat, body: &str) -> Result<Option<CompassReading>, Refusal> {
    let framed = framed(body);
    let sentence = Sentence::of_line(framed.as_bytes())?;
    match reader(format) {
        Reader::Sentences(read) | Reader::SentencesOrBare(read, _) => read(&sentence),
        Reader::Packets => panic!("packets are no sentences"),
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

fn readings(format: CompassFormat, bytes: &[u8]) -> (Vec<HeardAttitude>, DecodeCounts) {
    let (mut decoder, mut out) = (CompassDecoder::new(format), Vec::new());
    decoder.push(bytes, MonoTime::from_ns(5), &mut out);
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
