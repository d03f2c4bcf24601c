//! MAVLink 2 over UDP: the vehicles for ground stations, and for autopilots that follow or land.
//!
//! [`MavlinkEncoder`] makes the frames from the pipeline's outputs, [`MavlinkSender`] sends them. Received frames are checked
//! for three things: commands to the camera, other systems with our ids, and signatures where a key is set.

mod camera;
pub mod companion;
mod helicopter;
pub mod messages;
mod motion;
pub mod packet;
mod stations;
mod encoder;
mod report;
mod vehicle;

pub use encoder::MavlinkEncoder;
pub use stations::{Found, Station, StationChange, look_up};

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use crate::config::Config;
use crate::io::autopilot::ToAutopilot;
use crate::io::link::keys::{KeyError, read_private};
use windhover_base::msg::Output;
use windhover_base::time::{MonoTime, Span, UtcTime};
use windhover_decode::{MavlinkFrame, MavlinkFrames};

use packet::{Refused, Sender, SigningKey};
use stations::Stations;

/// A signature older than this is a replay (message signing guide: one minute).
const REPLAY_WINDOW: u64 = 6_000_000;
/// After another system was received under a target's id, nothing is sent of the target for this time.
const STANDS_BACK: Span = Span::from_ns(10_000_000_000);
/// Number of sent frames that are remembered, to recognise them when a router returns them.
const OWN_FRAMES: usize = 512;

/// Why MAVLink could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum MavlinkError {
    /// No UDP socket.
    #[error("mavlink: cannot open a UDP socket: {0}")]
    Socket(std::io::Error),
    /// The signing key's file is not usable.
    #[error("mavlink: {0}")]
    Key(#[from] KeyError),
    /// The signing key is not a key.
    #[error("mavlink: {} must hold 64 hexadecimal digits (32 bytes)", .0.display())]
    NotAKey(PathBuf),
}

/// Counts of received frames.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct MavlinkCounts {
    /// Frames received, with a valid signature where a key is set.
    pub received: u64,
    /// Datagrams refused where a key is set: unsigned, of another key, replayed, not MAVLink.
    pub refused: u64,
    /// Frames of other systems under one of our system ids.
    pub foreign: u64,
}

impl MavlinkCounts {
    /// As text, where any frame was refused or foreign.
    pub fn words(&self) -> Option<String> {
        let Self { received, refused, foreign } = self;
        (refused + foreign > 0)
            .then(|| format!("{received} received, {refused} refused, {foreign} under our ids"))
    }
}

/// Sends the vehicles. No call blocks.
pub struct MavlinkSender {
    encoder: MavlinkEncoder,
    stations: Stations,
    targets: usize,
    key: Option<SigningKey>,
    last_stamp: u64,
    /// Checksums of recently sent frames.
    sent: VecDeque<u32>,
    frames: Vec<Vec<u8>>,
    counts: MavlinkCounts,
    news: Vec<StationChange>,
}

/// The configured signing key, if any. Reads a file.
pub fn signing_key(path: Option<&str>) -> Result<Option<SigningKey>, MavlinkError> {
    let Some(path) = path.map(Path::new) else { return Ok(None) };
    let text = read_private(path)?;
    SigningKey::from_hex(&text).map(Some).ok_or_else(|| MavlinkError::NotAKey(path.into()))
}

impl MavlinkSender {
    /// A sender for this configuration; frames for the autopilot use its own connection.
    pub fn open(config: &Config, to_autopilot: ToAutopilot) -> Result<Self, MavlinkError> {
        let mavlink = &config.mavlink;
        let key = signing_key(mavlink.signing_key.as_deref())?;
        Ok(Self {
            stations: Stations::open(&mavlink.send_to, to_autopilot).map_err(MavlinkError::Socket)?,
            encoder: MavlinkEncoder::new(
                mavlink,
                &config.target,
                &config.ground,
                &config.camera,
                key.clone(),
            ),
            targets: config.target.len(),
            key,
            last_stamp: 0,
            sent: VecDeque::with_capacity(OWN_FRAMES),
            frames: Vec::new(),
            counts: MavlinkCounts::default(),
            news: Vec::new(),
        })
    }

    /// Takes the outputs that it needs.
    pub fn output(&mut self, output: &Output) {
        self.encoder.output(output);
    }

    /// Counts of received frames so far.
    pub fn counts(&self) -> MavlinkCounts {
        self.counts
    }

    /// The stations with the state of sending to them.
    pub fn stations(&self) -> &[Station] {
        self.stations.all()
    }

    /// Changes of stations since the last call.
    pub fn news(&mut self) -> Vec<StationChange> {
        let mut news = std::mem::take(&mut self.news);
        news.extend(self.stations.news());
        news
    }

    /// Names of stations that are to be resolved at `now`.
    pub fn unresolved(&mut self, now: MonoTime) -> Option<Vec<String>> {
        self.stations.unresolved(now)
    }

    /// Takes the results of name resolution.
    pub fn found(&mut self, found: Vec<Found>) {
        self.stations.found(found);
    }

    /// Period for calls of [`Self::send`].
    pub fn every(&self) -> Span {
        self.encoder.every()
    }

    /// Handles received frames and sends what is due.
    pub fn send(&mut self, now: MonoTime) {
        let mut frames = std::mem::take(&mut self.frames);
        self.listen(now, &mut frames);
        self.encoder.tell(now, &mut frames);
        for frame in frames.drain(..) {
            if self.sent.len() == OWN_FRAMES {
                self.sent.pop_front();
            }
            self.sent.push_back(crc32fast::hash(&frame));
            self.stations.send(&frame);
        }
        self.frames = frames;
    }

    /// Reads the sockets until they are empty.
    fn listen(&mut self, now: MonoTime, answers: &mut Vec<Vec<u8>>) {
        let utc = self.encoder.utc(now);
        let mut buffer = [0; 2048];
        for _ in 0..64 {
            let Some(length) = self.stations.receive(&mut buffer) else { return };
            self.datagram(&buffer[..length], now, utc, answers);
        }
    }

    fn datagram(&mut self, bytes: &[u8], now: MonoTime, utc: Option<UtcTime>, answers: &mut Vec<Vec<u8>>) {
        if let Some(key) = &self.key {
            let verdict = packet::verify(bytes, key).and_then(|(_, _, stamp)| {
                let now = utc.map_or(0, packet::time_stamp);
                let fresh = stamp > self.last_stamp && stamp.saturating_add(REPLAY_WINDOW) > now;
                if fresh { Ok(stamp) } else { Err(Refused::Replayed) }
            });
            match verdict {
                Ok(stamp) => self.last_stamp = stamp,
                Err(_) => {
                    self.counts.refused += 1;
                    return;
                }
            }
        }
        if self.sent.contains(&crc32fast::hash(bytes)) {
            return;
        }
        let mut frames = Vec::new();
        MavlinkFrames::default().push(bytes, &mut frames);
        for frame in frames {
            self.counts.received += 1;
            self.frame(&frame, now, answers);
        }
    }

    fn frame(&mut self, frame: &MavlinkFrame, now: MonoTime, answers: &mut Vec<Vec<u8>>) {
        if let Some(index) = (0..self.targets).find(|&k| self.encoder.system_id(k) == frame.system) {
            self.counts.foreign += 1;
            self.encoder.stand_back(index, now + STANDS_BACK);
            let fault = format!(
                "another system uses id {}: its target is not sent for {:.0} s; set mavlink.system_id",
                frame.system,
                STANDS_BACK.s()
            );
            let name = format!("system {}", frame.system);
            self.news.push(StationChange { name, fault: Some(fault) });
        }
        let from = Sender { system: frame.system, component: frame.component };
        self.encoder.asked(from, &frame.message, now, answers);
    }
}

#[cfg(test)]
mod tests;
