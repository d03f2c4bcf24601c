//! The compass line: bytes to samples at their time of validity.

use super::samples::Sample as _;
use super::{SourceLine, Wire};
use windhover_base::msg::{SensorReading, Stamped};
use windhover_base::settings::CompassConfig;
use windhover_base::time::{MonoTime, Span, SteadyClock};
use windhover_decode::{CompassDecoder, DecodeCounts, HeardAttitude};

/// Compass bytes to samples at their time of validity.
pub(in crate::pipeline) struct CompassLine {
    decoder: CompassDecoder,
    heard: Vec<HeardAttitude>,
    clock: SteadyClock,
    wire: Wire,
    latency: Span,
    /// Of its rates and forces, where these are used.
    inertial_latency: Option<Span>,
}

impl CompassLine {
    pub(super) fn new(config: &CompassConfig, inertial_latency_ms: f64) -> Self {
        Self {
            decoder: CompassDecoder::new(config.format).checksums_required(config.require_checksum),
            heard: Vec::new(),
            clock: SteadyClock::new(),
            wire: Wire::new(config.framing, config.baud),
            latency: Span::from_ms(config.latency_ms),
            inertial_latency: config.imu.then(|| Span::from_ms(inertial_latency_ms)),
        }
    }
}

impl CompassLine {
    fn stamp(&mut self, seq: u64, out: &mut Vec<SensorReading>) {
        for heard in self.heard.drain(..) {
            let length = heard.bytes + heard.bytes_after;
            let began = self.clock.smooth(heard.t_first - self.wire.time(length));
            let t_recv = heard.t_recv;
            let sample = Stamped { t_valid: began - self.latency, t_recv, seq, value: heard.sample };
            out.push(SensorReading::Attitude(sample));
            let inertial = self.inertial_latency.zip(heard.reading.inertial);
            if let Some((latency, value)) = inertial.filter(|(_, sample)| sample.can_be()) {
                out.push(SensorReading::Inertial(Stamped { t_valid: began - latency, t_recv, seq, value }));
            }
        }
    }
}

impl SourceLine for CompassLine {
    fn push(&mut self, bytes: &[u8], t_recv: MonoTime, seq: u64, out: &mut Vec<SensorReading>) {
        self.decoder.push(bytes, t_recv, &mut self.heard);
        self.stamp(seq, out);
    }

    fn tick(&mut self, now: MonoTime, seq: u64, out: &mut Vec<SensorReading>) {
        self.decoder.tick(now, &mut self.heard);
        self.stamp(seq, out);
    }

    fn finish(&mut self, out: &mut Vec<SensorReading>) {
        self.decoder.flush(&mut self.heard);
        self.stamp(u64::MAX, out);
    }

    fn counts(&self) -> &DecodeCounts {
        self.decoder.counts()
    }
}
