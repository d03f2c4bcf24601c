//! The camera as a task: a V4L2 device, or a recording of one played at its own pace.

mod format;
mod recorded;
mod v4l2;

use std::convert::Infallible;

use windhover_base::settings::PixelFormat;

use super::clock::HostClock;
use super::device::{Backoff, Report, Reports};

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

/// Delivers frames for ever; dropping the future closes the camera.
pub async fn run(settings: &CameraSettings, clock: HostClock, reports: Reports<'_>) -> Infallible {
    let recording = |prefix| settings.device.strip_prefix(prefix).map(str::to_owned);
    let mut backoff = Backoff::new();
    loop {
        let fault = if let Some(path) = recording("capture:") {
            recorded::play(&path, settings, false, clock, reports).await
        } else if let Some(path) = recording("capture-loop:") {
            recorded::play(&path, settings, true, clock, reports).await
        } else {
            v4l2::stream(settings, clock, reports, &mut || backoff.reset()).await
        };
        reports(Report::Down(fault));
        backoff.wait(reports).await;
    }
}
