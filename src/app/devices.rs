//! Device tasks: what a device thread tells becomes events for the pipeline and lines for the operator.

use std::sync::Arc;

use crate::config::{Config, Part};
use crate::io::camera::{self, CameraSettings};
use crate::io::clock::HostClock;
use crate::io::device::{Fault, NoteKind, Report, Stop};
use crate::io::pps;
use crate::io::serial::{self, SerialSettings};
use windhover_base::msg::{EventBody, Source};
use windhover_base::time::MonoTime;

use super::events::Event;
use super::inbox::Inbox;
use super::log::Log;
use super::presence::{PartState, Presence};
use super::supervise::Heart;

/// What every device task is given.
#[derive(Clone)]
pub struct Surroundings {
    /// The clock.
    pub clock: HostClock,
    /// When the graph began: before anything was heard.
    pub began: MonoTime,
    /// Asks for the end.
    pub stop: Stop,
    /// The operator's log.
    pub log: Log,
    /// Which parts are up.
    pub presence: Presence,
    /// Where events go.
    pub inbox: Arc<Inbox>,
}

/// Reads the GPS line until the end is asked for.
pub fn gps(config: &Config, around: &Surroundings, heart: &Heart) {
    let settings = SerialSettings {
        device: config.gps.device.clone(),
        baud: config.gps.baud,
        text: true,
        configure_garmin: config.gps.configure_garmin,
    };
    let told = Told::new(Part::Gps, Source::Gps, around, heart);
    serial::run(&settings, around.clock, &around.stop, &|report| told.take(report));
}

/// Reads the compass line until the end is asked for.
pub fn compass(config: &Config, around: &Surroundings, heart: &Heart) {
    let settings = SerialSettings {
        device: config.compass.device.clone(),
        baud: config.compass.baud,
        text: config.compass.format.is_text(),
        configure_garmin: false,
    };
    let told = Told::new(Part::Compass, Source::Compass, around, heart);
    serial::run(&settings, around.clock, &around.stop, &|report| told.take(report));
}

/// Takes frames until the end is asked for.
pub fn camera(config: &Config, around: &Surroundings, heart: &Heart) {
    let settings = CameraSettings {
        device: config.camera.device.clone(),
        width: config.camera.width,
        height: config.camera.height,
        fps: config.camera.fps,
        pixel_format: config.camera.pixel_format,
    };
    let told = Told::new(Part::Camera, Source::Camera, around, heart);
    camera::run(&settings, around.clock, &around.stop, &|report| told.take(report));
}

/// Watches the receiver's pulse until the end is asked for. A pulse line that is missing costs nothing
/// but accuracy: it is no part that readiness waits for.
pub fn pulses(config: &Config, around: &Surroundings, heart: &Heart) {
    let Some(device) = &config.gps.pps_device else { return };
    let tell = |report| {
        heart.beat();
        match report {
            Report::Up(text) => around.log.tell(Event::DeviceUp, "pps", text),
            Report::Down(fault) => around.log.tell(Event::DeviceDown, "pps", fault.to_string()),
            _ => {}
        }
    };
    let pulse = |t| around.inbox.put(t, EventBody::Pulse);
    pps::run(device, around.clock, &around.stop, &tell, &pulse);
}

/// Where a device's reports go.
struct Told<'a> {
    part: Part,
    source: Source,
    around: &'a Surroundings,
    heart: &'a Heart,
}

impl<'a> Told<'a> {
    const fn new(part: Part, source: Source, around: &'a Surroundings, heart: &'a Heart) -> Self {
        Self { part, source, around, heart }
    }

    fn take(&self, report: Report) {
        self.heart.beat();
        let name = self.part.name();
        match report {
            Report::Beat => {}
            Report::Up(text) => {
                self.around.presence.set(self.part, PartState::Open);
                self.put(EventBody::SourceUp(self.source));
                self.around.log.tell(Event::DeviceUp, name, text);
            }
            Report::Bytes(t, bytes) => {
                self.delivers();
                self.around.inbox.put(t, EventBody::Bytes { source: self.source, data: bytes });
            }
            Report::Frame(t, frame) => {
                self.delivers();
                self.around.inbox.put_frame(t, frame);
            }
            Report::Down(fault) => self.down(&fault),
            Report::Note(kind, count, text) => {
                if kind == NoteKind::FramesMissed {
                    self.put(EventBody::Dropped { source: self.source, count });
                }
                self.around.log.tell(Event::Device(kind), name, text);
            }
        }
    }

    fn put(&self, body: EventBody) {
        self.around.inbox.put(self.around.clock.now(), body);
    }

    fn delivers(&self) {
        if self.around.presence.get(self.part) != PartState::Delivers {
            self.around.presence.set(self.part, PartState::Delivers);
        }
    }

    fn down(&self, fault: &Fault) {
        let before = self.around.presence.set(self.part, PartState::Down(fault.kind.name().into()));
        if matches!(before, PartState::Open | PartState::Delivers) {
            self.put(EventBody::SourceDown(self.source));
        }
        let name = self.part.name();
        // The same fault again and again is one line in half a minute, until the device comes up; another fault
        // shows at once.
        let key = format!("{name} {}", fault.kind.name());
        self.around.log.tell_keyed(self.around.clock.now(), Event::DeviceDown, key, |line| {
            line.says(fault.to_string()).with("about", name).with("fault", fault.kind.name())
        });
    }
}
