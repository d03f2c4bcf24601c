//! `[daemon]` and `[power]`: operation without an operator.

use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

use windhover_base::settings::GpioLine;

/// `[daemon]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DaemonConfig {
    /// Parts that are optional: the daemon is ready without them, and uses them when they appear.
    pub optional: Vec<Part>,
    /// Longest time without an answer of a task before the watchdog is no longer notified, seconds.
    pub answer_within_s: f64,
    /// Frames that wait for a pipeline that does not catch up; when one more comes, the oldest is dropped and recorded
    /// as dropped. More frames mean more latency under load, never more throughput. (A burst of up to 16 frames that is
    /// handled within half a second loses none.)
    pub frame_queue: usize,
    /// Address on loopback where health is served as OpenMetrics (`/metrics`); not served where absent.
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
    /// The connection to the autopilot.
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
    /// Below this supply voltage for three seconds the flight is flushed and its segment closed, volts; absent: the
    /// voltage is only shown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub low_voltage_v: Option<f64>,
    /// Whether a mains or external supply going off line counts as a power failure.
    pub on_mains_off: bool,
    /// A file with the supply voltage (hwmon `in*_input`, millivolts, or `voltage_now`, microvolts); absent: the lowest
    /// of all batteries that the kernel knows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub voltage_file: Option<String>,
    /// A file that signals a power failure at once, when it exists and contains anything but 0: the value of a GPIO
    /// line in sysfs, or the flag of a UPS program (POWERDOWNFLAG of NUT).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub going_file: Option<String>,
    /// A GPIO line that signals a power failure at once, by its chip's character device.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub going_line: Option<GpioLine>,
    /// Temperature above which the health line is a warning, degrees Celsius.
    pub hot_c: f64,
    /// Where sysfs is.
    pub sysfs: String,
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
