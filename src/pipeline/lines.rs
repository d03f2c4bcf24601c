//! The two serial lines: bytes in, stamped measurements out.

use crate::config::Config;
use windhover_base::msg::{AttitudeSample, GnssEpoch, Stamped, WarmArrival};
use windhover_base::time::{GnssClock, MonoTime, Span, SteadyClock};
use windhover_decode::{CompassDecoder, DecodeCounts, GnssDecoder, HeardAttitude, HeardEpoch};

/// Arrivals kept for a warm start: the jitter of a 5 Hz receiver over 10 s.
const WARM_ARRIVALS: usize = 50;

/// Time on the wire: ten bits a byte (8N1).
fn on_the_wire(bytes: usize, baud: u32) -> Span {
    Span::from_s(bytes as f64 * 10.0 / f64::from(baud.max(1)))
}

/// What was refused so far, and the reasons.
fn refused(counts: &DecodeCounts) -> (u64, String) {
    let reasons: Vec<String> = counts.refusals().map(|(why, n)| format!("{n} {}", why.words())).collect();
    (counts.refused_total(), reasons.join(", "))
}

/// GPS bytes to epochs at their time of validity.
pub(super) struct GpsLine {
    decoder: GnssDecoder,
    heard: Vec<HeardEpoch>,
    clock: GnssClock,
    clock_sigma: Option<Span>,
    baud: u32,
    latency: Span,
}

impl GpsLine {
    pub(super) fn new(config: &Config) -> Self {
        let latency = Span::from_ms(config.gps.latency_ms);
        Self {
            decoder: GnssDecoder::new(),
            heard: Vec::new(),
            clock: GnssClock::new(latency),
            clock_sigma: None,
            baud: config.gps.baud,
            latency,
        }
    }

    pub(super) fn push(
        &mut self,
        bytes: &[u8],
        t_recv: MonoTime,
        seq: u64,
        out: &mut Vec<Stamped<GnssEpoch>>,
    ) {
        self.decoder.push(bytes, t_recv, &mut self.heard);
        self.stamp(seq, out);
    }

    pub(super) fn tick(&mut self, now: MonoTime, seq: u64, out: &mut Vec<Stamped<GnssEpoch>>) {
        self.decoder.tick(now, &mut self.heard);
        self.stamp(seq, out);
    }

    pub(super) fn finish(&mut self, out: &mut Vec<Stamped<GnssEpoch>>) {
        self.decoder.flush(&mut self.heard);
        self.stamp(u64::MAX, out);
    }

    fn stamp(&mut self, seq: u64, out: &mut Vec<Stamped<GnssEpoch>>) {
        for heard in self.heard.drain(..) {
            let began = heard.t_first_byte - on_the_wire(heard.bytes_before_end, self.baud);
            if let (true, Some(time_of_day_ns)) = (heard.opens_burst, heard.epoch.time_of_day_ns) {
                self.clock.observe(time_of_day_ns, began);
            }
            // An epoch without a time, or one the fit does not know, was true a latency ago.
            let fitted = heard.epoch.time_of_day_ns.and_then(|of_day| self.clock.host_time_of(of_day, began));
            if !heard.opens_burst && fitted.is_none() {
                // Another instant within a burst, which neither its arrival nor the fit puts in time.
                continue;
            }
            self.clock_sigma = fitted.map(|(_, sigma)| sigma);
            let t_valid = fitted.map_or(began - self.latency, |(t, _)| t);
            out.push(Stamped { t_valid, t_recv: heard.t_last_byte, seq, value: heard.epoch });
        }
    }

    /// Recent arrivals, for [`Self::resume`].
    pub(super) fn arrivals(&self) -> Vec<WarmArrival> {
        let arrivals = self.clock.arrivals(WARM_ARRIVALS);
        arrivals.into_iter().map(|(t, offset_ns)| WarmArrival { t_ns: t.ns(), offset_ns }).collect()
    }

    /// Continues the clock fit of an earlier run.
    pub(super) fn resume(&mut self, arrivals: &[WarmArrival]) {
        let arrivals: Vec<_> = arrivals.iter().map(|a| (MonoTime::from_ns(a.t_ns), a.offset_ns)).collect();
        self.clock.resume(&arrivals);
    }

    /// One-sigma of the fit from UTC to host time.
    pub(super) fn clock_sigma(&self) -> Option<Span> {
        self.clock_sigma
    }

    /// The receiver's pulse marked a whole second of UTC at this host time.
    pub(super) fn pulse(&mut self, edge: MonoTime) {
        self.clock.observe_pulse(edge);
    }

    pub(super) fn refused(&self) -> (u64, String) {
        refused(self.decoder.counts())
    }
}

/// Compass bytes to samples at their time of validity.
pub(super) struct CompassLine {
    decoder: CompassDecoder,
    heard: Vec<HeardAttitude>,
    clock: SteadyClock,
    baud: u32,
    latency: Span,
}

impl CompassLine {
    pub(super) fn new(config: &Config) -> Self {
        Self {
            decoder: CompassDecoder::new(config.compass.format),
            heard: Vec::new(),
            clock: SteadyClock::new(),
            baud: config.compass.baud,
            latency: Span::from_ms(config.compass.latency_ms),
        }
    }

    pub(super) fn push(
        &mut self,
        bytes: &[u8],
        t_recv: MonoTime,
        seq: u64,
        out: &mut Vec<Stamped<AttitudeSample>>,
    ) {
        self.decoder.push(bytes, t_recv, &mut self.heard);
        for heard in self.heard.drain(..) {
            let length = heard.bytes + heard.bytes_after;
            let began = heard.t_recv - on_the_wire(length, self.baud);
            let t_valid = self.clock.smooth(began) - self.latency;
            out.push(Stamped { t_valid, t_recv: heard.t_recv, seq, value: heard.sample });
        }
    }

    pub(super) fn refused(&self) -> (u64, String) {
        refused(self.decoder.counts())
    }
}
