//! GPS bytes to epochs: every epoch has one UTC time only, and is output as soon as possible.

use super::assembler::Assembler;
use super::counts::DecodeCounts;
use super::lines::{LineFramer, LineStart};
use super::sentence::Checksums;
use super::ubx::{Piece, Splitter};
use windhover_base::msg::GnssEpoch;
use windhover_base::settings::GpsFormat;
use windhover_base::time::MonoTime;

/// An epoch and the arrival of its burst.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ReceivedEpoch {
    /// The receiver's report of one instant.
    pub epoch: GnssEpoch,
    /// When the read returned that held the first byte of its burst.
    pub t_first_byte: MonoTime,
    /// Bytes of that read from the burst's first byte to the end of the read. The first byte began no later than
    /// `t_first_byte` minus the transmission time of these.
    pub bytes_before_end: usize,
    /// When the read returned that held the last byte of its last sentence.
    pub t_last_byte: MonoTime,
    /// Whether it came in its own burst, so that its arrival determines the time of its validity. This is not so for
    /// the GLL of some receivers, which is of another instant within the burst.
    pub opens_burst: bool,
}

/// Combines the bytes of a GPS receiver to epochs.
///
/// Sentences without a time (GSA, VTG, PGRME, PGRMV) go to the epoch of their burst. An epoch is output with the last
/// sentence of the receiver's cycle once that is known, else when the next epoch begins, or by [`GnssDecoder::tick`]
/// after silence.
///
/// ```
/// use windhover_base::msg::FixKind;
/// use windhover_base::time::MonoTime;
/// use windhover_decode::{GnssDecoder, framed};
///
/// let burst = ["GPRMC,101112,A,3030.0,N,08530.0,W,10.0,90.0,010226,,,A", "GPGGA,101112,3030.0,N,08530.0,W,1,08,1.1,100.0,M,-27.0,M,,"];
/// let (mut decoder, mut epochs) = (GnssDecoder::patient(), Vec::new());
/// for body in burst {
///     decoder.push((framed(body) + "\r\n").as_bytes(), MonoTime::from_ns(1_000_000_000), &mut epochs);
/// }
/// decoder.flush(&mut epochs);
/// // Both sentences are of one time, so they are one epoch.
/// let epoch = epochs[0].epoch;
/// assert_eq!((epochs.len(), epoch.fix, epoch.alt_msl_m), (1, FixKind::ThreeD, Some(100.0)));
/// assert_eq!(epoch.utc.map(|utc| utc.to_string()), Some("2026-02-01T10:11:12.000Z".into()));
/// ```
#[derive(Clone, Debug)]
pub struct GnssDecoder {
    format: GpsFormat,
    splitter: Splitter,
    framer: LineFramer,
    counts: DecodeCounts,
    assembler: Assembler,
}

impl Default for GnssDecoder {
    fn default() -> Self {
        Self::new()
    }
}

impl GnssDecoder {
    /// A decoder that outputs each epoch as early as possible.
    pub fn new() -> Self {
        Self::with_patience(false)
    }

    /// A decoder for recordings without arrival times, which outputs each epoch only when the next one begins and so
    /// misses no sentence of it.
    pub fn patient() -> Self {
        Self::with_patience(true)
    }

    fn with_patience(patient: bool) -> Self {
        Self {
            format: GpsFormat::Auto,
            splitter: Splitter::default(),
            framer: LineFramer::new(LineStart::Dollar),
            counts: DecodeCounts::default(),
            assembler: Assembler::new(patient),
        }
    }

    /// The same for a receiver of this format; the default is both.
    #[must_use]
    pub const fn of_format(mut self, format: GpsFormat) -> Self {
        self.format = format;
        self
    }

    /// The same for a receiver whose sentences may come without checksums.
    #[must_use]
    pub const fn checksums_required(mut self, required: bool) -> Self {
        self.assembler.checksums = if required { Checksums::REQUIRED } else { Checksums::OPTIONAL };
        self
    }

    /// Takes the bytes that one read returned at `t_recv`; appends the completed epochs to `out`.
    pub fn push(&mut self, bytes: &[u8], t_recv: MonoTime, out: &mut Vec<ReceivedEpoch>) {
        let Self { format, splitter, framer, counts, assembler } = self;
        let mut piece = |piece: Piece<'_>, counts: &mut DecodeCounts| match piece {
            Piece::Outside(bytes, _) if *format == GpsFormat::Ubx => counts.noise_bytes += bytes.len() as u64,
            Piece::Outside(bytes, after) => framer.push(bytes, after, t_recv, counts, |line, counts| {
                assembler.line(&line, counts, out);
            }),
            Piece::Packet(packet, span) => assembler.packet(packet, span, counts, out),
        };
        match format {
            GpsFormat::Nmea => piece(Piece::Outside(bytes, 0), counts),
            GpsFormat::Auto | GpsFormat::Ubx => splitter.push(bytes, 0, t_recv, counts, &mut piece),
        }
        self.note_dates();
    }

    /// Time has passed: outputs an open epoch after which the receiver has fallen silent.
    pub fn tick(&mut self, now: MonoTime, out: &mut Vec<ReceivedEpoch>) {
        self.assembler.tick(now, out);
        self.note_dates();
    }

    /// The stream has ended: outputs the open epoch.
    pub fn flush(&mut self, out: &mut Vec<ReceivedEpoch>) {
        self.assembler.flush(out);
        self.note_dates();
    }

    fn note_dates(&mut self) {
        for _ in 0..self.assembler.take_refused_dates() {
            self.counts.leave_out("date that can be");
        }
    }

    /// Counts of the decoded bytes.
    pub const fn counts(&self) -> &DecodeCounts {
        &self.counts
    }
}
