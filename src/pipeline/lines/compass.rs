//! The compass line: bytes to samples at their time of validity.

use super::samples::Sample as _;
use super::{SourceLine, Wire};
use windhover_base::msg::{SensorReading, Stamped};
use windhover_base::settings::CompassConfig;
use windhover_base::time::{MonoTime, Span, SteadyClock};
use windhover_decode::{CompassDecoder, DecodeCounts, ReceivedAttitude};

/// Compass bytes to samples at their time of validity.
pub(in crate::pipeline) struct CompassLine {
    decoder: CompassDecoder,
    received: Vec<ReceivedAttitude>,
    clock: SteadyClock,
    /// Of rates and forces that come in sentences of their own.
    inertial_clock: SteadyClock,
    wire: Wire,
    latency: Span,
    /// Latency of its rates and forces, where these are used.
    inertial_latency: Option<Span>,
}

impl CompassLine {
    pub(super) fn new(config: &CompassConfig, inertial_latency_ms: f64) -> Self {
        Self {
            decoder: CompassDecoder::new(config.format).checksums_required(config.require_checksum),
            received: Vec::new(),
            clock: SteadyClock::new(),
            inertial_clock: SteadyClock::new(),
            wire: Wire::new(config.framing, config.baud),
            latency: Span::from_ms(config.latency_ms),
            inertial_latency: config.imu.then(|| Span::from_ms(inertial_latency_ms)),
        }
    }
}

impl CompassLine {
    fn stamp(&mut self, seq: u64, out: &mut Vec<SensorReading>) {
        for received in self.received.drain(..) {
            let length = received.bytes + received.bytes_after;
            let alone = received.reading.is_inertial_only();
            let clock = if alone { &mut self.inertial_clock } else { &mut self.clock };
            let began = clock.smooth(received.t_first - self.wire.time(length));
            let t_recv = received.t_recv;
            if !alone {
                let sample = Stamped { t_valid: began - self.latency, t_recv, seq, value: received.sample };
                out.push(SensorReading::Attitude(sample));
            }
            let inertial = self.inertial_latency.zip(received.reading.inertial);
            if let Some((latency, value)) = inertial.filter(|(_, sample)| sample.can_be()) {
                out.push(SensorReading::Inertial(Stamped { t_valid: began - latency, t_recv, seq, value }));
            }
        }
    }
}

impl SourceLine for CompassLine {
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

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::settings::CompassFormat;
    use windhover_decode::framed;

    #[test]
    fn rates_beside_the_attitude_are_used_where_that_is_asked() {
        let body =
            "VNYMR,+085.1,-000.9,+000.8,+01.06,-00.25,+03.06,+00.005,+00.344,-09.758,-0.001,+0.002,-0.003";
        let line = (framed(body) + "\r\n").into_bytes();
        for imu in [false, true] {
            let config = CompassConfig {
                format: CompassFormat::Vectornav,
                imu,
                latency_ms: 20.0,
                ..CompassConfig::default()
            };
            let (mut compass, mut out) = (CompassLine::new(&config, 5.0), Vec::new());
            compass.push(&line, MonoTime::from_ns(1_000_000_000), 7, &mut out);
            let [SensorReading::Attitude(attitude), rest @ ..] = &out[..] else { panic!("{out:?}") };
            match (imu, rest) {
                (false, []) => {}
                (true, [SensorReading::Inertial(inertial)]) => {
                    let rate = inertial.value.rate_rps.expect("reported");
                    assert_eq!((rate.x, rate.y, rate.z), (-0.001, 0.002, -0.003));
                    // Each has its own latency.
                    assert_eq!(inertial.t_valid - attitude.t_valid, Span::from_ms(15.0));
                }
                _ => panic!("{imu}: {rest:?}"),
            }
        }
    }

    #[test]
    fn rates_in_sentences_of_their_own_leave_the_attitude_as_it_is() {
        let (psbgi, heading) =
            ("PSBGI,003944.74,-0.08,0.07,0.00,-0.02,0.06,-9.72,", "PSBGA,003944.740,V,1.0,2.0,30.0,,,,P,v,v");
        for imu in [false, true] {
            let config = CompassConfig { format: CompassFormat::Nmea, imu, ..CompassConfig::default() };
            let (mut compass, mut out) = (CompassLine::new(&config, 0.0), Vec::new());
            for period in 0..20_i64 {
                for (ms, body) in [(0, heading), (3, psbgi), (10, psbgi)] {
                    let t = MonoTime::from_ns((period * 20 + ms) * 1_000_000);
                    compass.push((framed(body) + "\r\n").as_bytes(), t, 0, &mut out);
                }
            }
            let attitudes = out.iter().filter(|r| matches!(r, SensorReading::Attitude(_))).count();
            let rates = out.iter().filter(|r| matches!(r, SensorReading::Inertial(_))).count();
            assert_eq!((attitudes, rates), (20, if imu { 40 } else { 0 }));
        }
    }
}
