//! A flight read into memory for evaluation: everything except the pictures.

use std::collections::BTreeMap;
use std::path::Path;

use prost::Message;
use prost_types::Timestamp;

use super::refine::RefinedBeside;
use crate::config::Config;
use crate::io::capture::{CaptureReader, attached_config};
use crate::io::mcap_read::{RawMessage, ReadError};
use crate::io::proto::{foxglove as fox, host_time, windhover as wh};
use crate::io::records::topic;
use windhover_base::geo::Geodetic;
use windhover_base::msg::{EventBody, FramePayload};
use windhover_base::time::{MonoTime, UtcTime};

/// The estimates of one target.
#[derive(Clone, Debug, Default)]
pub struct Track {
    /// In real time, one for each frame.
    pub filtered: Vec<wh::TargetState>,
    /// From the fixed-lag smoother.
    pub smoothed: Vec<wh::TargetState>,
    /// By the paper's method.
    pub paper: Vec<wh::TargetState>,
    /// From the refinement of the whole flight.
    pub refined: Vec<wh::TargetState>,
}

/// A frame's arrival.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FrameArrival {
    /// When it was dequeued.
    pub t_recv: MonoTime,
    /// When it was exposed.
    pub t_exposure: MonoTime,
    /// Its size in the recording.
    pub bytes: usize,
}

/// Most targets that are kept: a configuration has at most half as many.
const TARGETS: usize = 64;

/// A flight.
#[derive(Clone, Debug, Default)]
pub struct Flight {
    /// Name of its file or directory.
    pub name: String,
    /// The configuration it was flown or replayed with, as text.
    pub config_text: Option<String>,
    /// The same, parsed.
    pub config: Option<Config>,
    /// Log time of the first message.
    pub began: MonoTime,
    /// Log time of the last message.
    pub ended: MonoTime,
    /// UTC of the first epoch that had a date.
    pub utc: Option<UtcTime>,
    /// Damage that was found.
    pub warnings: Vec<String>,
    /// Origin of the NED frame.
    pub datum: Option<Geodetic>,
    /// Targets by name.
    pub targets: BTreeMap<String, Track>,
    /// The helicopter's own state, at frames and between them, in order of time.
    pub ownship: Vec<wh::Ownship>,
    /// The same from the refinement of the whole flight.
    pub ownship_refined: Vec<wh::Ownship>,
    /// What a refinement found about the configuration.
    pub refined: Option<wh::Refined>,
    /// GPS epochs.
    pub epochs: Vec<wh::GnssEpoch>,
    /// Compass samples.
    pub attitudes: Vec<wh::Attitude>,
    /// The detections of each frame.
    pub detections: Vec<wh::Detections>,
    /// What was done with each measurement.
    pub fusion: Vec<wh::Fusion>,
    /// Health, once a second.
    pub health: Vec<wh::Health>,
    /// Operator's notices.
    pub notices: Vec<fox::Log>,
    /// Losses, and devices that appeared and disappeared.
    pub source_events: Vec<wh::SourceEvent>,
    /// Number of reads of bytes, from all sources.
    pub reads: usize,
    /// Frames, in the order of their numbers.
    pub frames: Vec<FrameArrival>,
}

impl Flight {
    /// Reads a capture or flight: a file, or a directory of segments.
    pub fn read(path: &Path) -> Result<Self, ReadError> {
        let mut flight = Self { name: name_of(path), ..Self::default() };
        flight.config_text = attached_config(path)?;
        flight.config = flight.config_text.as_deref().and_then(|text| Config::parse(text).ok());
        let mut reader = CaptureReader::open(path)?;
        let mut first = true;
        for item in reader.by_ref() {
            let t = item.raw.log_time;
            if first {
                (flight.began, first) = (t, false);
            }
            flight.ended = flight.ended.max(t);
            match item.event.map(|event| event.body) {
                Some(EventBody::Bytes { .. }) => flight.reads += 1,
                Some(EventBody::Frame(frame)) => flight.frames.push(FrameArrival {
                    t_recv: t,
                    t_exposure: frame.t_exposure,
                    bytes: frame.data.len(),
                }),
                _ => flight.take(&item.raw),
            }
        }
        flight.warnings.extend(reader.take_warnings());
        let mut beside = RefinedBeside::of(path);
        flight.warnings.extend(beside.warning.take());
        beside.for_each(|raw| flight.take(&raw));
        flight.ownship.sort_by_key(|own| host_time(own.timestamp.as_ref()));
        flight.utc = flight.epochs.iter().find_map(|e| e.utc_ns).map(UtcTime::from_unix_ns);
        Ok(flight)
    }

    fn take(&mut self, raw: &RawMessage) {
        match raw.channel.topic.as_str() {
            topic::OWNSHIP => {
                keep(&mut self.ownship, raw);
                self.ownship.pop_if(|own| !own.is_sound());
            }
            topic::OWNSHIP_REFINED => {
                keep(&mut self.ownship_refined, raw);
                self.ownship_refined.pop_if(|own| !own.is_sound());
            }
            topic::REFINED => self.refined = wh::Refined::decode(&raw.data[..]).ok().or(self.refined.take()),
            topic::GPS_EPOCH => keep(&mut self.epochs, raw),
            topic::COMPASS_ATTITUDE => keep(&mut self.attitudes, raw),
            topic::CAMERA_DETECTIONS => keep(&mut self.detections, raw),
            topic::FUSION => keep(&mut self.fusion, raw),
            topic::HEALTH => keep(&mut self.health, raw),
            topic::LOG => keep(&mut self.notices, raw),
            topic::SOURCE_EVENT => keep(&mut self.source_events, raw),
            topic::DATUM => {
                if let Some(d) = wh::Datum::decode(&raw.data[..]).ok().filter(wh::Datum::is_sound) {
                    self.datum =
                        Some(Geodetic { lat_deg: d.lat_deg, lon_deg: d.lon_deg, height_m: d.height_m });
                }
            }
            other => self.take_target(other, raw),
        }
    }

    fn take_target(&mut self, topic: &str, raw: &RawMessage) {
        let Some((name, what)) = topic.strip_prefix("/target/").and_then(|rest| rest.rsplit_once('/')) else {
            return;
        };
        let wanted = matches!(what, "state" | "smoothed" | "paper" | "refined");
        if !wanted {
            return;
        }
        if self.targets.len() >= TARGETS && !self.targets.contains_key(name) {
            let words = format!("there are more than {TARGETS} targets: the others are left out");
            if !self.warnings.contains(&words) {
                self.warnings.push(words);
            }
            return;
        }
        let track = self.targets.entry(name.to_owned()).or_default();
        let states = match what {
            "state" => &mut track.filtered,
            "smoothed" => &mut track.smoothed,
            "refined" => &mut track.refined,
            _ => &mut track.paper,
        };
        keep(states, raw);
        states.pop_if(|state| !state.is_sound());
    }

    /// Whether frames were received, stored or not.
    pub fn had_frames(&self) -> bool {
        !self.frames.is_empty() || !self.detections.is_empty()
    }

    /// Seconds from the start.
    pub fn seconds(&self, t: MonoTime) -> f64 {
        (t - self.began).s()
    }

    /// The same for a message's time.
    pub fn at(&self, t: Option<&Timestamp>) -> f64 {
        self.seconds(host_time(t))
    }

    /// Its length, seconds.
    pub fn duration_s(&self) -> f64 {
        (self.ended - self.began).s()
    }
}

fn keep<M: Message + Default>(list: &mut Vec<M>, raw: &RawMessage) {
    // A message that cannot be decoded is of another version; the reader reports damage.
    list.extend(M::decode(&raw.data[..]).ok());
}

fn name_of(path: &Path) -> String {
    path.file_stem().map_or_else(|| path.display().to_string(), |stem| stem.to_string_lossy().into_owned())
}

/// Calls `each` for the frames with these numbers (ascending), in order.
pub fn frames(path: &Path, numbers: &[u32], mut each: impl FnMut(&FramePayload)) -> Result<(), ReadError> {
    let Some(last) = numbers.last() else { return Ok(()) };
    for item in CaptureReader::open(path)? {
        if let Some(EventBody::Frame(frame)) = item.event.map(|event| event.body) {
            if numbers.binary_search(&frame.index).is_ok() {
                each(&frame);
            }
            if frame.index >= *last {
                break;
            }
        }
    }
    Ok(())
}
