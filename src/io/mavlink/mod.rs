//! MAVLink 2 over UDP: the vehicles as a ground station's map and ArduPilot's Follow mode want them.
//!
//! Written here rather than taken from the `mavlink` crate: four messages of fixed layout against a
//! dialect of hundreds that would have to be compiled. Only sends, unless a signing key is set: then
//! signed datagrams of stations are counted, and others refused.

pub mod messages;
pub mod packet;

use std::net::{SocketAddr, ToSocketAddrs as _, UdpSocket};
use std::path::{Path, PathBuf};

use crate::config::MavlinkConfig;
use crate::io::link::keys::{KeyError, read_private};
use windhover_base::geo::Geodetic;
use windhover_base::msg::{EstimatorOutput, Output, SensorReading, TargetEstimate, TrackStatus};
use windhover_base::settings::{GroundConfig, TargetConfig};
use windhover_base::time::{MonoTime, Span, UtcTime};

use messages::VehicleMessages;
use packet::{Refused, Sender, SigningKey};

/// MAV_COMP_ID_AUTOPILOT1: ground stations draw vehicles for this component only.
const COMPONENT: u8 = 1;
/// Heartbeats, as the protocol wants them.
const HEARTBEAT_EVERY: Span = Span::from_ns(1_000_000_000);
/// Names of stations are looked up again after this long where that failed.
const RESOLVE_EVERY: Span = Span::from_ns(10_000_000_000);
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

/// Counts for the health line.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct MavlinkCounts {
    /// Datagrams sent.
    pub sent: u64,
    /// Datagrams the system would not take.
    pub failed: u64,
    /// Signed datagrams heard.
    pub heard: u64,
    /// Datagrams refused: unsigned, of another key, replayed, no MAVLink.
    pub refused: u64,
}

/// IPv4 addresses of stations by their names. Blocks while they are looked up.
pub fn look_up(names: &[String]) -> Vec<SocketAddr> {
    let v4 = |name: &String| name.to_socket_addrs().ok()?.find(SocketAddr::is_ipv4);
    names.iter().filter_map(v4).collect()
}

/// Sends the vehicles. Nothing here blocks.
pub struct MavlinkSender {
    socket: UdpSocket,
    names: Vec<String>,
    addresses: Vec<SocketAddr>,
    resolved: Option<MonoTime>,
    system_id: u8,
    references_m: Vec<f64>,
    key: Option<(SigningKey, u8)>,
    elevation_msl_m: Option<f64>,
    datum: Option<Geodetic>,
    geoid_m: Option<f64>,
    latest: Vec<Option<TargetEstimate>>,
    utc_from_host_ns: Option<i64>,
    started: Option<MonoTime>,
    heartbeat: Option<MonoTime>,
    sequence: u8,
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
        let socket = UdpSocket::bind("0.0.0.0:0").map_err(MavlinkError::Socket)?;
        socket.set_nonblocking(true).map_err(MavlinkError::Socket)?;
        let key = match &mavlink.signing_key {
            Some(path) => {
                let path = Path::new(path);
                let text = read_private(path)?;
                let key = SigningKey::from_hex(&text).ok_or_else(|| MavlinkError::NotAKey(path.into()))?;
                Some((key, mavlink.signing_link_id))
            }
            None => None,
        };
        Ok(Self {
            socket,
            names: mavlink.send_to.clone(),
            addresses: Vec::new(),
            resolved: None,
            system_id: mavlink.system_id,
            references_m: targets.iter().map(|t| t.reference_m).collect(),
            key,
            elevation_msl_m: ground.elevation_msl_m,
            datum: None,
            geoid_m: None,
            latest: vec![None; targets.len()],
            utc_from_host_ns: None,
            started: None,
            heartbeat: None,
            sequence: 0,
            stamp: 0,
            heard_stamp: 0,
            counts: MavlinkCounts::default(),
        })
    }

    /// Takes what it needs of the pipeline's outputs.
    pub fn output(&mut self, output: &Output) {
        match output {
            Output::Estimator(EstimatorOutput::Estimate(estimate)) => {
                if let Some(latest) = self.latest.get_mut(estimate.target) {
                    *latest = Some(*estimate);
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

    /// Counts so far.
    pub fn counts(&self) -> MavlinkCounts {
        self.counts
    }

    /// Altitude of level ground above mean sea level: as configured, else from datum and geoid. Where the
    /// receiver tells no geoid, the height above the ellipsoid stands in.
    fn ground_msl_m(&self) -> Option<f64> {
        let of_datum = || self.datum.map(|datum| datum.height_m - self.geoid_m.unwrap_or(0.0));
        self.elevation_msl_m.or_else(of_datum)
    }

    /// Sends heartbeats once a second and the state of every vehicle that is known; call it at the
    /// configured rate. Signed messages wait until the receiver told UTC, for signatures carry the time.
    pub fn send(&mut self, now: MonoTime) {
        let utc = self.utc_from_host_ns.map(|ahead| UtcTime::from_unix_ns(now.ns().saturating_add(ahead)));
        let started = *self.started.get_or_insert(now);
        self.listen(utc);
        if self.key.is_some() && utc.is_none() {
            return;
        }
        let beat = self.heartbeat.is_none_or(|last| now - last >= HEARTBEAT_EVERY);
        if beat {
            self.heartbeat = Some(now);
        }
        for index in 0..self.latest.len() {
            let system = self.system_id.saturating_add(u8::try_from(index).unwrap_or(u8::MAX));
            let latest = self.latest[index];
            let status = latest.map_or(TrackStatus::Lost, |estimate| estimate.status);
            if beat {
                self.put(system, messages::HEARTBEAT, &messages::heartbeat(status), utc);
            }
            let (Some(alt_msl_m), Some(TargetEstimate { t_valid, state: Some(state), .. })) =
                (self.ground_msl_m(), latest)
            else {
                continue;
            };
            let time_boot_ms = messages::since_start_ms(started, t_valid);
            let vehicle =
                VehicleMessages { time_boot_ms, state, alt_msl_m, reference_m: self.references_m[index] };
            if status == TrackStatus::Lost || !vehicle.is_finite() {
                continue;
            }
            self.put(system, messages::GLOBAL_POSITION_INT, &vehicle.global_position_int(), utc);
            self.put(system, messages::ATTITUDE, &vehicle.attitude(), utc);
            self.put(system, messages::FOLLOW_TARGET, &vehicle.follow_target(), utc);
        }
    }

    fn put(&mut self, system: u8, kind: packet::Kind, payload: &[u8], utc: Option<UtcTime>) {
        let sender = Sender { system, component: COMPONENT };
        let mut bytes = packet::encode(self.sequence, sender, kind, payload, self.key.is_some());
        self.sequence = self.sequence.wrapping_add(1);
        if let (Some((key, link_id)), Some(utc)) = (&self.key, utc) {
            // Never the same or an earlier stamp, whatever the clock does.
            self.stamp = packet::time_stamp(utc).max(self.stamp + 1);
            packet::sign(&mut bytes, key, *link_id, self.stamp);
        }
        for address in &self.addresses {
            match self.socket.send_to(&bytes, address) {
                Ok(_) => self.counts.sent += 1,
                Err(_) => self.counts.failed += 1,
            }
        }
    }

    /// Names of stations that are to be looked up at `now`: all, until each has an address.
    pub fn unresolved(&mut self, now: MonoTime) -> Option<Vec<String>> {
        let whole = self.addresses.len() == self.names.len();
        if whole || self.resolved.is_some_and(|last| now - last < RESOLVE_EVERY) {
            return None;
        }
        self.resolved = Some(now);
        Some(self.names.clone())
    }

    /// Sends to these addresses from now on.
    pub fn send_to(&mut self, addresses: Vec<SocketAddr>) {
        self.addresses = addresses;
    }

    /// Empties the socket: without a key nothing is even looked at.
    fn listen(&mut self, utc: Option<UtcTime>) {
        let mut buffer = [0; 512];
        for _ in 0..64 {
            let Ok((length, _)) = self.socket.recv_from(&mut buffer) else { return };
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
