//! One reading from several sentences of a device.
//!
//! Plain NMEA has heading, pitch and roll in separate sentences, and the heading in up to four forms (HDG, HDM, HDT,
//! THS). The sentences of one burst make one reading. A repeated sentence begins the next reading, and so does the
//! sentence that was seen to follow the longest silence. A device with a sentence for the whole attitude repeats it in
//! the others, which then add nothing.

use super::reading::{CompassReading, ReceivedAttitude, received};
use crate::burst::Cycle;
use crate::counts::DecodeCounts;
use crate::lines::LineSpan;
use crate::sentence::Sentence;
use windhover_base::time::{MonoTime, Span};

/// Silence after which an open reading is output.
const QUIET: Span = Span::from_ns(300_000_000);
/// Most sentences after a whole attitude that only repeat it: more than any burst has.
const AFTER_WHOLE: u32 = 16;
/// Most kinds of sentences that are remembered; no device sends more.
const KEYS_MAX: usize = 16;
/// A mean silence before a burst: at least this long, and this many times that before any other sentence.
const BEGIN: (f64, f64) = (5.0, 2.0);
/// Weight of one silence in the mean.
const SILENCE_SHARE: f64 = 0.2;

/// The sentence of a part, and its angles.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Key {
    address: [u8; 6],
    angles: u8,
}

impl Key {
    fn of(address: &str, reading: &CompassReading) -> Self {
        let mut key = [0; 6];
        key.iter_mut().zip(address.bytes()).for_each(|(to, from)| *to = from);
        let bit = |angle: Option<f64>, bit: u8| if angle.is_some() { bit } else { 0 };
        Self { address: key, angles: bit(reading.pitch_deg, 1) | bit(reading.roll_deg, 2) }
    }
}

/// Which heading is used where there are several: measured ones before derived ones.
fn rank(sentence: &Sentence<'_>) -> u8 {
    match sentence.formatter() {
        Some("HPR") => 0,
        Some("HDG") => 1,
        Some("HDM") => 2,
        Some("HDT") => 3,
        _ => 4,
    }
}

/// A reading in progress.
#[derive(Clone, Debug)]
struct Draft {
    reading: CompassReading,
    heading_rank: u8,
    keys: Vec<Key>,
    first: LineSpan,
    last: LineSpan,
}

/// Combines sentences to readings.
#[derive(Clone, Debug)]
pub(super) struct ReadingAssembler {
    draft: Option<Draft>,
    /// Sentences of the reading that was output last.
    done: Vec<Key>,
    cycle: Cycle<Key>,
    /// Mean silence before each sentence, milliseconds.
    silences: Vec<(Key, f64)>,
    last: Option<LineSpan>,
    since_whole: u32,
}

impl Default for ReadingAssembler {
    fn default() -> Self {
        Self {
            draft: None,
            done: Vec::new(),
            cycle: Cycle::default(),
            silences: Vec::new(),
            last: None,
            since_whole: AFTER_WHOLE,
        }
    }
}

impl ReadingAssembler {
    /// A sentence of the device's own: a complete attitude.
    pub(super) fn whole(
        &mut self,
        reading: CompassReading,
        span: LineSpan,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedAttitude>,
    ) {
        self.draft = None;
        self.since_whole = 0;
        counts.used += 1;
        out.push(received(reading, span, span, counts));
    }

    /// A sentence of rates and forces: a reading of its own beside those of the attitude.
    pub(super) fn beside(
        &self,
        reading: CompassReading,
        span: LineSpan,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedAttitude>,
    ) {
        counts.used += 1;
        out.push(received(reading, span, span, counts));
    }

    /// A sentence of plain NMEA.
    pub(super) fn part(
        &mut self,
        reading: CompassReading,
        sentence: &Sentence<'_>,
        span: LineSpan,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedAttitude>,
    ) {
        if self.since_whole < AFTER_WHOLE {
            self.since_whole += 1;
            counts.ignored += 1;
            return;
        }
        let key = Key::of(sentence.address(), &reading);
        let silence = self.last.map_or(Span::ZERO, |last| span.t_first - last.t_last);
        if self.draft.as_ref().is_some_and(|d| d.keys.contains(&key) || silence >= QUIET) || self.begins(key)
        {
            self.close(counts, out);
        } else if self.draft.is_none() && !self.done.is_empty() && !self.done.contains(&key) {
            self.cycle.was_longer();
        }
        self.note_silence(key, silence);
        self.last = Some(span);
        self.merge(reading, rank(sentence), key, span, counts);
        if self.draft.as_ref().is_some_and(|draft| self.cycle.is_complete(&draft.keys)) {
            self.give_out(counts, out);
        }
    }

    /// Time has passed: outputs an open reading after which the device has fallen silent.
    pub(super) fn tick(&mut self, now: MonoTime, counts: &mut DecodeCounts, out: &mut Vec<ReceivedAttitude>) {
        if self.draft.as_ref().is_some_and(|draft| now - draft.last.t_last >= QUIET) {
            self.close(counts, out);
        }
    }

    /// The open reading ends because another begins, or the stream ends.
    pub(super) fn close(&mut self, counts: &mut DecodeCounts, out: &mut Vec<ReceivedAttitude>) {
        if let Some(draft) = &self.draft {
            self.cycle.ended(&draft.keys);
            self.give_out(counts, out);
        }
        self.done.clear();
    }

    fn give_out(&mut self, counts: &mut DecodeCounts, out: &mut Vec<ReceivedAttitude>) {
        if let Some(mut draft) = self.draft.take() {
            draft.reading.flagged &= draft.reading.heading_deg.is_none();
            out.push(received(draft.reading, draft.first, draft.last, counts));
            self.done = draft.keys;
        }
    }

    fn merge(&mut self, part: CompassReading, rank: u8, key: Key, span: LineSpan, counts: &mut DecodeCounts) {
        let draft = self.draft.get_or_insert_with(|| Draft {
            reading: CompassReading::default(),
            heading_rank: u8::MAX,
            keys: Vec::new(),
            first: span,
            last: span,
        });
        let before = draft.reading;
        let reading = &mut draft.reading;
        reading.pitch_deg = reading.pitch_deg.or(part.pitch_deg);
        reading.roll_deg = reading.roll_deg.or(part.roll_deg);
        reading.flagged |= part.flagged;
        if part.heading_deg.is_some() && rank < draft.heading_rank {
            draft.heading_rank = rank;
            (reading.heading_deg, reading.heading_is_true) = (part.heading_deg, part.heading_is_true);
        } else if part.flagged && reading.heading_deg.is_none() {
            reading.heading_is_true = part.heading_is_true;
        }
        let says_more = *reading != before;
        counts.used += u64::from(says_more);
        counts.ignored += u64::from(!says_more);
        draft.keys.push(key);
        draft.last = span;
    }

    /// Whether this sentence was seen to follow the silence between two readings.
    fn begins(&self, key: Key) -> bool {
        let of = |other: bool| {
            let kind = self.silences.iter().filter(|(known, _)| (*known == key) != other);
            kind.map(|(_, ms)| *ms).fold(0.0, f64::max)
        };
        of(false) >= BEGIN.0 && of(false) >= BEGIN.1 * of(true)
    }

    fn note_silence(&mut self, key: Key, silence: Span) {
        let ms = silence.ms().clamp(0.0, QUIET.ms());
        let room = self.silences.len() < KEYS_MAX;
        match self.silences.iter_mut().find(|(known, _)| *known == key) {
            Some((_, mean)) => *mean += SILENCE_SHARE * (ms - *mean),
            None if room => self.silences.push((key, 0.0)),
            None => {}
        }
    }
}
