//! The GPS line: bytes to epochs at their time of validity.

use super::{SourceLine, Wire};
use windhover_base::msg::{SensorReading, Stamped, WarmArrival};
use windhover_base::settings::GpsConfig;
use windhover_base::time::{GnssClock, MonoTime, PulseTrouble, Span};
use windhover_decode::{DecodeCounts, GnssDecoder, ReceivedEpoch};

/// Arrivals kept for a warm start: the jitter of a 5 Hz receiver over 10 s.
const WARM_ARRIVALS: usize = 50;

/// GPS bytes to epochs at their time of validity.
pub(in crate::pipeline) struct GpsLine {
    decoder: GnssDecoder,
    received: Vec<ReceivedEpoch>,
    clock: GnssClock,
    clock_sigma: Option<Span>,
    wire: Wire,
    latency: Span,
}

impl GpsLine {
    pub(super) fn new(config: &GpsConfig) -> Self {
        let latency = Span::from_ms(config.latency_ms);
        Self {
            decoder: GnssDecoder::new().of_format(config.format).checksums_required(config.require_checksum),
            received: Vec::new(),
            clock: GnssClock::new(latency),
            clock_sigma: None,
            wire: Wire::new(config.framing, config.baud),
            latency,
        }
    }

    fn stamp(&mut self, seq: u64, out: &mut Vec<SensorReading>) {
        for received in self.received.drain(..) {
            let began = received.t_first_byte - self.wire.time(received.bytes_before_end);
            if let (true, Some(time_of_day_ns)) = (received.opens_burst, received.epoch.time_of_day_ns) {
                self.clock.observe(time_of_day_ns, began);
            }
            // An epoch without a time, or one that the time fit cannot place, was valid one latency before its arrival.
            let fitted =
                received.epoch.time_of_day_ns.and_then(|of_day| self.clock.host_time_of(of_day, began));
            if !received.opens_burst && fitted.is_none() {
                // A second instant within a burst: neither its arrival nor the fit gives it a time.
                continue;
            }
            self.clock_sigma = fitted.map(|(_, sigma)| sigma);
            let t_valid = fitted.map_or(began - self.latency, |(t, _)| t);
            let epoch = Stamped { t_valid, t_recv: received.t_last_byte, seq, value: received.epoch };
            out.push(SensorReading::Gnss(epoch));
        }
    }

    /// Recent arrivals, as [`Self::resume`] takes them.
    pub(in crate::pipeline) fn arrivals(&self) -> Vec<WarmArrival> {
        let arrivals = self.clock.arrivals(WARM_ARRIVALS);
        arrivals.into_iter().map(|(t, offset_ns)| WarmArrival { t_ns: t.ns(), offset_ns }).collect()
    }

    /// Continues the clock fit of an earlier run.
    pub(in crate::pipeline) fn resume(&mut self, arrivals: &[WarmArrival]) {
        let arrivals: Vec<_> = arrivals.iter().map(|a| (MonoTime::from_ns(a.t_ns), a.offset_ns)).collect();
        self.clock.resume(&arrivals);
    }

    /// One-sigma of the fit from UTC to host time.
    pub(in crate::pipeline) fn clock_sigma(&self) -> Option<Span> {
        self.clock_sigma
    }

    /// The reason why the receiver's pulses are not used, if they are not.
    pub(in crate::pipeline) fn pulse_trouble(&self) -> Option<PulseTrouble> {
        self.clock.pulse_trouble()
    }

    /// The receiver's pulse arrived at this host time.
    pub(in crate::pipeline) fn pulse(&mut self, edge: MonoTime) {
        self.clock.observe_pulse(edge);
    }
}

impl SourceLine for GpsLine {
    fn push(&mut self, bytes: &[u8], t_recv: MonoTime, seq: u64, out: &mut Vec<SensorReading>) {
        self.decoder.push(bytes, t_recv, &mut self.received);
        self.stamp(seq, out);
    }

    fn tick(&mut self, now: MonoTime, seq: u64, out: &mut Vec<SensorReading>) {
        self.decoder.tick(now, &mut self.received);
        self.stamp(seq, out);
    }

    fn finish(&mut self, out: &mut Vec<SensorReading>) {
        self.decoder.flush(&mut self.received);
        self.stamp(u64::MAX, out);
    }

    fn counts(&self) -> &DecodeCounts {
        self.decoder.counts()
    }
}
