//! Compass sentences in text: TCM2, OS5000, HMR3000, Revolution, PASHR and plain NMEA headings.
//!
//! Sources: the vendors' manuals. A device's error flags take away what they call invalid.

use super::compass::CompassReading;
use super::counts::Refusal;
use super::sentence::{Sentence, number};
use windhover_base::settings::CompassFormat;

/// Whether devices of this format may be set to send lines without a checksum.
pub(super) fn may_lack_checksum(format: CompassFormat) -> bool {
    format == CompassFormat::Os5000
}

/// What a line says; `None` where it is sound and says nothing of attitude.
pub(super) fn read(format: CompassFormat, line: &[u8]) -> Result<Option<CompassReading>, Refusal> {
    if !line.starts_with(b"$") {
        return bare(line);
    }
    let sentence = Sentence::of_line(line)?;
    let address = sentence.address();
    match format {
        CompassFormat::Tcm2 if is_tagged(address) => tagged(sentence.body),
        CompassFormat::Os5000 if is_tagged(address) => tagged(sentence.body),
        CompassFormat::Os5000 if address == "OHPR" => heading_pitch_roll(&sentence).map(Some),
        CompassFormat::Hmr3000 if address == "PTNTHPR" => hmr3000(&sentence).map(Some),
        CompassFormat::Revolution if address == "PTNTHTM" => revolution(&sentence).map(Some),
        // The Revolution's XDR carries raw counts, and only what PTNTHTM has as well.
        CompassFormat::Revolution if address.ends_with("XDR") => Ok(None),
        CompassFormat::Pashr if address == "PASHR" => pashr(&sentence),
        CompassFormat::Pashr | CompassFormat::Pni => Ok(None),
        CompassFormat::Tcm2
        | CompassFormat::Os5000
        | CompassFormat::Hmr3000
        | CompassFormat::Revolution
        | CompassFormat::Nmea => nmea_heading(&sentence),
    }
}

fn heading(text: &str) -> Result<Option<f64>, Refusal> {
    number(text, 0.0, 360.0)
}

/// Pitch or roll: which of them goes all the way round depends on the device's convention.
fn tilt(text: &str) -> Result<Option<f64>, Refusal> {
    number(text, -180.0, 180.0)
}

/// `C328.3P28.4…`: a `C` that is followed by a figure, or another tag straight away.
fn is_tagged(address: &str) -> bool {
    let mut bytes = address.bytes();
    let first = bytes.next();
    let second = bytes.next();
    matches!(first, Some(b'C' | b'P' | b'R' | b'X' | b'T' | b'E' | b'M'))
        && second.is_some_and(|byte| {
            byte.is_ascii_digit() || matches!(byte, b'-' | b'+' | b'.' | b'x' | b'y' | b'z')
        })
}

/// Inclinometer out of range (TCM2 error word): neither tilt nor the heading made with it is valid.
const TCM2_TILT: u16 = 0x002;
/// Magnetometer out of range.
const TCM2_MAGNETOMETER: u16 = 0x004;
/// Magnetic distortion (TCM2; reserved, so never set, on the 2.5 and 2.6).
const TCM2_DISTORTION: u16 = 0x001;

/// PNI TCM2 and OceanServer: letters, then a figure, for each item; any item may be absent. Items
/// other than heading C, pitch P, roll R and error word E are checked and left.
fn tagged(body: &str) -> Result<Option<CompassReading>, Refusal> {
    let mut reading = CompassReading::default();
    let mut errors = 0u16;
    let mut rest = body;
    while !rest.is_empty() {
        let letters = rest.len() - rest.trim_start_matches(|c: char| c.is_ascii_alphabetic()).len();
        // The error word is hexadecimal and its letters look like tags.
        let (tag, value) = if rest.starts_with('E') {
            ("E", rest.get(1..4).ok_or(Refusal::Malformed)?)
        } else {
            let figures = &rest[letters..];
            let end = figures.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(figures.len());
            (&rest[..letters], &figures[..end])
        };
        if tag.is_empty() || value.is_empty() {
            return Err(Refusal::Malformed);
        }
        match tag {
            "C" => reading.heading_deg = heading(value)?,
            "P" => reading.pitch_deg = tilt(value)?,
            "R" => reading.roll_deg = tilt(value)?,
            "E" => errors = u16::from_str_radix(value, 16).map_err(|_| Refusal::Malformed)?,
            _ => {
                number(value, -1e6, 1e6)?;
            }
        }
        rest = &rest[tag.len() + value.len()..];
    }
    if errors & TCM2_TILT != 0 {
        reading.pitch_deg = None;
        reading.roll_deg = None;
    }
    if errors & (TCM2_TILT | TCM2_MAGNETOMETER | TCM2_DISTORTION) != 0 {
        reading.heading_deg = None;
        reading.flagged = true;
    }
    Ok(Some(reading))
}

/// OceanServer `OHPR,heading,pitch,roll,temperature,…`.
fn heading_pitch_roll(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    if sentence.fields() < 3 {
        return Err(Refusal::Malformed);
    }
    Ok(CompassReading {
        heading_deg: heading(sentence.field(1))?,
        pitch_deg: tilt(sentence.field(2))?,
        roll_deg: tilt(sentence.field(3))?,
        ..CompassReading::default()
    })
}

/// OceanServer format 8: `heading,pitch,roll[,…]`, no frame and no checksum, so every field must be
/// a figure.
fn bare(line: &[u8]) -> Result<Option<CompassReading>, Refusal> {
    let line = std::str::from_utf8(line).map_err(|_| Refusal::NotAscii)?;
    let fields: Vec<&str> = line.split(',').map(str::trim).collect();
    if fields.len() < 3 || fields.iter().any(|field| field.is_empty()) {
        return Err(Refusal::Malformed);
    }
    for field in &fields[3..] {
        number(field, -1e6, 1e6)?;
    }
    Ok(Some(CompassReading {
        heading_deg: heading(fields[0])?,
        pitch_deg: tilt(fields[1])?,
        roll_deg: tilt(fields[2])?,
        ..CompassReading::default()
    }))
}

/// Status letters of Honeywell and True North: N normal, M and O warnings; L, P and all others
/// (C calibration, V voltage) alarms, where the value is not to be used.
fn alarms(letter: &str) -> bool {
    !matches!(letter, "N" | "M" | "O" | "")
}

/// Takes away what alarms call invalid: each angle its own, and any of them the heading, which is
/// made with both angles.
fn honour_alarms(reading: &mut CompassReading, heading: &str, pitch: &str, roll: &str) {
    if alarms(pitch) {
        reading.pitch_deg = None;
    }
    if alarms(roll) {
        reading.roll_deg = None;
    }
    if [heading, pitch, roll].into_iter().any(alarms) {
        reading.heading_deg = None;
        reading.flagged = true;
    }
}

/// Honeywell `PTNTHPR,heading,S,pitch,S,roll,S`.
fn hmr3000(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    if sentence.fields() < 6 {
        return Err(Refusal::Malformed);
    }
    let mut reading = CompassReading {
        heading_deg: heading(sentence.field(1))?,
        pitch_deg: tilt(sentence.field(3))?,
        roll_deg: tilt(sentence.field(5))?,
        ..CompassReading::default()
    };
    honour_alarms(&mut reading, sentence.field(2), sentence.field(4), sentence.field(6));
    Ok(reading)
}

/// True North `PTNTHTM,heading,S,pitch,S,roll,S,dip,field`; angles are counts of a 65536th turn.
fn revolution(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    if sentence.fields() < 6 {
        return Err(Refusal::Malformed);
    }
    let counts = |index, low, high| -> Result<Option<f64>, Refusal> {
        Ok(sentence.number(index, low, high)?.map(|counts| counts * 360.0 / 65_536.0))
    };
    let mut reading = CompassReading {
        heading_deg: counts(1, 0.0, 65_536.0)?,
        pitch_deg: counts(3, -32_768.0, 32_768.0)?,
        roll_deg: counts(5, -32_768.0, 32_768.0)?,
        ..CompassReading::default()
    };
    honour_alarms(&mut reading, sentence.field(2), sentence.field(4), sentence.field(6));
    Ok(reading)
}

/// `PASHR,hhmmss.sss,heading,T,roll,pitch,heave,…,GPS quality,IMU status`: roll comes before pitch.
/// Without GPS (quality 0) the heading has nothing to hold it.
fn pashr(sentence: &Sentence<'_>) -> Result<Option<CompassReading>, Refusal> {
    if !sentence.field(1).bytes().next().is_some_and(|byte| byte.is_ascii_digit()) {
        // PASHR,ATT and its like: another grammar under the same address.
        return Ok(None);
    }
    if sentence.fields() < 5 {
        return Err(Refusal::Malformed);
    }
    let mut reading = CompassReading {
        heading_deg: heading(sentence.field(2))?,
        heading_is_true: sentence.field(3) == "T",
        roll_deg: tilt(sentence.field(4))?,
        pitch_deg: tilt(sentence.field(5))?,
        flagged: false,
    };
    if sentence.field(10) == "0" {
        reading.heading_deg = None;
        reading.flagged = true;
    }
    Ok(Some(reading))
}

/// HDG, HDM, HDT, THS and XDR of any talker.
fn nmea_heading(sentence: &Sentence<'_>) -> Result<Option<CompassReading>, Refusal> {
    let mut reading = CompassReading::default();
    match sentence.formatter() {
        Some("HDG") => {
            // Sensor heading plus deviation is magnetic heading; variation is ours to apply.
            let deviation = signed_east(sentence, 2)?.unwrap_or(0.0);
            reading.heading_deg = heading(sentence.field(1))?.map(|deg| (deg + deviation).rem_euclid(360.0));
        }
        Some("HDM") => reading.heading_deg = heading(sentence.field(1))?,
        Some("HDT") => {
            reading.heading_deg = heading(sentence.field(1))?;
            reading.heading_is_true = true;
        }
        Some("THS") => {
            reading.heading_is_true = true;
            reading.flagged = matches!(sentence.field(2), "V" | "S" | "M");
            reading.heading_deg = heading(sentence.field(1))?.filter(|_| !reading.flagged);
        }
        Some("XDR") => return transducers(sentence),
        _ => return Ok(None),
    }
    reading.flagged |= reading.heading_deg.is_none();
    Ok(Some(reading))
}

/// Degrees and E or W in the next field; east positive.
fn signed_east(sentence: &Sentence<'_>, index: usize) -> Result<Option<f64>, Refusal> {
    let Some(size) = sentence.number(index, 0.0, 180.0)? else {
        return Ok(None);
    };
    match sentence.field(index + 1) {
        "E" => Ok(Some(size)),
        "W" => Ok(Some(-size)),
        _ => Err(Refusal::Malformed),
    }
}

/// XDR: groups of type, value, unit, name; the angles (type A, unit D) named pitch and roll.
fn transducers(sentence: &Sentence<'_>) -> Result<Option<CompassReading>, Refusal> {
    let mut reading = CompassReading::default();
    for group in 0..sentence.fields() / 4 {
        let at = 1 + group * 4;
        if (sentence.field(at), sentence.field(at + 2)) != ("A", "D") {
            continue;
        }
        let name = sentence.field(at + 3).to_ascii_uppercase();
        if name.starts_with("PITCH") || name.starts_with("PTCH") {
            reading.pitch_deg = tilt(sentence.field(at + 1))?;
        } else if name.starts_with("ROLL") {
            reading.roll_deg = tilt(sentence.field(at + 1))?;
        }
    }
    Ok((reading.pitch_deg.is_some() || reading.roll_deg.is_some()).then_some(reading))
}

#[cfg(test)]
mod tests {
    use super::super::sentence::framed;
    use super::*;

    fn said(format: CompassFormat, body: &str) -> Result<Option<CompassReading>, Refusal> {
        read(format, framed(body).as_bytes())
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
}
