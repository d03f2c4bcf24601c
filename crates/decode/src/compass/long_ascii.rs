//! Headings between antennas in the long ASCII messages of NovAtel and Unicore: `#HEADINGA`, `#UNIHEADINGA`.
//!
//! `#NAME,header;status,type,length,heading,pitch,…*CRC`, where the CRC of eight hexadecimal digits covers everything
//! between `#` and `*`: the polynomial of CRC-32, reflected, from 0 and not inverted. The heading is true. The pitch is
//! that of the line between the antennas, a single tilt, and is not used. Sources: the vendors' manuals.

use crc::{Algorithm, Crc};

use super::fields::heading;
use super::reading::CompassReading;
use crate::counts::Refusal;

const ALGORITHM: Algorithm<u32> = Algorithm {
    width: 32,
    poly: 0x04c1_1db7,
    init: 0,
    refin: true,
    refout: true,
    xorout: 0,
    check: 0x2dfd_2d88,
    residue: 0,
};
const CRC: Crc<u32> = Crc::<u32>::new(&ALGORITHM);

/// The reading of such a line; `None` for other messages.
pub(super) fn read(line: &[u8]) -> Result<Option<CompassReading>, Refusal> {
    let line = std::str::from_utf8(line).map_err(|_| Refusal::NotAscii)?;
    let inner = line.strip_prefix('#').ok_or(Refusal::Malformed)?;
    let (body, sum) = inner.rsplit_once('*').ok_or(Refusal::NoChecksum)?;
    let digits = sum.trim_end();
    let sum = u32::from_str_radix(digits, 16).ok().filter(|_| digits.len() == 8);
    if sum != Some(CRC.checksum(body.as_bytes())) {
        return Err(Refusal::BadChecksum);
    }
    let (header, body) = body.split_once(';').ok_or(Refusal::Malformed)?;
    if !matches!(header.split(',').next(), Some("HEADINGA" | "UNIHEADINGA")) {
        return Ok(None);
    }
    let fields: Vec<&str> = body.split(',').collect();
    let [status, kind, _length, text, ..] = fields[..] else { return Err(Refusal::Malformed) };
    let solved = status == "SOL_COMPUTED" && kind != "NONE";
    let heading_deg = heading(text)?.filter(|_| solved);
    let flagged = heading_deg.is_none();
    Ok(Some(CompassReading { heading_deg, heading_is_true: true, flagged, ..CompassReading::default() }))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Messages of a UM982 and two other receivers.
    const REAL: [(&str, f64); 3] = [
        (
            "#UNIHEADINGA,78,GPS,FINE,2428,116060000,0,0,18,11;SOL_COMPUTED,NARROW_INT,1.4773,179.0284,-2.4202,0.0000,\
             0.8259,1.0921,\"999\",27,21,21,15,3,01,3,f3*5d424350",
            179.0284,
        ),
        (
            "#UNIHEADINGA,93,GPS,FINE,2385,326588000,0,0,18,10;SOL_COMPUTED,NARROW_FLOAT,5.5208,219.9783,24.6813,\
             0.0000,16.4390,35.3287,\"999\",21,9,9,5,3,00,3,13*53e4320d",
            219.9783,
        ),
        (
            "#HEADINGA,COM2,0,23.0,FINE,2376,266819.200,112748,24,18;SOL_COMPUTED,NARROW_INT,0.7935,309.5608,\
             -1.6492,0.0000,0.2902,0.7118,\"999\",52,46,46,27,3,00,3,f3*91c43d2c",
            309.5608,
        ),
    ];

    fn framed(body: &str) -> String {
        format!("#{body}*{:08x}", CRC.checksum(body.as_bytes()))
    }

    #[test]
    fn real_lines_are_headings() {
        for (line, heading) in REAL {
            let reading = read(line.as_bytes()).expect("sound").expect("a heading");
            assert_eq!((reading.heading_deg, reading.pitch_deg), (Some(heading), None));
            assert!(reading.heading_is_true && reading.is_valid());
            let damaged = line.replacen(",0.0000,", ",0.0001,", 1);
            assert_eq!(read(damaged.as_bytes()), Err(Refusal::BadChecksum));
        }
    }

    #[test]
    fn without_a_solution_there_is_no_heading() {
        for state in ["INSUFFICIENT_OBS,NONE", "SOL_COMPUTED,NONE"] {
            let line =
                framed(&format!("UNIHEADINGA,1,GPS,FINE,1,1,0,0,18,1;{state},0.0000,0.0000,0.0000,0.0000"));
            let reading = read(line.as_bytes()).expect("sound").expect("a reading");
            assert!(reading.heading_deg.is_none() && reading.flagged, "{state}");
        }
        assert_eq!(read(framed("BESTPOSA,COM1;SOL_COMPUTED,SINGLE").as_bytes()), Ok(None));
        assert_eq!(read(framed("HEADINGA,COM1;SOL_COMPUTED").as_bytes()), Err(Refusal::Malformed));
        assert_eq!(read(b"#HEADINGA,COM1"), Err(Refusal::NoChecksum));
    }
}
