//! `[video]`: the camera's picture with its metadata, live.

use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

use super::ConfigError;
use super::check::{refuse, within};

/// `[video]`: H.264 in an MPEG transport stream with KLV (MISB ST 0601, 0903, 0604). Off where it is neither sent nor
/// recorded.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VideoConfig {
    /// Where the stream is sent by UDP (address and port); nowhere where empty.
    pub send_to: Vec<SocketAddr>,
    /// Whether the pictures are recorded in the flight, on `/camera/video`.
    pub record: bool,
    /// Most pictures a second; others of the camera's frames are left out.
    pub rate_hz: f64,
}

impl Default for VideoConfig {
    fn default() -> Self {
        Self { send_to: Vec::new(), record: false, rate_hz: 15.0 }
    }
}

impl VideoConfig {
    /// Whether anything is made.
    pub fn is_on(&self) -> bool {
        self.record || !self.send_to.is_empty()
    }

    pub(super) fn check(&self) -> Result<(), ConfigError> {
        if let Some(address) = self.send_to.iter().find(|a| a.port() == 0 || a.ip().is_unspecified()) {
            refuse("video.send_to", format!("{address} is nowhere; give an address and a port"))?;
        }
        if self.send_to.len() > 8 {
            refuse("video.send_to", "has more than 8 addresses; use one of multicast")?;
        }
        within("video.rate_hz", self.rate_hz, 0.1, 120.0)
    }
}
