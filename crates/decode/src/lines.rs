//! Lines from a serial stream with arbitrary bytes; bounded, and in step again after any damage.

use super::counts::{DecodeCounts, Refusal};
use windhover_base::time::MonoTime;

/// Longest line. NMEA allows 82 characters, real receivers send up to 120.
const LINE_MAX: usize = 200;
/// Longest line that begins with `#`: NovAtel's long messages, of which the supported ones have up to 250 characters.
const LONG_MAX: usize = 320;

/// A complete line and its place in time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Line<'a> {
    /// The line from its first byte, without CR and LF.
    pub text: &'a [u8],
    /// When the line began and ended.
    pub span: LineSpan,
}

/// Place of a line in time: reads are stamped, bytes are not.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(super) struct LineSpan {
    /// When the read returned that held the first byte.
    pub t_first: MonoTime,
    /// Bytes of that read from the line's first byte to the read's end.
    pub first_read_bytes: usize,
    /// When the read returned that completed the line.
    pub t_last: MonoTime,
    /// Bytes of that read after the line.
    pub bytes_after: usize,
    /// Length on the wire, including the line's end.
    pub bytes: usize,
}

/// The start of a line.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum LineStart {
    /// `$`; bytes before it are noise, and a `$` inside a line begins a new one.
    Dollar,
    /// The same, or `#` directly after another line (NovAtel's and Unicore's long messages).
    DollarOrHash,
    /// Any byte after the end of the previous line.
    Any,
}

/// Collects bytes into lines.
#[derive(Clone, Debug)]
pub(super) struct LineFramer {
    start: LineStart,
    buffer: Vec<u8>,
    span: LineSpan,
    state: State,
}

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum State {
    /// Outside a line.
    Between,
    /// Inside a line.
    Inside,
    /// Inside a line that is too long: skipping to its end.
    Skipping,
}

impl LineFramer {
    pub(super) fn new(start: LineStart) -> Self {
        Self { start, buffer: Vec::with_capacity(LINE_MAX), span: LineSpan::default(), state: State::Between }
    }

    /// Takes the bytes of one read, after which `after` more bytes follow that are not text, and passes every completed
    /// line to `sink`.
    pub(super) fn push(
        &mut self,
        bytes: &[u8],
        after: usize,
        t_recv: MonoTime,
        counts: &mut DecodeCounts,
        mut sink: impl FnMut(Line<'_>, &mut DecodeCounts),
    ) {
        for (index, &byte) in bytes.iter().enumerate() {
            let left = bytes.len() - index + after;
            match byte {
                b'\r' | b'\n' => {
                    if self.state == State::Inside {
                        self.span.t_last = t_recv;
                        self.span.bytes_after = left - 1;
                        self.span.bytes = self.buffer.len() + 1;
                        sink(Line { text: &self.buffer, span: self.span }, counts);
                    }
                    self.state = State::Between;
                    self.buffer.clear();
                }
                b'$' => {
                    if self.state == State::Inside
                        && (self.start != LineStart::Any || !self.buffer.is_empty())
                    {
                        counts.refuse(Refusal::CutShort);
                    }
                    self.begin(byte, t_recv, left);
                }
                _ => self.take(byte, t_recv, left, counts),
            }
        }
    }

    fn begin(&mut self, byte: u8, t_recv: MonoTime, left: usize) {
        self.buffer.clear();
        self.buffer.push(byte);
        self.span = LineSpan { t_first: t_recv, first_read_bytes: left, ..LineSpan::default() };
        self.state = State::Inside;
    }

    fn longest(&self) -> usize {
        if self.buffer.first() == Some(&b'#') { LONG_MAX } else { LINE_MAX }
    }

    fn take(&mut self, byte: u8, t_recv: MonoTime, left: usize, counts: &mut DecodeCounts) {
        match self.state {
            State::Between if self.start == LineStart::Any => self.begin(byte, t_recv, left),
            State::Between if byte == b'#' && self.start == LineStart::DollarOrHash => {
                self.begin(byte, t_recv, left);
            }
            State::Between | State::Skipping => counts.noise_bytes += 1,
            State::Inside if self.buffer.len() >= self.longest() => {
                counts.refuse(Refusal::TooLong);
                self.state = State::Skipping;
                self.buffer.clear();
            }
            State::Inside => self.buffer.push(byte),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(start: LineStart, reads: &[&[u8]]) -> (Vec<String>, DecodeCounts) {
        let (mut framer, mut counts, mut out) = (LineFramer::new(start), DecodeCounts::default(), Vec::new());
        for (index, read) in reads.iter().enumerate() {
            framer.push(read, 0, MonoTime::from_ns(index as i64), &mut counts, |line, _| {
                out.push(String::from_utf8_lossy(line.text).into_owned());
            });
        }
        (out, counts)
    }

    #[test]
    fn a_dollar_inside_a_line_starts_again() {
        let (out, counts) =
            lines(LineStart::Dollar, &[b"xx\r\n$GPGSV,4,2$PTN", b"TA,1*00\r\n,15\r\n$A*0", b"0\n"]);
        assert_eq!(out, ["$PTNTA,1*00", "$A*00"]);
        assert_eq!(counts.refused(Refusal::CutShort), 1);
        assert_eq!(counts.noise_bytes, 5, "xx and the rest of the damaged line");
    }

    #[test]
    fn endless_lines_stay_bounded() {
        let flood = vec![b'A'; 100_000];
        let mut read = b"$".to_vec();
        read.extend_from_slice(&flood);
        let (out, counts) = lines(LineStart::Dollar, &[&read, b"\r\n$B*00\r\n"]);
        assert_eq!(out, ["$B*00"]);
        assert_eq!(counts.refused(Refusal::TooLong), 1);
    }

    #[test]
    fn spans_tell_reads_and_bytes() {
        let (mut framer, mut counts, mut spans) =
            (LineFramer::new(LineStart::Dollar), DecodeCounts::default(), Vec::new());
        framer.push(b"..$GP", 0, MonoTime::from_ns(7), &mut counts, |_, _| {});
        framer.push(b"A\r\n$", 0, MonoTime::from_ns(9), &mut counts, |line, _| spans.push(line.span));
        let expected = LineSpan {
            t_first: MonoTime::from_ns(7),
            first_read_bytes: 3,
            t_last: MonoTime::from_ns(9),
            bytes_after: 2,
            bytes: 5,
        };
        assert_eq!(spans, [expected]);
    }

    #[test]
    fn bare_lines_are_lines_where_the_format_has_no_dollar() {
        let (out, _) = lines(LineStart::Any, &[b"1,2", b",3\r\n4,5,6\r\n"]);
        assert_eq!(out, ["1,2,3", "4,5,6"]);
    }
}
