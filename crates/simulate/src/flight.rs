//! A whole simulated flight as the devices would deliver it: serial reads and frames, in order.

use std::sync::Arc;

use super::camera::{Exposures, FrameTruth};
use super::compass::Compass;
use super::compass_wire::{WireContext, write_reading};
use super::garmin::write_epoch;
use super::gnss::GnssReceiver;
use super::line::Line;
use super::random::{Purpose, Stream};
use super::render::Renderer;
use super::world::World;
use windhover_base::msg::{Event, EventBody, FrameEncoding, FramePayload, GrayImage, Source};
use windhover_base::time::{MonoTime, Span};

/// Encodes an image as JPEG. The error is the reason as text.
pub type JpegEncoder = Arc<dyn Fn(&GrayImage) -> Result<Vec<u8>, String> + Send + Sync>;

/// How frames are stored.
#[derive(Clone)]
pub enum FrameStorage {
    /// As JPEG.
    Jpeg(JpegEncoder),
    /// As the sensor gives them: 8-bit grey.
    Raw,
    /// No frames at all: serial lines only.
    None,
}

/// Why a flight could not continue.
#[derive(Debug, thiserror::Error)]
pub enum FlightError {
    /// A frame could not be compressed.
    #[error("frame {frame} cannot be stored as JPEG: {reason}")]
    Jpeg {
        /// Its number.
        frame: u32,
        /// The encoder's error.
        reason: String,
    },
}

/// The events of a flight, in order of reception.
pub struct Flight {
    world: Arc<World>,
    renderer: Option<Renderer>,
    storage: FrameStorage,
    gnss: GnssReceiver,
    gnss_line: Line,
    compass: Compass,
    compass_line: Line,
    exposures: Exposures,
    frame: Option<FrameTruth>,
    last_frame: Option<FrameTruth>,
    image: GrayImage,
    seq: u64,
}

impl Flight {
    /// A flight through `world` that renders with this many threads.
    pub fn new(world: Arc<World>, storage: FrameStorage, threads: usize) -> Self {
        let rig = &world.scenario().rig;
        let lines = Stream::of(world.seed(), Purpose::GnssLine);
        let gnss_line = Line::new(rig.gps.baud, lines);
        let lines = Stream::of(world.seed(), Purpose::CompassLine);
        let compass_line = Line::new(rig.compass.baud, lines);
        let mut exposures = Exposures::new(world.seed());
        let draws = !matches!(storage, FrameStorage::None);
        let frame = if draws { exposures.next(&world) } else { None };
        Self {
            renderer: draws.then(|| Renderer::new(Arc::clone(&world)).with_threads(threads)),
            storage,
            gnss: GnssReceiver::new(&world),
            gnss_line,
            compass: Compass::new(&world),
            compass_line,
            exposures,
            frame,
            last_frame: None,
            image: GrayImage::default(),
            seq: 0,
            world,
        }
    }

    /// The simulated world.
    pub fn world(&self) -> &Arc<World> {
        &self.world
    }

    /// The true times of the frame last returned.
    pub fn frame_truth(&self) -> Option<&FrameTruth> {
        self.last_frame.as_ref()
    }

    /// This flight's true GPS latency minus the configured one.
    pub fn gps_latency_error(&self) -> Span {
        self.gnss.latency_error(self.world.scenario())
    }

    /// This flight's true compass latency minus the configured one.
    pub fn compass_latency_error(&self) -> Span {
        self.compass.latency_error(self.world.scenario())
    }

    /// Sends the receivers' data until both lines hold something, or have ended.
    fn fill_lines(&mut self) {
        let scenario = self.world.scenario();
        let mut line = Vec::with_capacity(256);
        while self.gnss_line.next_at().is_none() {
            let Some(sample) = self.gnss.next(&self.world) else { break };
            line.clear();
            write_epoch(scenario, &sample.epoch, &mut line);
            self.gnss_line.send(&line, sample.t_first_byte);
        }
        while self.compass_line.next_at().is_none() {
            let Some(sample) = self.compass.next(&self.world) else { break };
            let context = WireContext {
                format: scenario.rig.compass.format,
                declination_deg: scenario.declination_deg,
                utc: self.world.utc(self.world.seconds(sample.t_true)),
            };
            line.clear();
            write_reading(&sample.sample, &context, &mut line);
            self.compass_line.send(&line, sample.t_first_byte);
        }
    }

    fn event(&mut self, t_recv: MonoTime, body: EventBody) -> Event {
        let seq = self.seq;
        self.seq += 1;
        Event { t_recv, seq, body }
    }

    fn frame_event(&mut self, truth: FrameTruth) -> Result<Event, FlightError> {
        self.frame = self.exposures.next(&self.world);
        self.last_frame = Some(truth);
        if let Some(renderer) = &self.renderer {
            renderer.render(truth.t_true, truth.frame, &mut self.image);
        }
        let image = &self.image;
        let payload = match &self.storage {
            FrameStorage::Jpeg(encode) => FramePayload {
                index: truth.frame,
                t_exposure: truth.t_stamp,
                encoding: FrameEncoding::Jpeg,
                width: 0,
                height: 0,
                stride: 0,
                data: encode(image)
                    .map_err(|reason| FlightError::Jpeg { frame: truth.frame, reason })?
                    .into(),
            },
            FrameStorage::Raw | FrameStorage::None => truth.in_grey(image.clone()),
        };
        Ok(self.event(truth.t_recv, EventBody::Frame(payload)))
    }
}

impl Iterator for Flight {
    type Item = Result<Event, FlightError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.fill_lines();
        let (gnss, compass) = (self.gnss_line.next_at(), self.compass_line.next_at());
        let frame = self.frame;
        let first = [gnss, compass, frame.map(|f| f.t_recv)].into_iter().flatten().min()?;
        if gnss == Some(first) {
            let (t, bytes) = self.gnss_line.pop()?;
            return Some(Ok(self.event(t, EventBody::Bytes { source: Source::Gps, data: bytes })));
        }
        if compass == Some(first) {
            let (t, bytes) = self.compass_line.pop()?;
            return Some(Ok(self.event(t, EventBody::Bytes { source: Source::Compass, data: bytes })));
        }
        Some(self.frame_event(frame?))
    }
}
