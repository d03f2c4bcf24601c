//! MAVLink 2 over UDP: the vehicles as a ground station's map and ArduPilot's Follow mode want them.
//!
//! Written here rather than taken from the `mavlink` crate: four messages of fixed layout against a
//! dialect of hundreds that would have to be compiled. Only sends, unless a signing key is set: then
//! signed datagrams of stations are counted, and others refused.

pub mod messages;
pub mod packet;
mod stations;
mod vehicle;

pub use stations::{Found, Station, StationNews, look_up};

use std::path::{Path, PathBuf};

use crate::config::MavlinkConfig;
use crate::io::link::keys::{KeyError, read_private};
use windhover_base::geo::Geodetic;
use windhover_base::msg::{EstimatorOutput, Output, SensorReading, TargetState, TrackStatus};
use windhover_base::settings::{GroundConfig, TargetConfig};
use windhover_base::time::{MonoTime, Span, UtcTime};

use messages::VehicleMessages;
use packet::{Refused, Sender, SigningKey};
use stations::Stations;
use vehicle::{Limits, Said, Vehicle};

/// MAV_COMP_ID_AUTOPILOT1: ground stations draw vehicles for this component only.
const COMPONENT: u8 = 1;
/// Heartbeats, as the protocol wants them.
const HEARTBEAT_EVERY: Span = Span::from_ns(1_000_000_000);
/// A signature older than this is a replay (message signing guide: one minute).
const REPLAY_WINDOW: u64 = 6_000_000;

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

/// What came in.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct MavlinkCounts {
    /// Signed datagrams heard.
    pub heard: u64,
    /// Datagrams refused: unsigned, of another key, replayed, no MAVLink.
    pub refused: u64,
}

/// One target, and how far its system id has counted.
#[derive(Clone, Debug)]
struct System {
    vehicle: Vehicle,
    reference_m: f64,
    sequence: u8,
}

/// Sends the vehicles. Nothing here blocks.
pub struct MavlinkSender {
    stations: Stations,
    system_id: u8,
    systems: Vec<System>,
    limits: Limits,
    /// Time between two rounds of positions.
    period: Span,
    key: Option<(SigningKey, u8)>,
    elevation_msl_m: Option<f64>,
    datum: Option<Geodetic>,
    geoid_m: Option<f64>,
    utc_from_host_ns: Option<i64>,
    started: Option<MonoTime>,
    heartbeat: Option<MonoTime>,
    positions: Option<MonoTime>,
    stamp: u64,
    heard_stamp: u64,
    counts: MavlinkCounts,
}

impl MavlinkSender {
    /// As configured, for these targets over this ground.
    pub fn open(
        mavlink: &MavlinkConfig,
        targets: &[TargetConfig],
        ground: &GroundConfig,
    ) -> Result<Self, MavlinkError> {
        let key = match &mavlink.signing_key {
            Some(path) => {
                let path = Path::new(path);
                let text = read_private(path)?;
                let key = SigningKey::from_hex(&text).ok_or_else(|| MavlinkError::NotAKey(path.into()))?;
                Some((key, mavlink.signing_link_id))
            }
            None => None,
        };
        let system = |t: &TargetConfig| System {
            vehicle: Vehicle::default(),
            reference_m: t.reference_m,
            sequence: 0,
        };
        Ok(Self {
            stations: Stations::open(&mavlink.send_to).map_err(MavlinkError::Socket)?,
            system_id: mavlink.system_id,
            systems: targets.iter().map(system).collect(),
            limits: Limits {
                max_age: Span::from_s(mavlink.max_age_s),
                max_sigma_m: mavlink.max_sigma_m,
                coast: Span::from_s(mavlink.coast_s),
            },
            period: Span::from_s(1.0 / mavlink.rate_hz),
            key,
            elevation_msl_m: ground.elevation_msl_m,
            datum: None,
            geoid_m: None,
            utc_from_host_ns: None,
            started: None,
            heartbeat: None,
            positions: None,
            stamp: 0,
            heard_stamp: 0,
            counts: MavlinkCounts::default(),
        })
    }

    /// Takes what it needs of the pipeline's outputs.
    pub fn output(&mut self, output: &Output) {
        match output {
            Output::Estimator(EstimatorOutput::Estimate(estimate) | EstimatorOutput::Coasted(estimate)) => {
                if let Some(system) = self.systems.get_mut(estimate.target) {
                    system.vehicle.take(estimate);
                }
            }
            Output::Datum(_, datum) => self.datum = Some(*datum),
            Output::Reading(SensorReading::Gnss(fix)) => {
                self.geoid_m = fix.value.geoid_m.or(self.geoid_m);
                if let Some(utc) = fix.value.utc {
                    self.utc_from_host_ns = Some(utc.unix_ns() - fix.t_valid.ns());
                }
            }
            _ => {}
        }
    }

    /// What came in so far.
    pub fn counts(&self) -> MavlinkCounts {
        self.counts
    }

    /// Where it goes, and how that goes.
    pub fn stations(&self) -> &[Station] {
        self.stations.all()
    }

    /// What became of stations since this was last asked.
    pub fn news(&mut self) -> Vec<StationNews> {
        self.stations.news()
    }

    /// Names of stations that are to be looked up at `now`.
    pub fn unresolved(&mut self, now: MonoTime) -> Option<Vec<String>> {
        self.stations.unresolved(now)
    }

    /// Takes what names were found to be.
    pub fn found(&mut self, found: Vec<Found>) {
        self.stations.found(found);
    }

    /// How often [`Self::send`] is to be called: at the rate of positions, and at that of heartbeats at least.
    pub fn every(&self) -> Span {
        self.period.min(HEARTBEAT_EVERY)
    }

    /// Altitude of the ground under a vehicle above mean sea level: of level ground as configured, else by the geoid,
    /// higher or lower by what the terrain is there. Where the receiver tells no geoid, the height above the ellipsoid
    /// stands in.
    fn ground_msl_m(&self, state: &TargetState) -> Option<f64> {
        let datum = self.datum?;
        let level = self.elevation_msl_m.unwrap_or_else(|| datum.height_m - self.geoid_m.unwrap_or(0.0));
        Some(level + state.height_m - datum.height_m)
    }

    /// Sends heartbeats once a second, and the state of every vehicle of which something may be said
    /// (`vehicle.rs`); call it as often as [`Self::every`] says. Signed messages wait until the receiver told UTC,
    /// for signatures carry the time.
    pub fn send(&mut self, now: MonoTime) {
        let utc = self.utc_from_host_ns.map(|ahead| UtcTime::from_unix_ns(now.ns().saturating_add(ahead)));
        let started = *self.started.get_or_insert(now);
        self.listen(utc);
        if self.key.is_some() && utc.is_none() {
            return;
        }
        // A round that comes a little early is this one's all the same.
        let early = Span::from_s(0.5 * self.every().s());
        let due = |last: Option<MonoTime>, period| last.is_none_or(|last| now - last + early >= period);
        let (beat, positions) = (due(self.heartbeat, HEARTBEAT_EVERY), due(self.positions, self.period));
        for index in 0..self.systems.len() {
            let said = self.systems[index].vehicle.said(now, &self.limits);
            if beat {
                self.put(index, messages::HEARTBEAT, &messages::heartbeat(status(&said)), utc);
            }
            if let Said::Seen(t, state) | Said::Predicted(t, state) = said
                && positions
            {
                self.put_state(index, messages::since_start_ms(started, t), &state, utc);
            }
        }
        self.heartbeat = if beat { Some(now) } else { self.heartbeat };
        self.positions = if positions { Some(now) } else { self.positions };
    }

    fn put_state(&mut self, index: usize, time_boot_ms: u64, state: &TargetState, utc: Option<UtcTime>) {
        let Some(alt_msl_m) = self.ground_msl_m(state) else { return };
        let reference_m = self.systems[index].reference_m;
        let vehicle = VehicleMessages { time_boot_ms, state: *state, alt_msl_m, reference_m };
        if !vehicle.is_finite() {
            return;
        }
        self.put(index, messages::GLOBAL_POSITION_INT, &vehicle.global_position_int(), utc);
        self.put(index, messages::ATTITUDE, &vehicle.attitude(), utc);
        self.put(index, messages::FOLLOW_TARGET, &vehicle.follow_target(), utc);
    }

    /// Sends a message of a target to every station.
    fn put(&mut self, index: usize, kind: packet::Kind, payload: &[u8], utc: Option<UtcTime>) {
        let system = self.system_id.saturating_add(u8::try_from(index).unwrap_or(u8::MAX));
        let sender = Sender { system, component: COMPONENT };
        let sequence = &mut self.systems[index].sequence;
        let mut bytes = packet::encode(*sequence, sender, kind, payload, self.key.is_some());
        *sequence = sequence.wrapping_add(1);
        if let (Some((key, link_id)), Some(utc)) = (&self.key, utc) {
            // Never the same or an earlier stamp, whatever the clock does.
            self.stamp = packet::time_stamp(utc).max(self.stamp + 1);
            packet::sign(&mut bytes, key, *link_id, self.stamp);
        }
        self.stations.send(&bytes);
    }

    /// Empties the sockets: without a key nothing is even looked at.
    fn listen(&mut self, utc: Option<UtcTime>) {
        let mut buffer = [0; 512];
        for _ in 0..64 {
            let Some(length) = self.stations.receive(&mut buffer) else { return };
            let Some((key, _)) = &self.key else { continue };
            let verdict = packet::verify(&buffer[..length], key).and_then(|(_, _, stamp)| {
                let now = utc.map_or(0, packet::time_stamp);
                let fresh = stamp > self.heard_stamp && stamp.saturating_add(REPLAY_WINDOW) > now;
                if fresh { Ok(stamp) } else { Err(Refused::Replayed) }
            });
            match verdict {
                Ok(stamp) => {
                    self.heard_stamp = stamp;
                    self.counts.heard += 1;
                }
                Err(_) => self.counts.refused += 1,
            }
        }
    }
}

/// The track that a heartbeat tells: it is active while positions of a vehicle in sight go out, critical while
/// predicted ones do, and on standby where none do.
fn status(said: &Said) -> TrackStatus {
    match said {
        Said::Seen(..) => TrackStatus::Tracking,
        Said::Predicted(..) => TrackStatus::Coasting,
        Said::Nothing => TrackStatus::Lost,
    }
}

#[cfg(test)]
mod tests;
