//! What devices (or a capture of them) deliver, stamped on arrival.

use std::sync::Arc;

use super::{AttitudeSample, InertialSample, Source, WarmState};
use crate::time::MonoTime;

/// One thing heard, in the order it was heard.
#[derive(Clone, Debug)]
pub struct Event {
    /// When it was heard, host time.
    pub t_recv: MonoTime,
    /// Position in the stream of events.
    pub seq: u64,
    /// What was heard.
    pub body: EventBody,
}

/// What was heard.
#[derive(Clone, Debug)]
pub enum EventBody {
    /// The bytes one read of a source's line returned.
    Bytes {
        /// Whose.
        source: Source,
        /// The bytes.
        data: Vec<u8>,
    },
    /// One camera frame.
    Frame(FramePayload),
    /// A sample of rates and forces, in the sensor's axes.
    Inertial {
        /// Whose.
        source: Source,
        /// It.
        sample: InertialSample,
    },
    /// A sample of attitude.
    Attitude {
        /// Whose.
        source: Source,
        /// It.
        sample: AttitudeSample,
    },
    /// Time passed and nothing arrived. It follows from the times of the events around it, so it is not kept.
    Tick,
    /// Something was lost before it could be recorded.
    Dropped {
        /// Whose.
        source: Source,
        /// How many messages.
        count: u32,
    },
    /// The receiver's pulse marked a whole second of UTC; `t_recv` is the edge.
    Pulse,
    /// A device answered.
    SourceUp(Source),
    /// A device went away.
    SourceDown(Source),
    /// What an earlier run of the same flight had learnt; comes before everything else, or not at all.
    Warm(Box<WarmState>),
}

impl EventBody {
    /// The source that delivered it; `None` for what no source delivers.
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

/// How the bytes of a frame are to be read.
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
    /// 8-bit mosaic of colour filters (Bayer): a pixel is red, green or blue.
    Bayer(Bayer),
    /// Grey of 10 bits in two bytes, least first.
    Y10,
    /// Grey of 12 bits in two bytes, least first.
    Y12,
    /// Grey of 16 bits in two bytes, least first.
    Y16,
    /// Grey of 10 bits, four pixels in five bytes: their upper eights, then their lower twos.
    Y10Packed,
    /// JPEG (also one frame of Motion JPEG).
    Jpeg,
    /// PNG.
    Png,
    /// An encoding this program does not read; the frame counts, but cannot be used.
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

/// A frame as the driver or the capture gave it.
#[derive(Clone, Debug)]
pub struct FramePayload {
    /// Number of the frame since recording began, from 0, undecodable ones included. A device leaves 0: frames
    /// are numbered where they join the stream of events.
    pub index: u32,
    /// The driver's exposure stamp, host time.
    pub t_exposure: MonoTime,
    /// How to read `data`.
    pub encoding: FrameEncoding,
    /// Width in pixels; 0 where the encoding tells.
    pub width: u32,
    /// Height in pixels; 0 where the encoding tells.
    pub height: u32,
    /// Bytes from one row to the next; 0 where the encoding tells.
    pub stride: u32,
    /// The bytes.
    pub data: Arc<[u8]>,
}
