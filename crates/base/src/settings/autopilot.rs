//! `[autopilot]`: the helicopter's own autopilot, received over MAVLink.

use serde::{Deserialize, Serialize};

/// `[autopilot]`
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AutopilotConfig {
    /// Serial device of its telemetry.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub device: Option<String>,
    /// Line speed, bits a second.
    pub baud: u32,
    /// Local UDP address for its datagrams instead, `udp://ADDRESS:PORT`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listen: Option<String>,
    /// Which of its measurements the filter uses. Its position and its clock are always used for the messages that are
    /// sent to it.
    #[serde(rename = "use")]
    pub uses: Vec<AutopilotUse>,
    /// Its system id; the first received autopilot where absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub system_id: Option<u8>,
    /// Request at start the messages that are used, at their rates.
    pub configure: bool,
}

/// A measurement of an autopilot that the filter can use.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AutopilotUse {
    /// Its attitude: as a second source where there is a compass, else instead of one.
    Attitude,
    /// Its gyros and accelerometers.
    Imu,
    /// Its receiver's fixes, where there is no separate receiver.
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
    /// Whether the filter uses this.
    pub fn gives(&self, what: AutopilotUse) -> bool {
        self.uses.contains(&what)
    }

    /// The local UDP address for its datagrams.
    pub fn listen_at(&self) -> Option<&str> {
        let listen = self.listen.as_deref()?;
        Some(listen.strip_prefix("udp://").unwrap_or(listen))
    }
}
