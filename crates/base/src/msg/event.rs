//! Events of devices (or of a capture of them), stamped at arrival.

use std::sync::Arc;

use super::{AttitudeSample, InertialSample, Source, WarmState};
use crate::time::MonoTime;

/// One event, in order of reception.
#[derive(Clone, Debug)]
pub struct Event {
    /// Its reception, host time.
    pub t_recv: MonoTime,
    /// Position in the stream of events.
    pub seq: u64,
    /// Its content.
    pub body: EventBody,
}

/// The content of an event.
#[derive(Clone, Debug)]
pub enum EventBody {
    /// The bytes one read of a source's line returned.
    Bytes {
        /// The source.
        source: Source,
        /// The bytes.
        data: Vec<u8>,
    },
    /// One camera frame.
    Frame(FramePayload),
    /// A sample of rates and forces, in the sensor's axes.
    Inertial {
        /// The source.
        source: Source,
        /// The sample.
        sample: InertialSample,
    },
    /// A sample of attitude.
    Attitude {
        /// The source.
        source: Source,
        /// The sample.
        sample: AttitudeSample,
    },
    /// Time has passed without an arrival. It follows from the times of the events around it, so it is not recorded.
    Tick,
    /// Something was lost before it could be recorded.
    Dropped {
        /// The source.
        source: Source,
        /// Number of messages.
        count: u32,
    },
    /// The receiver's pulse marked a whole second of UTC; `t_recv` is the edge.
    Pulse,
    /// A device has appeared.
    SourceUp(Source),
    /// A device has disappeared.
    SourceDown(Source),
    /// The state that an earlier run of the same flight learnt; it comes before all other events, or not at all.
    Warm(Box<WarmState>),
}

impl EventBody {
    /// The source that delivered it; `None` for events without a source.
    pub const fn delivered_by(&self) -> Option<Source> {
        match self {
            Self::Bytes { source, .. } | Self::Inertial { source, .. } | Self::Attitude { source, .. } => {
                Some(*source)
            }
            Self::Frame(_) => Some(Source::Camera),
            _ => None,
        }
    }
}

/// Encoding of the bytes of a frame.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum FrameEncoding {
    /// 8-bit grey.
    Grey,
    /// Packed 4:2:2, Y first.
    Yuyv,
    /// Packed 4:2:2, U first.
    Uyvy,
    /// Planar 4:2:0.
    Nv12,
    /// 24-bit RGB.
    Rgb24,
    /// 24-bit BGR.
    Bgr24,
    /// 8-bit mosaic of colour filters (Bayer): each pixel is red, green or blue.
    Bayer(Bayer),
    /// Grey of 10 bits in two bytes, little-endian.
    Y10,
    /// Grey of 12 bits in two bytes, little-endian.
    Y12,
    /// Grey of 16 bits in two bytes, little-endian.
    Y16,
    /// Grey of 10 bits, four pixels in five bytes: first their upper eight bits, then their lower two.
    Y10Packed,
    /// JPEG (also one frame of Motion JPEG).
    Jpeg,
    /// PNG.
    Png,
    /// An encoding that is not supported; the frame counts, but cannot be used.
    Unknown,
}

/// Colours of a mosaic's first row and second row, from the top left.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Bayer {
    /// Red green, green blue.
    Rggb,
    /// Blue green, green red.
    Bggr,
    /// Green blue, red green.
    Gbrg,
    /// Green red, blue green.
    Grbg,
}

/// A frame as the driver or the capture delivered it.
#[derive(Clone, Debug)]
pub struct FramePayload {
    /// Number of the frame since recording began, from 0, including undecodable ones. A device leaves 0: frames are
    /// numbered where they join the stream of events.
    pub index: u32,
    /// The driver's exposure stamp, host time.
    pub t_exposure: MonoTime,
    /// How to read `data`.
    pub encoding: FrameEncoding,
    /// Width in pixels; 0 where the encoding contains it.
    pub width: u32,
    /// Height in pixels; 0 where the encoding contains it.
    pub height: u32,
    /// Bytes from one row to the next; 0 where the encoding contains it.
    pub stride: u32,
    /// The bytes.
    pub data: Arc<[u8]>,
}
