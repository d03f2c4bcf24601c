//! Compass bytes to attitude samples, in every supported format.
//!
//! A format is a file beside this one and a row in [`reader`]; its name in the configuration is a row of
//! [`CompassFormat`].

mod by_gnss;
mod fields;
#[cfg(test)]
mod format_tests;
mod hmr3000;
#[cfg(test)]
mod inertial_tests;
mod long_ascii;
mod nmea;
mod os5000;
mod pashr;
mod pni;
mod reading;
mod records;
mod revolution;
mod rvc;
mod sbg;
mod tagged;
mod tcm2;
#[cfg(test)]
mod tests;
mod assembler;
mod vectornav;
mod witmotion;

pub use reading::{CompassReading, ReceivedAttitude};

use windhover_base::settings::CompassFormat;
use windhover_base::time::MonoTime;

use crate::counts::{DecodeCounts, Refusal};
use crate::lines::{LineFramer, LineStart};
use crate::sentence::{Checksums, Sentence};
use crate::ubx::{Piece, Splitter, relative_heading};
use assembler::ReadingAssembler;
use records::{RecordForm, RecordFramer};

/// Reads a sentence with a valid checksum; counts the fields that it leaves out.
type ReadSentence = fn(&Sentence<'_>, &mut DecodeCounts) -> Result<Option<CompassReading>, Refusal>;
/// Reads a line without `$`.
type ReadLine = fn(&[u8]) -> Result<Option<CompassReading>, Refusal>;

/// How a format is read.
#[derive(Clone, Copy, Debug)]
enum Reader {
    /// Sentences `$…*HH`.
    Sentences(ReadSentence),
    /// A receiver's reports of the line between its antennas: sentences, long messages `#…*CRC` and packets of u-blox.
    /// Without text: packets alone.
    Receiver { sentence: ReadSentence, has_text: bool },
    /// Sentences, and bare lines without checksum of a device that never sends one.
    SentencesOrBare(ReadSentence, ReadLine),
    /// Binary packets of PNI.
    Packets,
    /// Binary records of a fixed length.
    Records(RecordForm),
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
        CompassFormat::Nmea => Reader::Receiver { sentence: nmea::read, has_text: true },
        CompassFormat::Ubx => Reader::Receiver { sentence: nmea::read, has_text: false },
        CompassFormat::Witmotion => Reader::Records(witmotion::FORM),
        CompassFormat::Bno08xRvc => Reader::Records(rvc::FORM),
    }
}

/// Reads a digital compass.
///
/// ```
/// use windhover_base::settings::CompassFormat;
/// use windhover_base::time::MonoTime;
/// use windhover_decode::{CompassDecoder, framed};
///
/// // Heading and tilt in sentences of their own: one reading.
/// let (mut decoder, mut readings) = (CompassDecoder::new(CompassFormat::Nmea), Vec::new());
/// for body in ["HCHDM,100.5,M", "HCXDR,A,1.5,D,PITCH,A,-2.5,D,ROLL"] {
///     decoder.push((framed(body) + "\r\n").as_bytes(), MonoTime::from_ns(1_000_000_000), &mut readings);
/// }
/// decoder.flush(&mut readings);
/// let reading = readings[0].reading;
/// assert_eq!((reading.heading_deg, reading.pitch_deg, reading.roll_deg), (Some(100.5), Some(1.5), Some(-2.5)));
/// ```
#[derive(Clone, Debug)]
pub struct CompassDecoder {
    counts: DecodeCounts,
    input: Input,
}

/// Collects bytes into the units of a format.
#[derive(Clone, Debug)]
enum Input {
    Text(Box<TextInput>),
    Receiver(Box<ReceiverInput>),
    Packets(pni::PacketFramer),
    Records(RecordFramer),
}

impl Input {
    /// The part that combines sentences, where the format has them.
    fn assembler(&mut self) -> Option<&mut ReadingAssembler> {
        match self {
            Self::Text(text) => Some(&mut text.assembler),
            Self::Receiver(receiver) => Some(&mut receiver.text.assembler),
            Self::Packets(_) | Self::Records(_) => None,
        }
    }
}

#[derive(Clone, Debug)]
struct TextInput {
    lines: LineFramer,
    sentence: ReadSentence,
    bare: Option<ReadLine>,
    checksums: Checksums,
    /// Whether the device was seen to send checksums: then a bare line is damaged.
    has_checksums: bool,
    assembler: ReadingAssembler,
}

/// A receiver's line: packets of u-blox, and the bytes between them.
#[derive(Clone, Debug)]
struct ReceiverInput {
    splitter: Splitter,
    text: TextInput,
    /// Whether the bytes between packets are read.
    has_text: bool,
}

impl ReceiverInput {
    fn push(
        &mut self,
        bytes: &[u8],
        t_recv: MonoTime,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedAttitude>,
    ) {
        let Self { splitter, text, has_text } = self;
        splitter.push(bytes, 0, t_recv, counts, &mut |piece, counts| match piece {
            Piece::Outside(bytes, after) if *has_text => text.push(bytes, after, t_recv, counts, out),
            Piece::Outside(bytes, _) => counts.noise_bytes += bytes.len() as u64,
            Piece::Packet(packet, span) => match relative_heading(packet) {
                Ok(Some(heading_deg)) => {
                    let flagged = heading_deg.is_none();
                    let reading = CompassReading {
                        heading_deg,
                        heading_is_true: true,
                        flagged,
                        ..CompassReading::default()
                    };
                    text.assembler.whole(reading, span, counts, out);
                }
                Ok(None) => counts.ignored += 1,
                Err(why) => counts.refuse(why),
            },
        });
    }
}

impl TextInput {
    fn new(start: LineStart, sentence: ReadSentence, bare: Option<ReadLine>) -> Self {
        Self {
            lines: LineFramer::new(start),
            sentence,
            bare,
            checksums: Checksums::REQUIRED,
            has_checksums: false,
            assembler: ReadingAssembler::default(),
        }
    }

    fn push(
        &mut self,
        bytes: &[u8],
        after: usize,
        t_recv: MonoTime,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedAttitude>,
    ) {
        let Self { lines, sentence: read, bare, checksums, has_checksums, assembler } = self;
        lines.push(bytes, after, t_recv, counts, |line, counts| {
            if line.text.starts_with(b"#") && bare.is_none() {
                return match long_ascii::read(line.text) {
                    Ok(Some(reading)) => assembler.whole(reading, line.span, counts, out),
                    Ok(None) => counts.ignored += 1,
                    Err(why) => counts.refuse(why),
                };
            }
            *has_checksums |= line.text.contains(&b'*');
            if let Some(bare) = bare.filter(|_| !line.text.starts_with(b"$")) {
                if *has_checksums && !line.text.contains(&b'*') {
                    return counts.refuse(Refusal::NoChecksum);
                }
                return match bare(line.text) {
                    Ok(Some(reading)) => assembler.whole(reading, line.span, counts, out),
                    Ok(None) => counts.ignored += 1,
                    Err(why) => counts.refuse(why),
                };
            }
            let sentence = match checksums.sentence(line.text) {
                Ok(sentence) => sentence,
                Err(why) => return counts.refuse(why),
            };
            match read(&sentence, counts) {
                Ok(Some(reading)) if reading.is_inertial_only() => {
                    assembler.beside(reading, line.span, counts, out);
                }
                Ok(Some(reading)) if is_part(&sentence) => {
                    assembler.part(reading, &sentence, line.span, counts, out);
                }
                Ok(Some(reading)) => assembler.whole(reading, line.span, counts, out),
                Ok(None) => counts.ignored += 1,
                Err(why) => counts.refuse(why),
            }
        });
    }
}

/// Whether a sentence is plain NMEA, which has an attitude in parts; others are a device's own.
fn is_part(sentence: &Sentence<'_>) -> bool {
    let plain = !sentence.address().starts_with("VN") && sentence.formatter().is_some();
    plain || sbg::is_part(sentence)
}

impl CompassDecoder {
    /// A decoder for one format.
    pub fn new(format: CompassFormat) -> Self {
        let text = |start, read, bare| Input::Text(Box::new(TextInput::new(start, read, bare)));
        let input = match reader(format) {
            Reader::Sentences(read) => text(LineStart::Dollar, read, None),
            Reader::Receiver { sentence, has_text } => {
                let text = TextInput::new(LineStart::DollarOrHash, sentence, None);
                Input::Receiver(Box::new(ReceiverInput { splitter: Splitter::default(), text, has_text }))
            }
            Reader::SentencesOrBare(read, bare) => text(LineStart::Any, read, Some(bare)),
            Reader::Packets => Input::Packets(pni::PacketFramer::default()),
            Reader::Records(form) => Input::Records(RecordFramer::new(form)),
        };
        Self { counts: DecodeCounts::default(), input }
    }

    /// The same for a device whose sentences may come without checksums.
    #[must_use]
    pub fn checksums_required(mut self, required: bool) -> Self {
        let text = match &mut self.input {
            Input::Text(text) => &mut **text,
            Input::Receiver(receiver) => &mut receiver.text,
            Input::Packets(_) | Input::Records(_) => return self,
        };
        text.checksums = if required { Checksums::REQUIRED } else { Checksums::OPTIONAL };
        self
    }

    /// Takes the bytes that one read returned at `t_recv`; appends the completed samples to `out`.
    pub fn push(&mut self, bytes: &[u8], t_recv: MonoTime, out: &mut Vec<ReceivedAttitude>) {
        match &mut self.input {
            Input::Text(text) => text.push(bytes, 0, t_recv, &mut self.counts, out),
            Input::Receiver(receiver) => receiver.push(bytes, t_recv, &mut self.counts, out),
            Input::Records(records) => records.push(bytes, t_recv, &mut self.counts, out),
            Input::Packets(packets) => packets.push(bytes, t_recv, &mut self.counts, out),
        }
    }

    /// Time has passed: outputs an open reading after which the device has fallen silent.
    pub fn tick(&mut self, now: MonoTime, out: &mut Vec<ReceivedAttitude>) {
        if let Some(assembler) = self.input.assembler() {
            assembler.tick(now, &mut self.counts, out);
        }
    }

    /// The stream has ended: outputs the open reading.
    pub fn flush(&mut self, out: &mut Vec<ReceivedAttitude>) {
        if let Some(assembler) = self.input.assembler() {
            assembler.close(&mut self.counts, out);
        }
    }

    /// Counts of the decoded bytes.
    pub const fn counts(&self) -> &DecodeCounts {
        &self.counts
    }
}
