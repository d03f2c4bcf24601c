//! The one codec between events and messages: the topic and schema of each event, in both directions.

use std::sync::Arc;

use nalgebra::Vector3;
use prost::{DecodeError, Message as _};

use super::output_messages::{attitude, inertial};
use super::{Record, Schema, topic, warm_message};
use crate::io::proto::{foxglove, host_time, timestamp, windhover};
use windhover_base::geo::Tilt;
use windhover_base::msg::{
    AttitudeSample, Bayer, Delivery, Event, EventBody, FrameEncoding, FramePayload, InertialSample, Source,
};
use windhover_base::time::MonoTime;

/// Frame of reference of images.
const CAMERA_FRAME: &str = "camera";

/// Uncompressed encodings by their names in `foxglove.RawImage`: the first is written, all are read.
const RAW_ENCODINGS: [(FrameEncoding, &[&str]); 14] = [
    (FrameEncoding::Grey, &["mono8", "8UC1"]),
    (FrameEncoding::Yuyv, &["yuv422_yuy2", "yuyv"]),
    (FrameEncoding::Uyvy, &["yuv422", "uyvy"]),
    (FrameEncoding::Nv12, &["nv12"]),
    (FrameEncoding::Rgb24, &["rgb8"]),
    (FrameEncoding::Bgr24, &["bgr8", "8UC3"]),
    (FrameEncoding::Bayer(Bayer::Rggb), &["bayer_rggb8"]),
    (FrameEncoding::Bayer(Bayer::Bggr), &["bayer_bggr8"]),
    (FrameEncoding::Bayer(Bayer::Gbrg), &["bayer_gbrg8"]),
    (FrameEncoding::Bayer(Bayer::Grbg), &["bayer_grbg8"]),
    (FrameEncoding::Y10, &["mono10"]),
    (FrameEncoding::Y12, &["mono12"]),
    (FrameEncoding::Y16, &["mono16", "16UC1"]),
    (FrameEncoding::Y10Packed, &["mono10p"]),
];

/// Compressed encodings by their names in `foxglove.CompressedImage`, likewise.
const COMPRESSED_ENCODINGS: [(FrameEncoding, &[&str]); 2] =
    [(FrameEncoding::Jpeg, &["jpeg", "jpg"]), (FrameEncoding::Png, &["png"])];

/// A recorded message, for [`EventDecoder`].
#[derive(Clone, Copy, Debug)]
pub struct KeptMessage<'a> {
    /// Its topic.
    pub topic: &'a str,
    /// Full name of its schema.
    pub schema: &'a str,
    /// The frame's number where the recording has it ([`super::FRAME_NUMBER_KEY`]).
    pub frame_number: Option<u32>,
    /// The protobuf message.
    pub data: &'a [u8],
}

/// Topic of an event; `None` for ticks, which are not recorded.
pub fn topic_of_event(body: &EventBody) -> Option<&'static str> {
    match body {
        EventBody::Tick => None,
        EventBody::Warm(_) => Some(topic::WARM_START),
        EventBody::Dropped { .. } | EventBody::Pulse | EventBody::SourceUp(_) | EventBody::SourceDown(_) => {
            Some(topic::SOURCE_EVENT)
        }
        EventBody::Bytes { source, .. }
        | EventBody::Inertial { source, .. }
        | EventBody::Attitude { source, .. } => Some(source.topic()),
        EventBody::Frame(_) => Some(Source::Camera.topic()),
    }
}

/// Whether a topic contains events.
pub fn is_event(name: &str) -> bool {
    Source::on_topic(name).is_some() || [topic::SOURCE_EVENT, topic::WARM_START].contains(&name)
}

/// The record of an event; `None` for ticks, which are not recorded.
pub fn of_event(event: &Event) -> Option<Record> {
    let t = event.t_recv;
    let (schema, publish_time, data) = match &event.body {
        EventBody::Tick => return None,
        EventBody::Bytes { data, .. } => (Schema::SerialBytes, t, serial(t, data)),
        EventBody::Frame(frame) => {
            let (schema, data) = image(frame);
            (schema, frame.t_exposure, data)
        }
        EventBody::Inertial { sample, .. } => (Schema::Inertial, t, inertial(t, sample).encode_to_vec()),
        EventBody::Attitude { sample, .. } => (Schema::Attitude, t, attitude(t, t, sample).encode_to_vec()),
        EventBody::Warm(state) => (Schema::WarmState, t, warm_message::message(t, state).encode_to_vec()),
        EventBody::Dropped { source, count } => {
            (Schema::SourceEvent, t, of_source(t, *source, "dropped", *count))
        }
        EventBody::Pulse => (Schema::SourceEvent, t, of_source(t, Source::Gps, "pulse", 0)),
        EventBody::SourceUp(source) => (Schema::SourceEvent, t, of_source(t, *source, "up", 0)),
        EventBody::SourceDown(source) => (Schema::SourceEvent, t, of_source(t, *source, "down", 0)),
    };
    Some(Record { topic: topic_of_event(&event.body)?.into(), schema, log_time: t, publish_time, data })
}

/// Converts messages back to events, in the order of recording.
#[derive(Clone, Copy, Debug, Default)]
pub struct EventDecoder {
    next_frame: u32,
}

impl EventDecoder {
    /// The event of a message; `None` where the message is not an event.
    ///
    /// # Errors
    /// The data is not a message of the topic's schema.
    pub fn body(&mut self, message: &KeptMessage<'_>) -> Result<Option<EventBody>, DecodeError> {
        Ok(match message.topic {
            topic::SOURCE_EVENT => to_source_event(&windhover::SourceEvent::decode(message.data)?),
            topic::WARM_START => {
                let state = warm_message::state(&windhover::WarmState::decode(message.data)?);
                state.map(|state| EventBody::Warm(Box::new(state)))
            }
            name => match Source::on_topic(name) {
                Some(source) => Some(self.delivered(source, message)?),
                None => None,
            },
        })
    }

    fn delivered(&mut self, source: Source, message: &KeptMessage<'_>) -> Result<EventBody, DecodeError> {
        match source.delivers() {
            Delivery::Bytes => {
                let data = windhover::SerialBytes::decode(message.data)?.data;
                Ok(EventBody::Bytes { source, data })
            }
            Delivery::Frames => {
                // A frame whose message does not decode still counts as one.
                let index = message.frame_number.unwrap_or(self.next_frame);
                self.next_frame = index.saturating_add(1);
                to_frame(message, index).map(EventBody::Frame)
            }
            Delivery::Inertial => {
                let sample = to_inertial(&windhover::Inertial::decode(message.data)?);
                Ok(EventBody::Inertial { source, sample })
            }
            Delivery::Attitude => {
                let sample = to_attitude(&windhover::Attitude::decode(message.data)?);
                Ok(EventBody::Attitude { source, sample })
            }
        }
    }
}

fn serial(t: MonoTime, bytes: &[u8]) -> Vec<u8> {
    windhover::SerialBytes { timestamp: Some(timestamp(t)), data: bytes.to_vec() }.encode_to_vec()
}

fn to_inertial(message: &windhover::Inertial) -> InertialSample {
    let three = |figures: &[f64]| <[f64; 3]>::try_from(figures).ok().map(Vector3::from);
    InertialSample { rate_rps: three(&message.rate_rps), force_mps2: three(&message.force_mps2) }
}

/// The attitude of a message.
pub fn to_attitude(message: &windhover::Attitude) -> AttitudeSample {
    let tilt = message.pitch_rad.zip(message.roll_rad).map(|(pitch, roll)| Tilt { pitch, roll });
    AttitudeSample { heading: message.heading_rad, heading_is_true: message.heading_is_true, tilt }
}

fn of_source(t: MonoTime, source: Source, what: &str, count: u32) -> Vec<u8> {
    let (source, what) = (source.name().into(), what.into());
    windhover::SourceEvent { timestamp: Some(timestamp(t)), source, what, count }.encode_to_vec()
}

fn to_source_event(event: &windhover::SourceEvent) -> Option<EventBody> {
    let source = Source::named(&event.source)?;
    match event.what.as_str() {
        "dropped" => Some(EventBody::Dropped { source, count: event.count }),
        "pulse" => Some(EventBody::Pulse),
        "up" => Some(EventBody::SourceUp(source)),
        "down" => Some(EventBody::SourceDown(source)),
        _ => None,
    }
}

/// First name of an encoding in a table.
fn name_of(table: &[(FrameEncoding, &[&'static str])], encoding: FrameEncoding) -> Option<&'static str> {
    table.iter().find(|(of, _)| *of == encoding)?.1.first().copied()
}

/// The encoding of any of its names in a table.
fn encoding_of(table: &[(FrameEncoding, &[&str])], name: &str) -> FrameEncoding {
    let row = table.iter().find(|(_, names)| names.contains(&name));
    row.map_or(FrameEncoding::Unknown, |(encoding, _)| *encoding)
}

fn image(frame: &FramePayload) -> (Schema, Vec<u8>) {
    let timestamp = Some(timestamp(frame.t_exposure));
    if let Some(encoding) = name_of(&RAW_ENCODINGS, frame.encoding) {
        let message = foxglove::RawImage {
            timestamp,
            frame_id: CAMERA_FRAME.into(),
            width: frame.width,
            height: frame.height,
            encoding: encoding.into(),
            step: frame.stride,
            data: frame.data.to_vec(),
        };
        return (Schema::RawImage, message.encode_to_vec());
    }
    let format = name_of(&COMPRESSED_ENCODINGS, frame.encoding).unwrap_or("unknown");
    let message = foxglove::CompressedImage {
        timestamp,
        frame_id: CAMERA_FRAME.into(),
        data: frame.data.to_vec(),
        format: format.into(),
    };
    (Schema::CompressedImage, message.encode_to_vec())
}

/// The frame of a message of either image schema.
fn to_frame(message: &KeptMessage<'_>, index: u32) -> Result<FramePayload, DecodeError> {
    if message.schema == Schema::RawImage.name() {
        let image = foxglove::RawImage::decode(message.data)?;
        return Ok(FramePayload {
            index,
            t_exposure: host_time(image.timestamp.as_ref()),
            encoding: encoding_of(&RAW_ENCODINGS, &image.encoding),
            width: image.width,
            height: image.height,
            stride: image.step,
            data: Arc::from(image.data),
        });
    }
    let image = foxglove::CompressedImage::decode(message.data)?;
    Ok(FramePayload {
        index,
        t_exposure: host_time(image.timestamp.as_ref()),
        encoding: encoding_of(&COMPRESSED_ENCODINGS, &image.format.to_ascii_lowercase()),
        width: 0,
        height: 0,
        stride: 0,
        data: Arc::from(image.data),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::msg::{WarmSite, WarmState};

    fn frame(encoding: FrameEncoding) -> FramePayload {
        let t_exposure = MonoTime::from_ns(5);
        let raw = name_of(&RAW_ENCODINGS, encoding).is_some();
        let size = if raw { 4 } else { 0 };
        FramePayload {
            index: 7,
            t_exposure,
            encoding,
            width: size,
            height: size,
            stride: size,
            data: Arc::from([1u8, 2, 3].as_slice()),
        }
    }

    /// One event of every kind, from every source.
    fn every_event() -> Vec<EventBody> {
        let site =
            WarmSite { datum: [1.0, 2.0, 3.0], ground_height_m: 3.0, geoid_m: 0.5, declination_rad: 0.1 };
        let mut all = vec![
            EventBody::Pulse,
            EventBody::Warm(Box::new(WarmState { site, arrivals: Vec::new(), filter: None })),
        ];
        for &source in Source::ALL {
            all.push(EventBody::Dropped { source, count: 3 });
            all.extend([EventBody::SourceUp(source), EventBody::SourceDown(source)]);
            match source.delivers() {
                Delivery::Bytes => all.push(EventBody::Bytes { source, data: vec![0, 255, 10] }),
                Delivery::Frames => {}
                Delivery::Inertial => {
                    all.extend([(true, true), (true, false), (false, true)].map(|(rate, force)| {
                        let three = |there: bool| there.then(|| Vector3::new(0.1, -2.0, 9.8));
                        let sample = InertialSample { rate_rps: three(rate), force_mps2: three(force) };
                        EventBody::Inertial { source, sample }
                    }))
                }
                Delivery::Attitude => {
                    let tilt = Some(Tilt { pitch: 0.1, roll: -0.2 });
                    let sample = AttitudeSample { heading: Some(1.5), heading_is_true: true, tilt };
                    all.push(EventBody::Attitude { source, sample });
                    all.push(EventBody::Attitude { source, sample: AttitudeSample { tilt: None, ..sample } });
                }
            }
        }
        let encodings = RAW_ENCODINGS.iter().chain(&COMPRESSED_ENCODINGS).map(|(encoding, _)| *encoding);
        all.extend(
            encodings.chain([FrameEncoding::Unknown]).map(|encoding| EventBody::Frame(frame(encoding))),
        );
        all
    }

    #[test]
    fn every_event_comes_back_from_its_message() {
        for body in every_event() {
            let event = Event { t_recv: MonoTime::from_ns(9), seq: 0, body };
            let record = of_event(&event).expect("all but ticks are recorded");
            assert!(is_event(&record.topic), "{}", record.topic);
            let kept = KeptMessage {
                topic: &record.topic,
                schema: record.schema.name(),
                frame_number: Some(7),
                data: &record.data,
            };
            let back = EventDecoder::default().body(&kept).expect("a message").expect("an event");
            assert_eq!(format!("{back:?}"), format!("{:?}", event.body));
        }
        let tick = Event { t_recv: MonoTime::from_ns(9), seq: 0, body: EventBody::Tick };
        assert!(of_event(&tick).is_none() && topic_of_event(&tick.body).is_none());
    }
}
