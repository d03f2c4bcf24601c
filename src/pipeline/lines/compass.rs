//! The compass line: bytes to samples at their time of validity.

use super::{SourceLine, on_the_wire};
use windhover_base::msg::{SensorReading, Stamped};
use windhover_base::settings::CompassConfig;
use windhover_base::time::{MonoTime, Span, SteadyClock};
use windhover_decode::{CompassDecoder, DecodeCounts, HeardAttitude};

/// Compass bytes to samples at their time of validity.
pub(in crate::pipeline) struct CompassLine {
    decoder: CompassDecoder,
    heard: Vec<HeardAttitude>,
    clock: SteadyClock,
    baud: u32,
    latency: Span,
}

impl CompassLine {
    pub(super) fn new(config: &CompassConfig) -> Self {
        Self {
            decoder: CompassDecoder::new(config.format),
            heard: Vec::new(),
            clock: SteadyClock::new(),
            baud: config.baud,
            latency: Span::from_ms(config.latency_ms),
        }
    }
}

impl CompassLine {
    fn stamp(&mut self, seq: u64, out: &mut Vec<SensorReading>) {
        for heard in self.heard.drain(..) {
            let length = heard.bytes + heard.bytes_after;
            let began = heard.t_first - on_the_wire(length, self.baud);
            let t_valid = self.clock.smooth(began) - self.latency;
            let sample = Stamped { t_valid, t_recv: heard.t_recv, seq, value: heard.sample };
            out.push(SensorReading::Attitude(sample));
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
