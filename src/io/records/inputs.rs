//! Events as records: exactly what was heard.

use prost::Message as _;

use super::{Record, Schema, topic, warm};
use crate::io::proto::{foxglove, timestamp, windhover};
use windhover_base::msg::{Event, EventBody, FrameEncoding, FramePayload, Source};
use windhover_base::time::MonoTime;

/// Frame of reference of images.
const CAMERA_FRAME: &str = "camera";

/// The record of an event; `None` for ticks, which are not kept.
pub fn of_event(event: &Event) -> Option<Record> {
    let t = event.t_recv;
    let source_event = |source: Source, what: &str, count: u32| {
        let message = windhover::SourceEvent {
            timestamp: Some(timestamp(t)),
            source: source.name().into(),
            what: what.into(),
            count,
        };
        record(topic::SOURCE_EVENT, Schema::SourceEvent, t, t, message.encode_to_vec())
    };
    Some(match &event.body {
        EventBody::Bytes { source, data } => serial(source.topic(), t, data),
        EventBody::Frame(frame) => image(t, frame),
        EventBody::Dropped { source, count } => source_event(*source, "dropped", *count),
        EventBody::Pulse => source_event(Source::Gps, "pulse", 0),
        EventBody::SourceUp(source) => source_event(*source, "up", 0),
        EventBody::SourceDown(source) => source_event(*source, "down", 0),
        EventBody::Warm(state) => {
            let data = warm::message(t, state).encode_to_vec();
            record(topic::WARM_START, Schema::WarmState, t, t, data)
        }
        EventBody::Tick => return None,
    })
}

fn record(topic: &'static str, schema: Schema, log: MonoTime, publish: MonoTime, data: Vec<u8>) -> Record {
    Record { topic: topic.into(), schema, log_time: log, publish_time: publish, data }
}

fn serial(topic: &'static str, t: MonoTime, bytes: &[u8]) -> Record {
    let message = windhover::SerialBytes { timestamp: Some(timestamp(t)), data: bytes.to_vec() };
    record(topic, Schema::SerialBytes, t, t, message.encode_to_vec())
}

fn image(t: MonoTime, frame: &FramePayload) -> Record {
    let stamp = Some(timestamp(frame.t_exposure));
    let (schema, data) = match raw_name(frame.encoding) {
        Some(encoding) => {
            let message = foxglove::RawImage {
                timestamp: stamp,
                frame_id: CAMERA_FRAME.into(),
                width: frame.width,
                height: frame.height,
                encoding: encoding.into(),
                step: frame.stride,
                data: frame.data.to_vec(),
            };
            (Schema::RawImage, message.encode_to_vec())
        }
        None => {
            let format = match frame.encoding {
                FrameEncoding::Jpeg => "jpeg",
                FrameEncoding::Png => "png",
                _ => "unknown",
            };
            let message = foxglove::CompressedImage {
                timestamp: stamp,
                frame_id: CAMERA_FRAME.into(),
                data: frame.data.to_vec(),
                format: format.into(),
            };
            (Schema::CompressedImage, message.encode_to_vec())
        }
    };
    record(Source::Camera.topic(), schema, t, frame.t_exposure, data)
}

/// The name of an uncompressed encoding in `foxglove.RawImage`.
fn raw_name(encoding: FrameEncoding) -> Option<&'static str> {
    match encoding {
        FrameEncoding::Grey => Some("mono8"),
        FrameEncoding::Yuyv => Some("yuv422_yuy2"),
        FrameEncoding::Uyvy => Some("yuv422"),
        FrameEncoding::Nv12 => Some("nv12"),
        FrameEncoding::Rgb24 => Some("rgb8"),
        FrameEncoding::Bgr24 => Some("bgr8"),
        FrameEncoding::Jpeg | FrameEncoding::Png | FrameEncoding::Unknown => None,
    }
}

/// The encoding of a `foxglove.RawImage` by its name.
pub fn encoding_of_raw(name: &str) -> FrameEncoding {
    match name {
        "mono8" | "8UC1" => FrameEncoding::Grey,
        "yuv422_yuy2" | "yuyv" => FrameEncoding::Yuyv,
        "yuv422" | "uyvy" => FrameEncoding::Uyvy,
        "nv12" => FrameEncoding::Nv12,
        "rgb8" => FrameEncoding::Rgb24,
        "bgr8" | "8UC3" => FrameEncoding::Bgr24,
        _ => FrameEncoding::Unknown,
    }
}
