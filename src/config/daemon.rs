//! `[daemon]` and `[power]`: what running unattended needs.

use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

/// `[daemon]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DaemonConfig {
    /// Parts whose absence is accepted: the service is ready without them, and uses them when they come.
    pub optional: Vec<Part>,
    /// Longest a task may go without answering before the watchdog is no longer stroked, seconds.
    pub answer_within_s: f64,
    /// Frames that wait for a pipeline that does not catch up; when one more comes, the oldest is dropped and
    /// recorded as dropped. More frames mean more latency under load, never more throughput. (A burst of up
    /// to 16 frames that is handled within half a second loses none.)
    pub frame_queue: usize,
    /// Where health is told as OpenMetrics (`/metrics`), on loopback; nowhere where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metrics: Option<SocketAddr>,
}

impl Default for DaemonConfig {
    fn default() -> Self {
        Self { optional: Vec::new(), answer_within_s: 5.0, frame_queue: 3, metrics: None }
    }
}

/// Parts of the daemon that have to be up before it is ready.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// The GPS line.
    Gps,
    /// The compass line.
    Compass,
    /// The camera.
    Camera,
    /// The link to the autopilot.
    Autopilot,
    /// The data card.
    Store,
}

impl Part {
    /// Every part.
    pub const ALL: [Self; 5] = [Self::Gps, Self::Compass, Self::Camera, Self::Autopilot, Self::Store];

    /// Its name in configuration and log.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Gps => "gps",
            Self::Compass => "compass",
            Self::Camera => "camera",
            Self::Autopilot => "autopilot",
            Self::Store => "store",
        }
    }
}

/// `[power]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PowerConfig {
    /// Below this supply voltage for three seconds the flight is flushed and its segment closed, volts;
    /// none: the voltage is shown and not acted on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub low_voltage_v: Option<f64>,
    /// Whether a mains or external supply going off line counts as power going.
    pub on_mains_off: bool,
    /// A file that holds the supply voltage (hwmon `in*_input`, millivolts, or `voltage_now`,
    /// microvolts); none: the lowest of all batteries the kernel knows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub voltage_file: Option<String>,
    /// A file that tells at once that power is going: it is there and holds something else than 0. The
    /// value of a GPIO line in sysfs, or the flag a UPS program sets (POWERDOWNFLAG of NUT).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub going_file: Option<String>,
    /// A GPIO line that tells at once that power is going, by its chip's character device.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub going_line: Option<GoingLine>,
    /// Temperature above which the health line is a warning, degrees Celsius.
    pub hot_c: f64,
    /// Where sysfs is.
    pub sysfs: String,
}

/// A GPIO line.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GoingLine {
    /// Its chip, for example `/dev/gpiochip0`.
    pub chip: String,
    /// Its number on the chip, as `gpioinfo` shows it.
    pub line: u32,
    /// Whether a low level means that power is going.
    #[serde(default)]
    pub active_low: bool,
}

impl Default for PowerConfig {
    fn default() -> Self {
        Self {
            low_voltage_v: None,
            on_mains_off: false,
            voltage_file: None,
            going_file: None,
            going_line: None,
            hot_c: 85.0,
            sysfs: "/sys".into(),
        }
    }
}
