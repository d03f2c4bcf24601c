//! `[autopilot]`: the helicopter's own autopilot, heard over MAVLink.

use serde::{Deserialize, Serialize};

/// `[autopilot]`
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AutopilotConfig {
    /// Serial device that its telemetry comes over.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub device: Option<String>,
    /// Line speed, bits a second.
    pub baud: u32,
    /// UDP address at which it is heard instead, `udp://ADDRESS:PORT`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listen: Option<String>,
    /// What of it goes into the filter. Its position and its clock are used for what is sent to it in any case.
    #[serde(rename = "use")]
    pub uses: Vec<AutopilotUse>,
    /// Its system id; the first autopilot heard where absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub system_id: Option<u8>,
    /// Ask it at start for the messages that are used, at the rates they are used at.
    pub configure: bool,
}

/// What of an autopilot goes into the filter.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AutopilotUse {
    /// Its attitude: beside a compass as a second source, else in its place.
    Attitude,
    /// Its gyros and accelerometers.
    Imu,
    /// Its receiver's fixes, where there is no receiver of our own.
    Gps,
}

impl Default for AutopilotConfig {
    fn default() -> Self {
        Self {
            device: None,
            baud: 57_600,
            listen: None,
            uses: vec![AutopilotUse::Attitude, AutopilotUse::Imu, AutopilotUse::Gps],
            system_id: None,
            configure: false,
        }
    }
}

impl AutopilotConfig {
    /// Whether this goes into the filter.
    pub fn gives(&self, what: AutopilotUse) -> bool {
        self.uses.contains(&what)
    }

    /// The UDP address it is heard at.
    pub fn listen_at(&self) -> Option<&str> {
        let listen = self.listen.as_deref()?;
        Some(listen.strip_prefix("udp://").unwrap_or(listen))
    }
}
