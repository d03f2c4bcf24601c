//! Reports of a GPS receiver to epochs: which sentence belongs to which, and when an epoch is complete.

use super::burst::{BurstOrder, Cycle};
use super::calendar::Calendar;
use super::counts::{DecodeCounts, Refusal};
use super::epoch::Draft;
use super::gnss::ReceivedEpoch;
use super::lines::{Line, LineSpan};
use super::report::{Kind, Report};
use super::sentence::Checksums;
use super::{garmin, standard, ubx};
use windhover_base::time::{MonoTime, Span};

/// Silence after which an open epoch is output, before the receiver's period is known.
const QUIET_FIRST: Span = Span::from_ns(300_000_000);
/// Bounds of that silence afterwards: half the period.
const QUIET_BOUNDS_NS: (i64, i64) = (60_000_000, 500_000_000);
/// Most sentences that are kept before the time of their burst is known.
const LEADING_MAX: usize = 8;

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

/// Assigns reports to the epochs of their bursts.
#[derive(Clone, Debug)]
pub(super) struct Assembler {
    /// Whether it waits for the start of the next epoch instead of the learnt end of the cycle.
    patient: bool,
    pub(super) checksums: Checksums,
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

impl Assembler {
    /// An assembler that waits for the begin of the next epoch (`patient`), or outputs each epoch as early as possible.
    pub(super) fn new(patient: bool) -> Self {
        Self {
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
        }
    }

    /// A valid or damaged line.
    pub(super) fn line(&mut self, line: &Line<'_>, counts: &mut DecodeCounts, out: &mut Vec<ReceivedEpoch>) {
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
    pub(super) fn packet(
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

    /// Outputs an open epoch after which the receiver has fallen silent.
    pub(super) fn tick(&mut self, now: MonoTime, out: &mut Vec<ReceivedEpoch>) {
        let (low, high) = QUIET_BOUNDS_NS;
        let quiet = self.period.map_or(QUIET_FIRST, |p| Span::from_ns((p.ns() / 2).clamp(low, high)));
        if self.draft.as_ref().is_some_and(|draft| now - draft.end.t_last >= quiet) {
            self.close(out);
        }
    }

    /// The stream has ended: outputs what is open.
    pub(super) fn flush(&mut self, out: &mut Vec<ReceivedEpoch>) {
        self.close(out);
        self.close_aside(None, out);
    }

    /// Number of dates refused since the last call.
    pub(super) fn take_refused_dates(&mut self) -> u64 {
        self.calendar.take_refused()
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
