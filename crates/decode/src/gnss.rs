//! GPS bytes to epochs: every epoch has one UTC time only, and is output as soon as possible.

use super::burst::{BurstOrder, Cycle};
use super::calendar::Calendar;
use super::counts::{DecodeCounts, Refusal};
use super::epoch::Draft;
use super::lines::{Line, LineFramer, LineSpan, LineStart};
use super::report::{Kind, Report};
use super::sentence::Checksums;
use super::ubx::{self, Piece, Splitter};
use super::{garmin, standard};
use windhover_base::msg::GnssEpoch;
use windhover_base::settings::GpsFormat;
use windhover_base::time::{MonoTime, Span};

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

/// Silence after which an open epoch is output, before the receiver's period is known.
const QUIET_FIRST: Span = Span::from_ns(300_000_000);
/// Bounds of that silence afterwards: half the period.
const QUIET_BOUNDS_NS: (i64, i64) = (60_000_000, 500_000_000);
/// Most sentences that are kept before the time of their burst is known.
const LEADING_MAX: usize = 8;

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

/// A ZDA of another time than the open epoch: it leads the next burst, or only has the date.
#[derive(Clone, Debug, Default)]
struct DateAhead {
    received: Option<(Report, LineSpan)>,
    /// Whether the last one led its burst.
    leads: bool,
}

/// The memory of an epoch that was output.
#[derive(Clone, Debug)]
struct Done {
    time_of_day_ns: Option<i64>,
    kinds: Vec<Kind>,
    /// When its last sentence arrived.
    t_last: MonoTime,
}

#[derive(Clone, Debug)]
struct Assembler {
    /// Whether it waits for the start of the next epoch instead of the learnt end of the cycle.
    patient: bool,
    checksums: Checksums,
    order: BurstOrder,
    cycle: Cycle<Kind>,
    calendar: Calendar,
    draft: Option<Draft>,
    /// A GLL of another time than its burst.
    aside: Option<Draft>,
    /// Sentences without time that lead the next burst.
    leading: Vec<(Report, LineSpan)>,
    date: DateAhead,
    /// The epoch that was output last.
    done: Option<Done>,
    last_begin: Option<MonoTime>,
    period: Option<Span>,
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
            assembler: Assembler {
                patient,
                checksums: Checksums::REQUIRED,
                order: BurstOrder::default(),
                cycle: Cycle::default(),
                calendar: Calendar::new(!patient),
                draft: None,
                aside: None,
                leading: Vec::new(),
                date: DateAhead::default(),
                done: None,
                last_begin: None,
                period: None,
            },
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
        self.assembler.close(out);
        self.assembler.close_aside(None, out);
        self.note_dates();
    }

    fn note_dates(&mut self) {
        for _ in 0..self.assembler.calendar.take_refused() {
            self.counts.leave_out("date that can be");
        }
    }

    /// Counts of the decoded bytes.
    pub const fn counts(&self) -> &DecodeCounts {
        &self.counts
    }
}

impl Assembler {
    fn line(&mut self, line: &Line<'_>, counts: &mut DecodeCounts, out: &mut Vec<ReceivedEpoch>) {
        let sentence = match self.checksums.sentence(line.text) {
            Ok(sentence) => sentence,
            Err(why) => return counts.refuse(why),
        };
        self.order.received(sentence.address(), line.span);
        let read = if sentence.address().starts_with("PGRM") {
            garmin::read(&sentence)
        } else {
            standard::read(&sentence)
        };
        self.said(read, sentence.address(), line.span, counts, out);
    }

    /// A packet of u-blox.
    fn packet(
        &mut self,
        packet: &[u8],
        span: LineSpan,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedEpoch>,
    ) {
        let address = ubx::address(packet);
        self.order.received(&address, span);
        self.said(ubx::read(packet), &address, span, counts, out);
    }

    fn said(
        &mut self,
        read: Result<Option<Report>, Refusal>,
        address: &str,
        span: LineSpan,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedEpoch>,
    ) {
        let placed = match read {
            Ok(None) => return counts.ignored += 1,
            Err(why) => Err(why),
            Ok(Some(report)) => {
                report.left_out.iter().for_each(|field| counts.leave_out(*field));
                self.place(report, address, span, out)
            }
        };
        match placed {
            Ok(()) => counts.used += 1,
            Err(why) => counts.refuse(why),
        }
    }

    fn place(
        &mut self,
        report: Report,
        address: &str,
        span: LineSpan,
        out: &mut Vec<ReceivedEpoch>,
    ) -> Result<(), Refusal> {
        if report.kind == Kind::Zda {
            self.place_date(report, span, out);
            Ok(())
        } else if report.kind == Kind::Pulse {
            self.place_pulse(&report, span);
            Ok(())
        } else if report.kind == Kind::Gst {
            self.place_errors(report, address, span, out)
        } else if let Some(time) = report.time_of_day_ns {
            self.place_timed(&report, time, span, out)
        } else if report.kind.tells_time() {
            self.place_time_missing(&report, span, out)
        } else if self.order.leads(address) || (self.date.leads && self.date.received.is_some()) {
            self.lead(report, span);
            Ok(())
        } else {
            self.place_untimed(&report, span, out)
        }
    }

    /// TIM-TP has a date, for the next pulse; it belongs to no epoch.
    fn place_pulse(&mut self, report: &Report, span: LineSpan) {
        if let Some((time, date)) = report.time_of_day_ns.zip(report.date) {
            self.calendar.reported(time, date, self.draft.as_ref().map(Draft::has_fix), span.t_first);
        }
    }

    /// A GST belongs to the open epoch, led its burst or came too late; it never opens an epoch.
    fn place_errors(
        &mut self,
        report: Report,
        address: &str,
        span: LineSpan,
        out: &mut Vec<ReceivedEpoch>,
    ) -> Result<(), Refusal> {
        let time = report.time_of_day_ns;
        if self.is_open(time) {
            self.order.same_burst();
            self.merge(&report, span, out);
            return Ok(());
        }
        if time.is_some_and(|time| self.is_done(time)) {
            self.order.same_burst();
            self.cycle.was_longer();
            return Err(Refusal::AfterItsEpoch);
        }
        if time.is_none() || !self.order.leads(address) {
            return Err(Refusal::NoTime);
        }
        self.lead(report, span);
        Ok(())
    }

    fn lead(&mut self, report: Report, span: LineSpan) {
        self.leading.retain(|(other, _)| other.kind != report.kind);
        if self.leading.len() < LEADING_MAX {
            self.leading.push((report, span));
        }
    }

    fn is_open(&self, time: Option<i64>) -> bool {
        time.is_some() && self.draft.as_ref().is_some_and(|draft| draft.time_of_day_ns == time)
    }

    /// A ZDA has a date and never opens an epoch: in some receivers it is of another second.
    fn place_date(&mut self, report: Report, span: LineSpan, out: &mut Vec<ReceivedEpoch>) {
        let Some(time) = report.time_of_day_ns else { return };
        if self.is_open(Some(time)) {
            self.order.same_burst();
            return self.merge(&report, span, out);
        }
        if let Some(date) = report.date {
            let has_fix = self.draft.as_ref().map(Draft::has_fix);
            self.calendar.reported(time, date, has_fix, span.t_first);
        }
        if self.is_done(time) {
            self.order.same_burst();
            return self.cycle.was_longer();
        }
        if self.date.leads {
            self.close(out);
        }
        self.date.received = Some((report, span));
    }

    /// The ZDA that led the burst of this time, if there was one.
    fn date_of_burst(&mut self, time: i64) -> Option<(Report, LineSpan)> {
        let (report, span) = self.date.received.take()?;
        self.date.leads = report.time_of_day_ns == Some(time) && self.order.is_of_this_burst(span);
        self.date.leads.then_some((report, span))
    }

    /// A sentence with its time.
    fn place_timed(
        &mut self,
        report: &Report,
        time: i64,
        span: LineSpan,
        out: &mut Vec<ReceivedEpoch>,
    ) -> Result<(), Refusal> {
        let open = self.draft.as_ref();
        if !self.repeats_after_silence(report.kind, span) {
            if open.is_some_and(|draft| draft.time_of_day_ns == Some(time) || draft.awaits(report.kind)) {
                self.order.same_burst();
                self.merge(report, span, out);
                return Ok(());
            }
            if self.is_done(time) {
                self.order.same_burst();
                self.cycle.was_longer();
                return Err(Refusal::AfterItsEpoch);
            }
        }
        let main_before = open.is_some_and(Draft::has_main) || self.done_has_main();
        if report.kind == Kind::Gll && main_before {
            self.close_aside(None, out);
            let mut aside = Draft::new(span, false);
            aside.merge(report, span);
            self.aside = Some(aside);
            return Ok(());
        }
        self.close(out);
        self.open(time, out);
        self.merge(report, span, out);
        Ok(())
    }

    /// A sentence whose field for the time is empty: the receiver does not know it yet.
    fn place_time_missing(
        &mut self,
        report: &Report,
        span: LineSpan,
        out: &mut Vec<ReceivedEpoch>,
    ) -> Result<(), Refusal> {
        match (&self.draft, &self.done) {
            (Some(draft), _) if !draft.kinds.contains(&report.kind) => {}
            (None, Some(done)) if !done.kinds.contains(&report.kind) => {
                self.cycle.was_longer();
                return Err(Refusal::AfterItsEpoch);
            }
            _ => {
                self.close(out);
                self.close_aside(None, out);
                let begin = self.order.new_burst(None);
                self.draft = Some(Draft::new(begin, true));
            }
        }
        self.merge(report, span, out);
        Ok(())
    }

    /// A sentence that has no time by its nature.
    fn place_untimed(
        &mut self,
        report: &Report,
        span: LineSpan,
        out: &mut Vec<ReceivedEpoch>,
    ) -> Result<(), Refusal> {
        if let Some(draft) = &self.draft {
            let one_of_several = report.kind == Kind::Gsa && draft.kinds.last() == Some(&Kind::Gsa);
            if draft.kinds.contains(&report.kind) && !one_of_several {
                // The sentences with the time of this burst were lost.
                self.close(out);
                self.done = None;
                return Err(Refusal::NoTime);
            }
            self.merge(report, span, out);
            return Ok(());
        }
        match self.done.take() {
            Some(done) if done.kinds.contains(&report.kind) => Err(Refusal::NoTime),
            Some(done) => {
                self.done = Some(done);
                self.cycle.was_longer();
                Err(Refusal::AfterItsEpoch)
            }
            None => Err(Refusal::NoTime),
        }
    }

    fn merge(&mut self, report: &Report, span: LineSpan, out: &mut Vec<ReceivedEpoch>) {
        let Some(draft) = &mut self.draft else {
            return;
        };
        draft.merge(report, span);
        if !self.patient && self.cycle.is_complete(&draft.kinds) {
            self.give_out(out);
        }
    }

    /// Opens the epoch of a new time, with the GLL before it and the sentences that led its burst.
    fn open(&mut self, time: i64, out: &mut Vec<ReceivedEpoch>) {
        self.close_aside(Some(time), out);
        let date = self.date_of_burst(time);
        let begin = self.order.new_burst(date.as_ref().map(|(_, span)| *span));
        if let Some(last) = self.last_begin.replace(begin.t_first) {
            let period = begin.t_first - last;
            let smoothed = |known: Span| Span::from_ns(known.ns() + (period.ns() - known.ns()) / 8);
            self.period = Some(self.period.map_or(period, smoothed));
        }
        let mut draft = Draft::new(begin, true);
        if let Some(aside) = self.aside.take() {
            draft = aside;
            draft.begin = begin;
            draft.opens_burst = true;
        }
        for (report, span) in date.into_iter().chain(self.leading.drain(..)) {
            if report.time_of_day_ns.is_none_or(|of| of == time) {
                draft.merge(&report, span);
            }
        }
        self.draft = Some(draft);
    }

    /// The open epoch ends because another begins.
    fn close(&mut self, out: &mut Vec<ReceivedEpoch>) {
        if let Some(draft) = &self.draft {
            self.cycle.ended(&draft.kinds);
            self.give_out(out);
        }
    }

    /// Outputs the GLL that was kept apart, unless it has the time of the new epoch.
    fn close_aside(&mut self, time: Option<i64>, out: &mut Vec<ReceivedEpoch>) {
        if let Some(aside) = self.aside.take_if(|aside| time.is_none() || aside.time_of_day_ns != time) {
            out.push(received(&aside, &mut self.calendar));
        }
    }

    fn give_out(&mut self, out: &mut Vec<ReceivedEpoch>) {
        if let Some(draft) = self.draft.take() {
            out.push(received(&draft, &mut self.calendar));
            let (time_of_day_ns, t_last) = (draft.time_of_day_ns, draft.end.t_last);
            self.done = Some(Done { time_of_day_ns, kinds: draft.kinds, t_last });
        }
    }

    fn tick(&mut self, now: MonoTime, out: &mut Vec<ReceivedEpoch>) {
        let (low, high) = QUIET_BOUNDS_NS;
        let quiet = self.period.map_or(QUIET_FIRST, |p| Span::from_ns((p.ns() / 2).clamp(low, high)));
        if self.draft.as_ref().is_some_and(|draft| now - draft.end.t_last >= quiet) {
            self.close(out);
        }
    }

    fn done_has_main(&self) -> bool {
        let main = |kind: &Kind| matches!(kind, Kind::Rmc | Kind::Gga | Kind::Gns | Kind::Pvt);
        self.draft.is_none() && self.done.as_ref().is_some_and(|done| done.kinds.iter().any(main))
    }

    /// Whether the epoch of this time was output last.
    fn is_done(&self, time: i64) -> bool {
        self.draft.is_none() && self.done.as_ref().is_some_and(|done| done.time_of_day_ns == Some(time))
    }

    /// Whether a sentence that the last epoch already has comes after a silence: this is a new burst, whatever its
    /// time. A receiver that learns of a leap second repeats a second.
    fn repeats_after_silence(&self, kind: Kind, span: LineSpan) -> bool {
        let last = match (&self.draft, &self.done) {
            (Some(draft), _) => Some((&draft.kinds, draft.end.t_last)),
            (None, Some(done)) => Some((&done.kinds, done.t_last)),
            (None, None) => None,
        };
        last.is_some_and(|(kinds, t_last)| kinds.contains(&kind) && span.t_first - t_last >= QUIET_FIRST)
    }
}

impl Draft {
    /// Whether it has no time yet and a sentence of this kind may give it one.
    fn awaits(&self, kind: Kind) -> bool {
        self.time_of_day_ns.is_none() && !self.kinds.contains(&kind)
    }
}

fn received(draft: &Draft, calendar: &mut Calendar) -> ReceivedEpoch {
    ReceivedEpoch {
        epoch: draft.finish(calendar),
        t_first_byte: draft.begin.t_first,
        bytes_before_end: draft.begin.first_read_bytes,
        t_last_byte: draft.end.t_last,
        opens_burst: draft.opens_burst,
    }
}
