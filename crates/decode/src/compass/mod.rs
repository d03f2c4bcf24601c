//! Compass bytes to attitude samples, in every supported format.
//!
//! A format is a file beside this one and a row in [`reader`]; its name in the configuration is a row of
//! [`CompassFormat`].

mod by_gnss;
mod fields;
#[cfg(test)]
mod format_tests;
mod hmr3000;
mod long_ascii;
mod nmea;
mod os5000;
mod pashr;
mod pni;
mod reading;
mod revolution;
mod tagged;
mod tcm2;
#[cfg(test)]
mod tests;
mod together;
mod vectornav;

pub use reading::{CompassReading, HeardAttitude};

use windhover_base::settings::CompassFormat;
use windhover_base::time::MonoTime;

use crate::counts::{DecodeCounts, Refusal};
use crate::lines::{LineFramer, LineStart};
use crate::sentence::Sentence;
use together::Together;

/// What a sentence with a sound checksum says.
type ReadSentence = fn(&Sentence<'_>) -> Result<Option<CompassReading>, Refusal>;
/// What a line without `$` says.
type ReadLine = fn(&[u8]) -> Result<Option<CompassReading>, Refusal>;

/// How a format is read.
#[derive(Clone, Copy, Debug)]
enum Reader {
    /// Sentences `$…*HH`.
    Sentences(ReadSentence),
    /// Sentences, and long messages `#…*CRC`.
    SentencesOrLong(ReadSentence),
    /// Sentences, and lines without frame and checksum of a device that never sends one.
    SentencesOrBare(ReadSentence, ReadLine),
    /// Binary packets of PNI.
    Packets,
}

/// The table of formats.
const fn reader(format: CompassFormat) -> Reader {
    match format {
        CompassFormat::Tcm2 => Reader::Sentences(tcm2::read),
        CompassFormat::Os5000 => Reader::SentencesOrBare(os5000::read, os5000::bare),
        CompassFormat::Hmr3000 => Reader::Sentences(hmr3000::read),
        CompassFormat::Revolution => Reader::Sentences(revolution::read),
        CompassFormat::Pni => Reader::Packets,
        CompassFormat::Pashr => Reader::Sentences(pashr::read),
        CompassFormat::Vectornav => Reader::Sentences(vectornav::read),
        CompassFormat::Nmea => Reader::SentencesOrLong(nmea::read),
    }
}

/// Reads a digital compass.
#[derive(Clone, Debug)]
pub struct CompassDecoder {
    counts: DecodeCounts,
    input: Input,
}

/// Collects bytes into what a format is made of.
#[derive(Clone, Debug)]
enum Input {
    Text(Box<TextInput>),
    Packets(pni::PacketFramer),
}

#[derive(Clone, Debug)]
struct TextInput {
    lines: LineFramer,
    sentence: ReadSentence,
    bare: Option<ReadLine>,
    /// Whether the device was seen to send checksums: then a line without one is damaged.
    has_checksums: bool,
    together: Together,
}

impl TextInput {
    fn new(start: LineStart, sentence: ReadSentence, bare: Option<ReadLine>) -> Self {
        Self {
            lines: LineFramer::new(start),
            sentence,
            bare,
            has_checksums: false,
            together: Together::default(),
        }
    }

    fn push(
        &mut self,
        bytes: &[u8],
        t_recv: MonoTime,
        counts: &mut DecodeCounts,
        out: &mut Vec<HeardAttitude>,
    ) {
        let Self { lines, sentence: read, bare, has_checksums, together } = self;
        lines.push(bytes, 0, t_recv, counts, |line, counts| {
            if line.text.starts_with(b"#") && bare.is_none() {
                return match long_ascii::read(line.text) {
                    Ok(Some(reading)) => together.whole(reading, line.span, counts, out),
                    Ok(None) => counts.ignored += 1,
                    Err(why) => counts.refuse(why),
                };
            }
            if line.text.contains(&b'*') {
                *has_checksums = true;
            } else if *has_checksums || bare.is_none() {
                return counts.refuse(Refusal::NoChecksum);
            }
            if let Some(bare) = bare.filter(|_| !line.text.starts_with(b"$")) {
                return match bare(line.text) {
                    Ok(Some(reading)) => together.whole(reading, line.span, counts, out),
                    Ok(None) => counts.ignored += 1,
                    Err(why) => counts.refuse(why),
                };
            }
            let sentence = match Sentence::of_line(line.text) {
                Ok(sentence) => sentence,
                Err(why) => return counts.refuse(why),
            };
            match read(&sentence) {
                Ok(Some(reading)) if is_part(&sentence) => {
                    together.part(reading, &sentence, line.span, counts, out);
                }
                Ok(Some(reading)) => together.whole(reading, line.span, counts, out),
                Ok(None) => counts.ignored += 1,
                Err(why) => counts.refuse(why),
            }
        });
    }
}

/// Whether a sentence is plain NMEA, which tells an attitude in parts; others are a device's own.
fn is_part(sentence: &Sentence<'_>) -> bool {
    !sentence.address().starts_with("VN") && sentence.formatter().is_some()
}

impl CompassDecoder {
    /// A decoder for one format.
    pub fn new(format: CompassFormat) -> Self {
        let text = |start, read, bare| Input::Text(Box::new(TextInput::new(start, read, bare)));
        let input = match reader(format) {
            Reader::Sentences(read) => text(LineStart::Dollar, read, None),
            Reader::SentencesOrLong(read) => text(LineStart::DollarOrHash, read, None),
            Reader::SentencesOrBare(read, bare) => text(LineStart::Any, read, Some(bare)),
            Reader::Packets => Input::Packets(pni::PacketFramer::default()),
        };
        Self { counts: DecodeCounts::default(), input }
    }

    /// Takes the bytes one read returned at `t_recv`; appends the samples they complete to `out`.
    pub fn push(&mut self, bytes: &[u8], t_recv: MonoTime, out: &mut Vec<HeardAttitude>) {
        match &mut self.input {
            Input::Text(text) => text.push(bytes, t_recv, &mut self.counts, out),
            Input::Packets(packets) => packets.push(bytes, t_recv, &mut self.counts, out),
        }
    }

    /// Time passed: gives out an open reading the device has fallen silent after.
    pub fn tick(&mut self, now: MonoTime, out: &mut Vec<HeardAttitude>) {
        if let Input::Text(text) = &mut self.input {
            text.together.tick(now, &mut self.counts, out);
        }
    }

    /// The stream has ended: gives out what is open.
    pub fn flush(&mut self, out: &mut Vec<HeardAttitude>) {
        if let Input::Text(text) = &mut self.input {
            text.together.close(&mut self.counts, out);
        }
    }

    /// What was made of the bytes so far.
    pub const fn counts(&self) -> &DecodeCounts {
        &self.counts
    }
}
