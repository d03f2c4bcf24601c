//! The camera as a task: a V4L2 device, a recording played at its own pace, or frames of another program.

mod format;
mod recorded;
mod socket;
mod v4l2;

pub use socket::grey_header;

use std::convert::Infallible;

use windhover_base::settings::PixelFormat;

use super::clock::HostClock;
use super::device::{Backoff, Report, Reports};

/// The requested settings of the camera.
#[derive(Clone, PartialEq, Debug)]
pub struct CameraSettings {
    /// Path of a V4L2 device; `capture:PATH` for a recording (`capture-loop:PATH` plays it repeatedly); `socket:PATH`
    /// for frames of another program (`socket.rs`).
    pub device: String,
    /// Frame width, pixels.
    pub width: u32,
    /// Frame height, pixels.
    pub height: u32,
    /// Requested frame rate, frames a second.
    pub fps: f64,
    /// Requested format; another supported format is used where the driver delivers that.
    pub pixel_format: PixelFormat,
}

/// Delivers frames without end; dropping the future closes the camera.
pub async fn run(settings: &CameraSettings, clock: HostClock, reports: Reports<'_>) -> Infallible {
    let recording = |prefix| settings.device.strip_prefix(prefix).map(str::to_owned);
    let mut backoff = Backoff::new();
    loop {
        let fault = if let Some(path) = recording("capture:") {
            recorded::play(&path, settings, false, clock, reports).await
        } else if let Some(path) = recording("capture-loop:") {
            recorded::play(&path, settings, true, clock, reports).await
        } else if let Some(path) = recording("socket:") {
            socket::stream(&path, clock, reports, &mut || backoff.reset()).await
        } else {
            v4l2::stream(settings, clock, reports, &mut || backoff.reset()).await
        };
        reports(Report::Down(fault));
        backoff.wait(reports).await;
    }
}
