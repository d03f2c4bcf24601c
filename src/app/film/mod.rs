//! Video with its metadata: H.264 in an MPEG transport stream, with KLV packets for each frame (MISB ST 0601, 0903,
//! 0604). `export` makes it from a flight; the daemon sends it live.

mod known;
mod view;

pub use known::{Known, is_of_film};

use crate::io::video::{
    H264Encoder, TimeStatus, TransportStream, Unit, VideoError, core_id, sensor_packet, targets_packet,
    with_time,
};
use crate::pixels;
use windhover_base::msg::FramePayload;
use windhover_base::settings::CameraConfig;
use windhover_base::time::{MonoTime, NS_PER_S};

/// The first frame is shown at this time of the stream, ticks of 90 kHz.
const FIRST_PTS: u64 = 90_000;
/// A smaller change of the time between two frames is none, microseconds: the receiver's clock is fitted to less.
const STEP_US: i64 = 5_000;
/// Frames a second where no configuration tells.
const FPS: f64 = 15.0;

/// A film in the making.
pub struct Film {
    /// What is known of its frames; a frame's records come before the frame.
    pub known: Known,
    mission: String,
    camera: Option<CameraConfig>,
    fps: f64,
    core_id: Vec<u8>,
    stream: Option<Stream>,
}

struct Stream {
    encoder: H264Encoder,
    ts: TransportStream,
    began: MonoTime,
    last_pts: u64,
    /// Exposure and time of the frame before.
    last: Option<(MonoTime, u64)>,
    size: (usize, usize),
}

/// A frame of a film.
pub struct FilmFrame {
    /// Packets of the transport stream: tables, clock, both packets of KLV, the picture.
    pub ts: Vec<u8>,
    /// The picture alone: an access unit of H.264 in the byte stream format, with its time.
    pub unit: Vec<u8>,
}

impl Film {
    /// A film of that mission (a name), of this camera, where it is known, at so many frames a second at most.
    pub fn new(mission: String, camera: Option<CameraConfig>, fps: Option<f64>, known: Known) -> Self {
        // A camera is identified by its lens and mount.
        let words = camera.as_ref().and_then(|camera| toml::to_string(camera).ok()).unwrap_or_default();
        let of_camera = camera.as_ref().map_or(FPS, |camera| camera.fps);
        let fps = fps.map_or(of_camera, |fps| fps.min(of_camera));
        Self { known, mission, camera, fps, core_id: core_id(&words).to_vec(), stream: None }
    }

    /// The next frame; `None` where it cannot be decoded, or is of another size than the first.
    ///
    /// # Errors
    /// The encoder does not take frames of this kind, or fails.
    pub fn frame(&mut self, frame: &FramePayload) -> Result<Option<FilmFrame>, VideoError> {
        let Ok(picture) = pixels::decode(frame, true) else { return Ok(None) };
        let size = (picture.gray.width, picture.gray.height);
        let stream = match &mut self.stream {
            Some(stream) => stream,
            none => none.insert(Stream {
                encoder: H264Encoder::new(size.0, size.1, self.fps)?,
                ts: TransportStream::default(),
                began: frame.t_exposure,
                last_pts: 0,
                last: None,
                size,
            }),
        };
        if size != stream.size {
            return Ok(None);
        }
        let (unit, key) = stream.encoder.encode(&picture.gray, picture.rgb.as_ref())?;
        let pts = stream.pts(frame.t_exposure);
        let size_px = (size.0 as u32, size.1 as u32);
        let camera = self.camera.as_ref();
        let (mut view, targets) = view::view(frame.index, frame.t_exposure, size_px, &self.known, camera);
        view.mission.clone_from(&self.mission);
        view.core_id.clone_from(&self.core_id);
        let targets = targets_packet(view.unix_us, &targets, size_px, view.field_deg, &view.core_id);
        let step_us = stream.step_us(frame.t_exposure, view.unix_us);
        let status = TimeStatus { is_utc: self.known.utc_minus_host_ns.is_some(), step_us };
        let unit = with_time(&unit, view.unix_us, status);
        let mut ts = Vec::new();
        stream.ts.before(pts, &mut ts);
        stream.ts.unit(Unit::Klv, pts, &sensor_packet(&view), &mut ts);
        stream.ts.unit(Unit::Klv, pts, &targets, &mut ts);
        stream.ts.unit(Unit::Video { key }, pts, &unit, &mut ts);
        Ok(Some(FilmFrame { ts, unit }))
    }
}

impl Stream {
    /// Step of the time between the previous frame and this one, microseconds; changes by the fit of the receiver's
    /// clock are no step.
    fn step_us(&mut self, t: MonoTime, unix_us: u64) -> i64 {
        let (before, before_us) = self.last.replace((t, unix_us)).unwrap_or((t, unix_us));
        let step =
            (unix_us as i64).saturating_sub(before_us as i64).saturating_sub((t - before).ns() / 1_000);
        if step.abs() < STEP_US { 0 } else { step }
    }

    /// When a frame is shown, ticks of 90 kHz; always later than the one before.
    fn pts(&mut self, t_exposure: MonoTime) -> u64 {
        let since = (t_exposure - self.began).ns().max(0) as u128;
        let pts = FIRST_PTS + (since * 90_000 / NS_PER_S as u128) as u64;
        self.last_pts = pts.max(self.last_pts + 1);
        self.last_pts
    }
}
