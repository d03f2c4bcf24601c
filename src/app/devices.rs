//! Device tasks: reports of a device become events for the pipeline and log events for the operator.

use std::sync::{Arc, Mutex, PoisonError};

use crate::config::{Config, Part};
use crate::io::autopilot::{self, AutopilotAddress, AutopilotSettings, ToAutopilot};
use crate::io::camera::{self, CameraInputs, CameraSettings, ExposureSettings, TriggerCount};
use crate::io::device::{Fault, NoteKind, Report, blocking};
use crate::io::mavlink::signing_key;
use crate::io::pps;
use crate::io::serial::{self, SerialSettings, Setup};
use crate::io::trigger_line;
use windhover_base::msg::{EventBody, Source};
use windhover_base::settings::{CameraConfig, CompassFormat, GpioLine, GpsFormat, shares_line};

use super::context::TaskContext;
use super::events::{self, OperatorEvent};
use super::presence::PartState;
use super::supervise::Heartbeat;

/// Reads the GPS line until a stop is requested.
pub async fn gps(config: Arc<Config>, context: TaskContext, heartbeat: Heartbeat) {
    let settings = SerialSettings {
        device: config.gps.device.clone(),
        baud: config.gps.baud,
        framing: config.gps.framing,
        text: config.gps.format != GpsFormat::Ubx,
        setup: setup(&config),
    };
    line(Part::Gps, Source::Gps, &settings, context, heartbeat).await;
}

/// How the receiver is to be configured. Its NMEA sentences stay enabled where they carry the heading.
fn setup(config: &Config) -> Option<Setup> {
    let (gps, compass) = (&config.gps, &config.compass);
    let keep_text = shares_line(gps, compass) && compass.format == CompassFormat::Nmea;
    match (gps.configure, gps.configure_garmin) {
        (true, _) => Some(Setup::Ublox { rate_hz: gps.rate_hz, keep_text }),
        (_, true) => Some(Setup::Garmin),
        _ => None,
    }
}

/// Reads the compass line until a stop is requested.
pub async fn compass(config: Arc<Config>, context: TaskContext, heartbeat: Heartbeat) {
    let settings = SerialSettings {
        device: config.compass.device.clone(),
        baud: config.compass.baud,
        framing: config.compass.framing,
        text: config.compass.format.is_text(),
        setup: None,
    };
    line(Part::Compass, Source::Compass, &settings, context, heartbeat).await;
}

async fn line(
    part: Part,
    source: Source,
    settings: &SerialSettings,
    context: TaskContext,
    heartbeat: Heartbeat,
) {
    let (clock, stop) = (context.clock, context.stop.clone());
    let device = DeviceReports { part, source, context, heartbeat };
    let reports = |report| device.take(report);
    stop.run_until_cancelled(serial::run(settings, clock, &reports)).await;
}

/// Receives from the autopilot and sends to it, until a stop is requested.
pub async fn autopilot(
    config: Arc<Config>,
    outgoing: ToAutopilot,
    context: TaskContext,
    heartbeat: Heartbeat,
) {
    let Some(autopilot) = &config.autopilot else { return };
    let key = config.mavlink.signing_key.clone();
    let key = match blocking(move || signing_key(key.as_deref())).await {
        Ok(key) => key,
        Err(error) => return OperatorEvent::AutopilotNote.emit("autopilot", error),
    };
    let reached = match (&autopilot.device, autopilot.listen_at()) {
        (Some(device), _) => AutopilotAddress::Serial { device: device.clone(), baud: autopilot.baud },
        (None, Some(address)) => AutopilotAddress::Udp(address.to_owned()),
        (None, None) => return,
    };
    let (system_id, configure) = (autopilot.system_id, autopilot.configure);
    let settings = AutopilotSettings {
        reached,
        system_id,
        configure,
        key,
        signing_link_id: config.mavlink.signing_link_id,
    };
    let (clock, stop) = (context.clock, context.stop.clone());
    let device = DeviceReports { part: Part::Autopilot, source: Source::Autopilot, context, heartbeat };
    let reports = |report| device.take(report);
    stop.run_until_cancelled(autopilot::run(&settings, &outgoing, clock, &reports)).await;
}

/// Takes frames until a stop is requested.
pub async fn camera(config: Arc<Config>, inputs: CameraInputs, context: TaskContext, heartbeat: Heartbeat) {
    let settings = CameraSettings {
        device: config.camera.device.clone(),
        width: config.camera.width,
        height: config.camera.height,
        fps: config.camera.fps,
        pixel_format: config.camera.pixel_format,
    };
    let (clock, stop) = (context.clock, context.stop.clone());
    let device = DeviceReports { part: Part::Camera, source: Source::Camera, context, heartbeat };
    let reports = |report| device.take(report);
    stop.run_until_cancelled(camera::run(&settings, &inputs, clock, &reports)).await;
}

/// Reads the receiver's pulse until a stop is requested. Without the pulse line only accuracy is lost, so readiness
/// does not wait for it.
pub async fn pulses(device: String, context: TaskContext, heartbeat: Heartbeat) {
    let reports = |report| plain(report, "pps", &heartbeat);
    let pulse = |t| context.events.put(t, EventBody::Pulse);
    context.stop.run_until_cancelled(pps::run(&device, context.clock, &reports, &pulse)).await;
}

/// Watches the line that triggers the camera until a stop is requested. Without it only the count of lost frames is
/// missing, so readiness does not wait for it.
pub async fn trigger(
    line: GpioLine,
    count: Arc<Mutex<TriggerCount>>,
    context: TaskContext,
    heartbeat: Heartbeat,
) {
    let reports = |report| plain(report, "trigger", &heartbeat);
    let pulse = |t| count.lock().unwrap_or_else(PoisonError::into_inner).pulse(t);
    context.stop.run_until_cancelled(trigger_line::run(&line, context.clock, &reports, &pulse)).await;
}

/// What is configured of the camera's exposure and gain.
pub const fn exposure(camera: &CameraConfig) -> ExposureSettings {
    ExposureSettings { exposure_us: camera.exposure_us, auto_max_us: camera.auto_max_us, gain: camera.gain }
}

/// Reports of a device that delivers neither bytes nor frames.
fn plain(report: Report, name: &str, heartbeat: &Heartbeat) {
    heartbeat.beat();
    match report {
        Report::Up(text) => OperatorEvent::DeviceUp.emit(name, text),
        Report::Down(fault) => events::device_down(name, &fault),
        _ => {}
    }
}

/// Where a device's reports go.
struct DeviceReports {
    part: Part,
    source: Source,
    context: TaskContext,
    heartbeat: Heartbeat,
}

impl DeviceReports {
    fn take(&self, report: Report) {
        self.heartbeat.beat();
        let name = self.part.name();
        match report {
            Report::Beat => {}
            Report::Up(text) => {
                self.context.presence.set(self.part, PartState::Open);
                self.put(EventBody::SourceUp(self.source));
                OperatorEvent::DeviceUp.emit(name, text);
            }
            Report::Bytes(t, bytes) => {
                self.delivers();
                self.context.events.put(t, EventBody::Bytes { source: self.source, data: bytes });
            }
            Report::Frame(t, frame) => {
                self.delivers();
                self.context.events.put_frame(t, frame);
            }
            Report::Down(fault) => self.down(&fault),
            Report::Note(kind, count, text) => {
                if kind == NoteKind::FramesMissed {
                    self.put(EventBody::Dropped { source: self.source, count });
                }
                OperatorEvent::from(kind).emit(name, text);
            }
        }
    }

    fn put(&self, body: EventBody) {
        self.context.events.put(self.context.clock.now(), body);
    }

    fn delivers(&self) {
        if self.context.presence.get(self.part) != PartState::Delivers {
            self.context.presence.set(self.part, PartState::Delivers);
        }
    }

    fn down(&self, fault: &Fault) {
        let before = self.context.presence.set(self.part, PartState::Down(fault.kind.name().into()));
        if matches!(before, PartState::Open | PartState::Delivers) {
            self.put(EventBody::SourceDown(self.source));
        }
        events::device_down(self.part.name(), fault);
    }
}
