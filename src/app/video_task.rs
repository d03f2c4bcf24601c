//! The video's thread: frames to H.264 with their metadata, to the network and into the flight. Frames that arrive while
//! it is busy are left out; nothing waits for it.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::Duration;

use prost::Message as _;

use super::context::TaskContext;
use super::events::OperatorEvent;
use super::film::{Film, Known};
use super::flight_store::FlightStore;
use super::sinks::VideoQueue;
use super::supervise::Heartbeat;
use crate::config::Config;
use crate::io::process;
use crate::io::proto::{foxglove::CompressedVideo, timestamp};
use crate::io::records::{Record, Schema, topic};
use crate::io::video::StreamSender;
use windhover_base::msg::FramePayload;
use windhover_base::time::MonoTime;

/// Longest wait for a frame.
const ROUND: Duration = Duration::from_millis(250);
/// The thread yields to all others of the program.
const NICE: i32 = 10;
/// The flight has no name yet when its film begins.
const MISSION: &str = "windhover";

/// Inputs of the thread.
pub struct VideoTask {
    /// The configuration.
    pub config: Arc<Config>,
    /// The context of every task.
    pub context: TaskContext,
    /// Where frames come from.
    pub queue: VideoQueue,
    /// Where they are recorded.
    pub flight_store: FlightStore,
    /// Its heartbeat.
    pub heartbeat: Heartbeat,
}

/// Makes the film on the calling thread until the end is asked for.
pub fn run(task: VideoTask) {
    let VideoTask { config, context, queue, flight_store, heartbeat } = task;
    process::be_nice(NICE);
    let known = Known::new(&config.target);
    let mut film = Film::new(MISSION.into(), Some(config.camera.clone()), Some(config.video.rate_hz), known);
    let mut sender = None;
    while !context.stop.is_cancelled() {
        heartbeat.beat();
        let Some((frame, records)) = queue.take(ROUND) else { continue };
        for record in records {
            film.known.message(&record.topic, &record.data);
        }
        let made = film.frame(&frame);
        film.known.forget(frame.index);
        match made {
            Ok(Some(made)) => {
                if config.video.record
                    && let Some(store) = flight_store.get()
                {
                    store.record(Arc::new(record(&frame, made.unit, context.clock.now())), None);
                }
                send(&config, &mut sender, &made.ts);
            }
            Ok(None) => {}
            Err(error) => OperatorEvent::LinkFault.emit("video", error),
        }
    }
}

fn send(config: &Config, sender: &mut Option<StreamSender>, packets: &[u8]) {
    if sender.is_none() {
        match StreamSender::new(&config.video.send_to) {
            Ok(opened) => *sender = Some(opened),
            Err(error) => OperatorEvent::LinkFault.emit("video", format!("no socket: {error}")),
        }
    }
    if let Some(Err((address, error))) = sender.as_ref().map(|sender| sender.send(packets)) {
        OperatorEvent::LinkFault.emit("video", format!("cannot send to {address}: {error}"));
    }
}

/// A picture as the flight has it.
fn record(frame: &FramePayload, unit: Vec<u8>, now: MonoTime) -> Record {
    let video = CompressedVideo {
        timestamp: Some(timestamp(frame.t_exposure)),
        frame_id: "camera".into(),
        data: unit,
        format: "h264".into(),
    };
    Record {
        topic: Cow::Borrowed(topic::CAMERA_VIDEO),
        schema: Schema::CompressedVideo,
        log_time: now,
        publish_time: frame.t_exposure,
        data: video.encode_to_vec(),
    }
}
