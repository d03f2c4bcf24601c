//! GPS, compass and ground sections.

use serde::{Deserialize, Serialize};

use super::Framing;
use crate::geo::TiltConvention;

/// `[gps]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GpsConfig {
    /// Serial device; a `/dev/serial/by-id` path survives renumbering. Or `tcp://HOST:PORT`, also for gpsd, or
    /// `udp://ADDRESS:PORT`, a local address for datagrams.
    pub device: String,
    /// Line speed, bits a second.
    pub baud: u32,
    /// Format of the receiver: sentences ("nmea"), u-blox's packets ("ubx"), or either ("auto").
    #[serde(default)]
    pub format: GpsFormat,
    /// Data bits, parity and stop bits of the serial line.
    #[serde(default, skip_serializing_if = "Framing::is_default")]
    pub framing: Framing,
    /// Whether sentences must have a checksum. Without this, a sentence damaged by noise may pass; an existing checksum
    /// must still match.
    #[serde(default = "defaults::yes", skip_serializing_if = "is_true")]
    pub require_checksum: bool,
    /// Antenna in the body frame, forward-right-down, metres.
    #[serde(default)]
    pub antenna_position_m: [f64; 3],
    /// From a fix's time of validity to the arrival of the first byte of its sentences, ms.
    #[serde(default = "defaults::gps_latency_ms")]
    pub latency_ms: f64,
    /// One-sigma uncertainty of `latency_ms`; the filter learns the rest from motion.
    #[serde(default = "defaults::gps_latency_sigma_ms")]
    pub latency_sigma_ms: f64,
    /// One-sigma of the slowly wandering horizontal position error, metres.
    #[serde(default = "defaults::gps_bias_sigma_m")]
    pub bias_sigma_m: f64,
    /// Correlation time of the wandering error, seconds.
    #[serde(default = "defaults::gps_bias_tau_s")]
    pub bias_tau_s: f64,
    /// One-sigma of the fix-to-fix position noise, metres.
    #[serde(default = "defaults::gps_noise_m")]
    pub noise_m: f64,
    /// One-sigma of the velocity noise per axis, m/s.
    #[serde(default = "defaults::gps_velocity_noise_mps")]
    pub velocity_noise_mps: f64,
    /// Configure a Garmin receiver at start: sentences, position averaging off, line speed.
    #[serde(default)]
    pub configure_garmin: bool,
    /// Configure a u-blox receiver at start: line speed, rate, packets, sentences off.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub configure: bool,
    /// Rate of solutions that `configure` sets, Hz.
    #[serde(default = "defaults::gps_rate_hz")]
    pub rate_hz: f64,
    /// Pulse-per-second device (`/dev/pps0`) that marks the receiver's seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pps_device: Option<String>,
}

/// There is no separate receiver: the autopilot's is used.
impl Default for GpsConfig {
    fn default() -> Self {
        Self {
            device: String::new(),
            baud: 38_400,
            format: GpsFormat::default(),
            antenna_position_m: [0.0; 3],
            latency_ms: defaults::gps_latency_ms(),
            latency_sigma_ms: defaults::gps_latency_sigma_ms(),
            bias_sigma_m: defaults::gps_bias_sigma_m(),
            bias_tau_s: defaults::gps_bias_tau_s(),
            noise_m: defaults::gps_noise_m(),
            velocity_noise_mps: defaults::gps_velocity_noise_mps(),
            configure_garmin: false,
            configure: false,
            rate_hz: defaults::gps_rate_hz(),
            framing: Framing::default(),
            require_checksum: true,
            pps_device: None,
        }
    }
}

impl GpsConfig {
    /// Whether there is a separate receiver.
    pub fn is_there(&self) -> bool {
        !self.device.is_empty()
    }

    /// Whether there is no separate receiver.
    pub fn is_absent(&self) -> bool {
        !self.is_there()
    }
}

/// Format of a receiver.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GpsFormat {
    /// Both sentences and packets.
    #[default]
    Auto,
    /// NMEA 0183, with Garmin's own sentences.
    Nmea,
    /// u-blox's packets.
    Ubx,
}

/// `[compass]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CompassConfig {
    /// Serial device, or `tcp://HOST:PORT`, `udp://ADDRESS:PORT` as for the receiver. The receiver's own line where the
    /// receiver also provides the heading.
    pub device: String,
    /// Line speed, bits a second.
    pub baud: u32,
    /// Format of the device.
    pub format: CompassFormat,
    /// Data bits, parity and stop bits of the serial line.
    #[serde(default, skip_serializing_if = "Framing::is_default")]
    pub framing: Framing,
    /// Whether sentences must have a checksum, as for the receiver.
    #[serde(default = "defaults::yes", skip_serializing_if = "is_true")]
    pub require_checksum: bool,
    /// Use its rates and forces too, with the settings of `[imu]`.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub imu: bool,
    /// Its definition of pitch and roll.
    #[serde(default)]
    pub angles: TiltConvention,
    /// What its tilt sensor measures.
    #[serde(default)]
    pub tilt: TiltKind,
    /// Magnetic declination, degrees, east positive.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub declination_deg: Option<f64>,
    /// Declination from a model instead of a value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub declination: Option<Declination>,
    /// From a sample's time of validity to the arrival of its first byte, ms (filter delay of the
    /// device and its transmission start).
    #[serde(default = "defaults::compass_latency_ms")]
    pub latency_ms: f64,
    /// Small rotation of the compass on the aircraft: added to heading, degrees.
    #[serde(default)]
    pub yaw_offset_deg: f64,
    /// Tilt zero: subtracted from pitch, degrees.
    #[serde(default)]
    pub pitch_offset_deg: f64,
    /// Tilt zero: subtracted from roll, degrees.
    #[serde(default)]
    pub roll_offset_deg: f64,
    /// One-sigma of the heading's constant error, degrees.
    #[serde(default = "defaults::heading_bias_sigma_deg")]
    pub heading_bias_sigma_deg: f64,
    /// One-sigma of the heading noise, degrees.
    #[serde(default = "defaults::heading_noise_deg")]
    pub heading_noise_deg: f64,
    /// One-sigma of the tilt noise of the sensor at rest, degrees.
    #[serde(default = "defaults::tilt_noise_deg")]
    pub tilt_noise_deg: f64,
}

/// There is no separate compass: the autopilot's attitude is used, whose heading is true and whose tilt is an AHRS's.
impl Default for CompassConfig {
    fn default() -> Self {
        Self {
            device: String::new(),
            baud: 38_400,
            format: CompassFormat::Nmea,
            framing: Framing::default(),
            require_checksum: true,
            imu: false,
            angles: TiltConvention::default(),
            tilt: TiltKind::Inertial,
            declination_deg: None,
            declination: None,
            latency_ms: 0.0,
            yaw_offset_deg: 0.0,
            pitch_offset_deg: 0.0,
            roll_offset_deg: 0.0,
            heading_bias_sigma_deg: defaults::heading_bias_sigma_deg(),
            heading_noise_deg: defaults::heading_noise_deg(),
            tilt_noise_deg: defaults::tilt_noise_deg(),
        }
    }
}

impl CompassConfig {
    /// Whether there is a separate compass.
    pub fn is_there(&self) -> bool {
        !self.device.is_empty()
    }

    /// Whether there is no separate compass.
    pub fn is_absent(&self) -> bool {
        !self.is_there()
    }
}

/// What a compass's tilt sensor measures.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TiltKind {
    /// Not configured: found out in flight.
    #[default]
    Auto,
    /// Attitude, as from an AHRS with gyros that are valid in manoeuvres.
    Inertial,
    /// Specific force, as from a fluid or an accelerometer. On a rotorcraft that is a part of the tilt or none of it.
    Gravity,
}

impl TiltKind {
    /// Its name in configuration.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Inertial => "inertial",
            Self::Gravity => "gravity",
        }
    }
}

/// The enum of formats with their names, from one row for each format.
macro_rules! compass_formats {
    ($($(#[$about:meta])* $variant:ident = $name:literal;)*) => {
        /// Serial compass formats.
        #[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
        pub enum CompassFormat {
            $($(#[$about])* #[serde(rename = $name)] $variant,)*
        }

        impl CompassFormat {
            /// Every format.
            pub const ALL: [Self; [$($name),*].len()] = [$(Self::$variant),*];

            /// Its name in configuration and on the command line.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }
        }
    };
}

compass_formats! {
    /// PNI TCM2, TCM2.5, TCM2.6 word format `$C…P…R…`.
    Tcm2 = "tcm2";
    /// OceanServer OS5000.
    Os5000 = "os5000";
    /// Honeywell HMR3000 `$PTNTHPR`.
    Hmr3000 = "hmr3000";
    /// True North Revolution `$PTNTHTM`.
    Revolution = "revolution";
    /// PNI TCM3/5/XB binary.
    Pni = "pni";
    /// `$PASHR`.
    Pashr = "pashr";
    /// VectorNav ASCII: `$VNYPR`, `$VNYMR`, `$VNQMR`, `$VNINS` and others.
    Vectornav = "vectornav";
    /// Plain NMEA, and headings that receivers measure between antennas.
    Nmea = "nmea";
    /// u-blox's packets: NAV-RELPOSNED.
    Ubx = "ubx";
    /// WitMotion's records.
    Witmotion = "witmotion";
    /// BNO08x in its UART-RVC mode: tilt, and no heading.
    Bno08xRvc = "bno08x-rvc";
}

impl CompassFormat {
    /// Whether receivers report their heading in this format, on the line of their fixes.
    pub fn is_of_receivers(self) -> bool {
        matches!(self, Self::Nmea | Self::Ubx)
    }

    /// Whether the format has rates or forces in addition to the attitude.
    pub fn has_inertial(self) -> bool {
        matches!(self, Self::Vectornav | Self::Witmotion | Self::Nmea)
    }

    /// Whether the device sends lines of text.
    pub fn is_text(self) -> bool {
        !matches!(self, Self::Pni | Self::Ubx | Self::Witmotion | Self::Bno08xRvc)
    }
}

impl std::str::FromStr for CompassFormat {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        let known = Self::ALL.into_iter().find(|format| format.name() == name);
        known.ok_or_else(|| {
            format!(
                "{name:?} is not a compass format; the formats are {}",
                Self::ALL.map(Self::name).join(", ")
            )
        })
    }
}

/// Source of the declination when it is not given as a value.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Declination {
    /// The World Magnetic Model at the first fix.
    Wmm,
}

/// `[ground]`: an elevation, or its source.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GroundConfig {
    /// Elevation of level ground above mean sea level, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub elevation_msl_m: Option<f64>,
    /// Source of the elevation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<GroundSource>,
    /// Terrain tile (SRTM .hgt or GeoTIFF).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub terrain: Option<String>,
}

/// Source of the ground's elevation.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GroundSource {
    /// The height of the first fixes: the aircraft stands on the ground when the program starts.
    Takeoff,
}

/// `[datum]`: the NED origin.
#[derive(Clone, Copy, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Datum {
    /// Latitude, degrees.
    pub lat_deg: f64,
    /// Longitude, degrees.
    pub lon_deg: f64,
    /// Height above the ellipsoid, metres.
    pub height_m: f64,
}

fn is_true(value: &bool) -> bool {
    *value
}

/// Defaults from data sheets; `config/windhover.toml` gives the source of each.
mod defaults {
    pub(super) fn yes() -> bool {
        true
    }
    pub(super) fn gps_rate_hz() -> f64 {
        5.0
    }
    pub(super) fn gps_latency_ms() -> f64 {
        120.0
    }
    pub(super) fn gps_latency_sigma_ms() -> f64 {
        40.0
    }
    pub(super) fn gps_bias_sigma_m() -> f64 {
        1.5
    }
    pub(super) fn gps_bias_tau_s() -> f64 {
        100.0
    }
    pub(super) fn gps_noise_m() -> f64 {
        0.15
    }
    pub(super) fn gps_velocity_noise_mps() -> f64 {
        0.05
    }
    pub(super) fn compass_latency_ms() -> f64 {
        15.0
    }
    pub(super) fn heading_bias_sigma_deg() -> f64 {
        1.5
    }
    pub(super) fn heading_noise_deg() -> f64 {
        0.5
    }
    pub(super) fn tilt_noise_deg() -> f64 {
        0.3
    }
}
