//! The camera on its own thread: a V4L2 device, or a recording of one played at its own pace.

mod format;
mod recorded;
mod v4l2;

use windhover_base::settings::PixelFormat;

use super::clock::HostClock;
use super::device::{Backoff, Report, Stop};

/// What is asked of the camera.
#[derive(Clone, PartialEq, Debug)]
pub struct CameraSettings {
    /// Path of a V4L2 device, or `capture:PATH` for a recording (`capture-loop:PATH` plays it for ever).
    pub device: String,
    /// Frame width, pixels.
    pub width: u32,
    /// Frame height, pixels.
    pub height: u32,
    /// Frames a second asked for.
    pub fps: f64,
    /// Format asked for; any other that is understood is used where the driver gives it.
    pub pixel_format: PixelFormat,
}

/// Delivers frames until the end is asked for. Runs on the calling thread; everything it has to say
/// goes through `tell`, at least every 100 ms.
pub fn run(settings: &CameraSettings, clock: HostClock, stop: &Stop, tell: &dyn Fn(Report)) {
    let recording = |prefix| settings.device.strip_prefix(prefix).map(str::to_owned);
    let mut backoff = Backoff::new();
    while !stop.asked() {
        let fault = if let Some(path) = recording("capture:") {
            recorded::play(&path, settings, false, clock, stop, tell)
        } else if let Some(path) = recording("capture-loop:") {
            recorded::play(&path, settings, true, clock, stop, tell)
        } else {
            v4l2::stream(settings, clock, stop, tell, &mut || backoff.reset())
        };
        match fault {
            None => return,
            Some(fault) => tell(Report::Down(fault)),
        }
        backoff.wait(stop, tell);
    }
}
