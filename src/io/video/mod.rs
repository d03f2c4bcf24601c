//! Video with its metadata: H.264, KLV after MISB, MPEG transport stream.

mod core_id;
mod h264;
mod klv;
mod ts;
mod uas;
mod udp;
mod vmti;

pub use core_id::core_id;
pub use h264::{H264Encoder, TimeStatus, VideoError, with_time};
pub use ts::{TransportStream, Unit};
pub use uas::{SensorView, sensor_packet};
pub use udp::StreamSender;
pub use vmti::{SeenTarget, TargetLife, targets_packet};
