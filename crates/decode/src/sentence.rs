//! One NMEA-framed sentence: checksum, address, fields.

use super::counts::Refusal;

/// A sentence with a correct checksum.
///
/// ```
/// use windhover_decode::{Refusal, Sentence, framed};
///
/// let line = framed("PGRMM,WGS 84");
/// assert_eq!(line, "$PGRMM,WGS 84*06");
/// assert_eq!(Sentence::of_line(line.as_bytes()).map(|sentence| sentence.body), Ok("PGRMM,WGS 84"));
/// assert_eq!(Sentence::of_line(b"$PGRMM,WGS 84*07").err(), Some(Refusal::BadChecksum));
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Sentence<'a> {
    /// The text between `$` and `*`.
    pub body: &'a str,
}

/// XOR of the bytes, NMEA's checksum.
pub(super) fn checksum(body: &[u8]) -> u8 {
    body.iter().fold(0, |sum, byte| sum ^ byte)
}

/// The whole sentence on the wire, without its line end.
pub fn framed(body: &str) -> String {
    format!("${body}*{:02X}", checksum(body.as_bytes()))
}

/// Whether a line without a checksum is a sentence: where this is configured, and the device was seen to send none.
#[derive(Clone, Copy, Debug)]
pub(super) struct Checksums {
    required: bool,
}

impl Checksums {
    pub(super) const REQUIRED: Self = Self { required: true };
    pub(super) const OPTIONAL: Self = Self { required: false };

    /// The sentence of a line.
    pub(super) fn sentence<'a>(&mut self, line: &'a [u8]) -> Result<Sentence<'a>, Refusal> {
        if line.contains(&b'*') {
            let sentence = Sentence::of_line(line)?;
            self.required = true;
            Ok(sentence)
        } else if self.required {
            Err(Refusal::NoChecksum)
        } else {
            Sentence::of_bare_line(line)
        }
    }
}

impl<'a> Sentence<'a> {
    /// From a line `$body*HH`, nothing after the checksum.
    ///
    /// # Errors
    /// Where the line is not an ASCII sentence, or its checksum is missing or wrong.
    pub fn of_line(line: &'a [u8]) -> Result<Self, Refusal> {
        let line = std::str::from_utf8(line).map_err(|_| Refusal::NotAscii)?;
        if !line.bytes().all(|byte| (0x20..0x7F).contains(&byte)) {
            return Err(Refusal::NotAscii);
        }
        let inner = line.strip_prefix('$').ok_or(Refusal::Malformed)?;
        let (body, sum) = inner.split_once('*').ok_or(Refusal::NoChecksum)?;
        let sum = sum.trim_end();
        // Some devices write a blank for the leading zero.
        let digits = sum.strip_prefix(' ').unwrap_or(sum);
        if sum.len() != 2 || !digits.bytes().all(|byte| byte.is_ascii_hexdigit()) {
            return Err(Refusal::BadChecksum);
        }
        let sum = u8::from_str_radix(digits, 16).map_err(|_| Refusal::BadChecksum)?;
        if sum != checksum(body.as_bytes()) {
            return Err(Refusal::BadChecksum);
        }
        Ok(Self { body })
    }

    /// From a line `$body` without a checksum.
    fn of_bare_line(line: &'a [u8]) -> Result<Self, Refusal> {
        let line = std::str::from_utf8(line).map_err(|_| Refusal::NotAscii)?;
        if !line.bytes().all(|byte| (0x20..0x7F).contains(&byte)) {
            return Err(Refusal::NotAscii);
        }
        Ok(Self { body: line.strip_prefix('$').ok_or(Refusal::Malformed)?.trim_end() })
    }

    /// The address: talker and sentence, or a proprietary name.
    pub(super) fn address(&self) -> &'a str {
        self.body.split(',').next().unwrap_or_default()
    }

    /// The three letters of a standard sentence, whatever the talker; `None` for proprietary ones.
    pub(super) fn formatter(&self) -> Option<&'a str> {
        let address = self.address();
        (address.len() == 5 && !address.starts_with('P')).then(|| &address[2..])
    }

    /// Field `index`, counted from 1 after the address; empty where absent.
    pub(super) fn field(&self, index: usize) -> &'a str {
        self.body.split(',').nth(index).unwrap_or_default().trim()
    }

    /// Number of fields after the address.
    pub(super) fn fields(&self) -> usize {
        self.body.split(',').count() - 1
    }

    /// A number in field `index`: `None` where empty, an error where not a number in `low..=high`.
    pub(super) fn number(&self, index: usize, low: f64, high: f64) -> Result<Option<f64>, Refusal> {
        number(self.field(index), low, high)
    }
}

/// A plain decimal: sign, digits, point. Not `nan`, `inf` or an exponent, which Rust would accept.
pub(super) fn number(text: &str, low: f64, high: f64) -> Result<Option<f64>, Refusal> {
    if text.is_empty() {
        return Ok(None);
    }
    if !text.bytes().all(|byte| byte.is_ascii_digit() || matches!(byte, b'+' | b'-' | b'.')) {
        return Err(Refusal::Malformed);
    }
    let value: f64 = text.parse().map_err(|_| Refusal::Malformed)?;
    if !(low..=high).contains(&value) {
        return Err(Refusal::OutOfRange);
    }
    Ok(Some(value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sentence_must_hold_its_checksum() {
        let good = Sentence::of_line(b"$PGRMM,WGS 84*06").expect("the checksum is right");
        assert_eq!((good.address(), good.field(1), good.fields()), ("PGRMM", "WGS 84", 1));
        assert_eq!(Sentence::of_line(b"$PGRMM,WGS 84* 6").expect("a blank for the zero").address(), "PGRMM");
        for damaged in [&b"$PGRMM,WGS 84* 7"[..], b"$PGRMM,WGS 84*6", b"$PGRMM,WGS 84*  ", b"$PGRMM,WGS 84*"]
        {
            assert_eq!(Sentence::of_line(damaged).err(), Some(Refusal::BadChecksum));
        }
        assert_eq!(Sentence::of_line(b"$PGRMM,WGS 85*06").err(), Some(Refusal::BadChecksum));
        assert_eq!(Sentence::of_line(b"$PGRMM,WGS 84*06junk").err(), Some(Refusal::BadChecksum));
        assert_eq!(Sentence::of_line(b"$PGRMM,WGS 84").err(), Some(Refusal::NoChecksum));
        assert_eq!(Sentence::of_line(b"$PGR\xffM*06").err(), Some(Refusal::NotAscii));
        assert_eq!(Sentence::of_line(b"").err(), Some(Refusal::Malformed));
    }

    #[test]
    fn numbers_are_plain_decimals_in_range() {
        assert_eq!(number("-0.5", -1.0, 1.0), Ok(Some(-0.5)));
        assert_eq!(number("", -1.0, 1.0), Ok(None));
        assert_eq!(number("NaN", -1.0, 1.0), Err(Refusal::Malformed));
        assert_eq!(number("1e0", -1.0, 1.0), Err(Refusal::Malformed));
        assert_eq!(number("2", -1.0, 1.0), Err(Refusal::OutOfRange));
        assert_eq!(number("1-2", -1.0, 9.0), Err(Refusal::Malformed));
    }
}
