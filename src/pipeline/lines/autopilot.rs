//! The autopilot's line: MAVLink bytes to readings at their time of validity.

use super::SourceLine;
use super::samples::Sample as _;
use windhover_base::msg::{SensorReading, Stamped};
use windhover_base::settings::{AutopilotConfig, AutopilotUse, Rig};
use windhover_base::time::{MonoTime, Span};
use windhover_decode::{AutopilotDecoder, AutopilotMeasurement, DecodeCounts, ReceivedAutopilot};

/// MAVLink bytes to readings.
pub(in crate::pipeline) struct AutopilotLine {
    config: AutopilotConfig,
    decoder: AutopilotDecoder,
    received: Vec<ReceivedAutopilot>,
    /// Whether it replaces the compass; the same for the receiver.
    is_compass: bool,
    is_receiver: bool,
    gps_latency: Span,
}

impl AutopilotLine {
    pub(super) fn new(config: &AutopilotConfig, rig: &Rig) -> Self {
        Self {
            decoder: AutopilotDecoder::new(config.system_id),
            received: Vec::new(),
            is_compass: !rig.compass.is_there(),
            is_receiver: !rig.gps.is_there() && config.gives(AutopilotUse::Gps),
            gps_latency: Span::from_ms(rig.gps.latency_ms),
            config: config.clone(),
        }
    }
}

impl SourceLine for AutopilotLine {
    fn push(&mut self, bytes: &[u8], t_recv: MonoTime, seq: u64, out: &mut Vec<SensorReading>) {
        self.decoder.push(bytes, t_recv, &mut self.received);
        let gives = |what| self.config.gives(what);
        for ReceivedAutopilot { t, measurement } in self.received.drain(..) {
            match measurement {
                AutopilotMeasurement::Attitude(value) if gives(AutopilotUse::Attitude) => {
                    let sample = Stamped { t_valid: t, t_recv, seq, value };
                    out.push(match self.is_compass {
                        true => SensorReading::Attitude(sample),
                        false => SensorReading::SecondAttitude(sample),
                    });
                }
                AutopilotMeasurement::Inertial(value) if gives(AutopilotUse::Imu) && value.can_be() => {
                    out.push(SensorReading::Inertial(Stamped { t_valid: t, t_recv, seq, value }));
                }
                AutopilotMeasurement::Gnss(value) if self.is_receiver => {
                    let t_valid = t - self.gps_latency;
                    out.push(SensorReading::Gnss(Stamped { t_valid, t_recv, seq, value }));
                }
                AutopilotMeasurement::Position(value) => {
                    out.push(SensorReading::Autopilot(Stamped { t_valid: t, t_recv, seq, value }));
                }
                _ => {}
            }
        }
    }

    fn counts(&self) -> &DecodeCounts {
        self.decoder.counts()
    }
}
