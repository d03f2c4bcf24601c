//! `[link]` and `[mavlink]`: the wireless link, and messages for other ground stations.

use serde::{Deserialize, Serialize};

use super::ConfigError;
use super::check::{refuse, within};

/// `[link]`: QUIC between the payload and its ground stations, both sides with certificates.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LinkConfig {
    /// Whether the payload opens the link.
    pub enabled: bool,
    /// Address and UDP port at which stations reach the payload, for example `[::]:7447`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listen: Option<String>,
    /// Stations to which the payload connects (`host:port`): for a payload behind a modem that cannot be reached from
    /// outside.
    pub dial: Vec<String>,
    /// Certificate of the authority that signed every payload and station (`windhover keys authority`).
    pub authority: String,
    /// Certificate of this payload (`windhover keys payload NAME`).
    pub certificate: String,
    /// Its private key; refused when others than its owner may read it.
    pub key: String,
    /// Revocation list of the authority; read again when it changes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub revoked: Option<String>,
    /// Highest rate of the link, kilobits a second over all stations, including UDP and IP headers; where absent, the
    /// link estimates the rate that the path carries.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ceiling_kbps: Option<f64>,
    /// Width of the camera's thumbnail, pixels; 0 sends none.
    pub thumbnail_width_px: u32,
    /// Least time between two thumbnails, seconds. They never delay an estimate.
    pub thumbnail_interval_s: f64,
    /// Memory for records that have not reached every station, megabytes; older records come from the store.
    pub backlog_mb: f64,
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            enabled: false,
            listen: None,
            dial: Vec::new(),
            authority: "/etc/windhover/keys/authority.pem".into(),
            certificate: "/etc/windhover/keys/payload.pem".into(),
            key: "/etc/windhover/keys/payload.key".into(),
            revoked: None,
            ceiling_kbps: None,
            thumbnail_width_px: 320,
            thumbnail_interval_s: 1.0,
            backlog_mb: 32.0,
        }
    }
}

/// The name that stands for the helicopter's autopilot, reached by the connection of `[autopilot]`.
pub const AUTOPILOT: &str = "autopilot";

/// `[mavlink]`: the vehicle as MAVLink 2 over UDP.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MavlinkConfig {
    /// Whether anything is sent.
    pub enabled: bool,
    /// Destinations (`host:port`, or "autopilot": the connection of `[autopilot]`); ground stations listen on UDP
    /// 14550.
    pub send_to: Vec<String>,
    /// System id of the first target; the others follow. Must differ from the helicopter's own.
    pub system_id: u8,
    /// System id of the helicopter's autopilot: messages of the helicopter's components (camera, landing target) have
    /// it.
    pub autopilot_id: u8,
    /// Messages that are sent for each target.
    pub messages: Vec<MavlinkMessage>,
    /// Axes of LANDING_TARGET.
    pub landing_frame: LandingFrame,
    /// Positions a second.
    pub rate_hz: f64,
    /// An older estimate is not sent, seconds.
    pub max_age_s: f64,
    /// A position with a larger one-sigma relative to the helicopter is not sent, metres.
    pub max_sigma_m: f64,
    /// How long a vehicle out of sight is predicted; then its positions stop, whatever `lost_after_s` is, seconds.
    pub coast_s: f64,
    /// File with the 32 bytes of a signing key in hexadecimal; messages are signed with it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub signing_key: Option<String>,
    /// Link id of the signature.
    pub signing_link_id: u8,
}

/// A message of a target.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum MavlinkMessage {
    /// Position and velocity: maps of ground stations.
    GlobalPositionInt,
    /// Heading and yaw rate: maps of ground stations.
    Attitude,
    /// Position, velocity, acceleration, heading: follow modes of ArduPilot and PX4.
    FollowTarget,
    /// Vector from the helicopter: ArduPilot's precision landing.
    LandingTarget,
    /// Vector from the helicopter with its errors: PX4's target estimator.
    TargetRelative,
    /// Position and motion with their errors: PX4's target estimator.
    TargetAbsolute,
    /// The tracked target on the ground: QGroundControl.
    CameraTrackingGeoStatus,
    /// The tracked target in the picture: QGroundControl.
    CameraTrackingImageStatus,
    /// Position and motion in the datum's frame.
    Odometry,
}

/// Axes of LANDING_TARGET.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LandingFrame {
    /// Of the helicopter's body: forward, right, down (MAV_FRAME_BODY_FRD).
    Body,
    /// Level, in the direction of its nose (MAV_FRAME_LOCAL_FRD).
    Local,
}

impl Default for MavlinkConfig {
    fn default() -> Self {
        Self {
            enabled: false,
            send_to: vec!["127.0.0.1:14550".into()],
            system_id: 42,
            autopilot_id: 1,
            messages: vec![
                MavlinkMessage::GlobalPositionInt,
                MavlinkMessage::Attitude,
                MavlinkMessage::FollowTarget,
            ],
            landing_frame: LandingFrame::Body,
            rate_hz: 10.0,
            max_age_s: 0.5,
            max_sigma_m: 2.0,
            coast_s: 1.0,
            signing_key: None,
            signing_link_id: 0,
        }
    }
}

/// `host:port`, the host not empty and the port a number that is not 0.
fn has_port(address: &str) -> bool {
    address
        .rsplit_once(':')
        .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok_and(|p| p > 0))
}

impl LinkConfig {
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        if let Some(listen) = &self.listen
            && listen.parse::<std::net::SocketAddr>().is_err()
        {
            refuse("link.listen", format!("{listen:?} is not ADDRESS:PORT, for example [::]:7447"))?;
        }
        for station in &self.dial {
            if !has_port(station) {
                refuse("link.dial", format!("{station:?} is not HOST:PORT"))?;
            }
        }
        if self.enabled && self.listen.is_none() && self.dial.is_empty() {
            refuse("link", "enabled, but neither listen nor dial is set, so no station can be reached")?;
        }
        if let Some(ceiling) = self.ceiling_kbps {
            within("link.ceiling_kbps", ceiling, 8.0, 1e6)?;
        }
        within("link.thumbnail_width_px", f64::from(self.thumbnail_width_px), 0.0, 1280.0)?;
        within("link.thumbnail_interval_s", self.thumbnail_interval_s, 0.05, 3_600.0)?;
        within("link.backlog_mb", self.backlog_mb, 1.0, 1_024.0)
    }
}

impl MavlinkConfig {
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        for address in &self.send_to {
            if address != AUTOPILOT && !has_port(address) {
                refuse(
                    "mavlink.send_to",
                    format!("{address:?} is not HOST:PORT, for example 10.0.0.5:14550"),
                )?;
            }
        }
        within("mavlink.system_id", f64::from(self.system_id), 1.0, 250.0)?;
        within("mavlink.autopilot_id", f64::from(self.autopilot_id), 1.0, 250.0)?;
        if self.autopilot_id == self.system_id {
            refuse("mavlink.system_id", "must differ from mavlink.autopilot_id, the helicopter's own")?;
        }
        within("mavlink.rate_hz", self.rate_hz, 0.1, 50.0)?;
        within("mavlink.max_age_s", self.max_age_s, 0.05, 10.0)?;
        within("mavlink.max_sigma_m", self.max_sigma_m, 0.01, 1_000.0)?;
        within("mavlink.coast_s", self.coast_s, 0.0, 60.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_that_nobody_can_reach_is_refused() {
        let link = LinkConfig { enabled: true, ..LinkConfig::default() };
        assert!(link.check().is_err());
        let listening = LinkConfig { listen: Some("[::]:7447".into()), ..link.clone() };
        assert!(listening.check().is_ok());
        let dialling = LinkConfig { dial: vec!["station.example:7447".into()], ..link };
        assert!(dialling.check().is_ok());
    }

    #[test]
    fn addresses_need_their_port() {
        for bad in ["", ":1", "host", "host:", "host:0", "host:99999"] {
            let link = LinkConfig { dial: vec![bad.into()], ..LinkConfig::default() };
            assert!(link.check().is_err(), "{bad:?}");
        }
    }

    #[test]
    fn absurd_figures_are_refused() {
        for ceiling in [0.0, f64::NAN, -5.0] {
            let link = LinkConfig { ceiling_kbps: Some(ceiling), ..LinkConfig::default() };
            assert!(link.check().is_err(), "{ceiling}");
        }
        let mavlink = MavlinkConfig { system_id: 0, ..MavlinkConfig::default() };
        assert!(mavlink.check().is_err());
    }
}
