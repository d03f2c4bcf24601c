//! Checks of a configuration beyond its syntax.

use windhover_base::settings::{
    AttitudeConfig, AutopilotUse, GpsFormat, GroundConfig, ImuConfig, MarkerConfig, MarkerKind, TargetConfig,
    TargetModel, shares_line,
};

use super::{AUTOPILOT, Config};

/// What is wrong with a configuration.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum ConfigError {
    /// Not TOML, an unknown key, or a value of the wrong type. The text contains the line.
    #[error("{0}")]
    Syntax(String),
    /// An impossible value.
    #[error("{}{key}: {reason}", line.map_or(String::new(), |n| format!("line {n}, ")))]
    Value {
        /// Its line, from 1; `None` where it may be a default or at several places.
        line: Option<usize>,
        /// The key, with its table.
        key: String,
        /// What is wrong and what to do.
        reason: String,
    },
    /// The effective configuration could not be written as TOML.
    #[error("the configuration cannot be written as TOML: {0}")]
    Unwritable(String),
}

impl ConfigError {
    pub(super) fn syntax(error: &toml::de::Error, text: &str) -> Self {
        let words = error.message().trim_end().replace('\n', "; ");
        let Some(before) = error.span().and_then(|span| text.get(..span.start)) else {
            return Self::Syntax(words);
        };
        let line = 1 + before.matches('\n').count();
        // The line itself shows the key; a missing key has no line.
        let written = text.lines().nth(line - 1).unwrap_or_default().trim();
        if words.starts_with("missing field") || written.is_empty() {
            Self::Syntax(format!("line {line}: {words}"))
        } else {
            Self::Syntax(format!("line {line}, `{written}`: {words}"))
        }
    }

    /// The same with the line of the key, where the key is on one line only.
    pub(super) fn at_line(self, text: &str) -> Self {
        match self {
            Self::Value { key, reason, line: None } => {
                let line = line_of(&key, text);
                Self::Value { key, reason, line }
            }
            other => other,
        }
    }
}

pub(super) fn refuse(key: impl Into<String>, reason: impl Into<String>) -> Result<(), ConfigError> {
    Err(ConfigError::Value { line: None, key: key.into(), reason: reason.into() })
}

/// The line of a dotted key in a text of tables; `None` where no line or several would match.
fn line_of(key: &str, text: &str) -> Option<usize> {
    let plain = key.split('[').next().unwrap_or(key);
    let (table, name) = plain.rsplit_once('.').unwrap_or(("", plain));
    let mut current = String::new();
    let mut found = None;
    for (k, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.starts_with('[') {
            let inside = line.trim_start_matches('[').split(']').next().unwrap_or_default();
            current = inside.trim().to_owned();
            continue;
        }
        let is_key = line.split_once('=').is_some_and(|(left, _)| left.trim() == name);
        if current == table && is_key && found.replace(k + 1).is_some() {
            return None;
        }
    }
    found
}

/// A value must be finite and within bounds.
pub(super) fn within(key: impl Into<String>, value: f64, low: f64, high: f64) -> Result<(), ConfigError> {
    if value.is_finite() && (low..=high).contains(&value) {
        return Ok(());
    }
    refuse(key, format!("{value} is not between {low} and {high}"))
}

/// Most targets: all are states of one filter, whose memory grows with the square of their number.
const MOST_TARGETS: usize = 32;
/// Most markers of all targets together.
const MOST_MARKERS: usize = 256;

/// Line speeds a UART can be set to.
const BAUDS: [u32; 13] =
    [1200, 2400, 4800, 9600, 19200, 38400, 57600, 115_200, 230_400, 460_800, 921_600, 1_000_000, 2_000_000];

fn baud(key: &str, value: u32) -> Result<(), ConfigError> {
    if BAUDS.contains(&value) {
        return Ok(());
    }
    refuse(key, format!("{value} is not a line speed; use one of {BAUDS:?}"))
}

/// A device on the network is `tcp://HOST:PORT` or `udp://ADDRESS:PORT`.
fn network_device(key: &str, device: &str) -> Result<(), ConfigError> {
    let Some((protocol, address)) = device.split_once("://") else { return Ok(()) };
    let port = address.rsplit_once(':').filter(|(host, _)| !host.is_empty());
    let has_port = port.is_some_and(|(_, port)| port.parse::<u16>().is_ok_and(|port| port > 0));
    if matches!(protocol, "tcp" | "udp") && has_port {
        return Ok(());
    }
    refuse(key, format!("{device} is not a device; give a path, tcp://HOST:PORT or udp://ADDRESS:PORT"))
}

impl Config {
    /// Checks every value; the error is the first impossible one.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.check_sensors()?;
        self.check_camera()?;
        check_ground(&self.ground)?;
        if let Some(datum) = &self.datum {
            within("datum.lat_deg", datum.lat_deg, -90.0, 90.0)?;
            within("datum.lon_deg", datum.lon_deg, -180.0, 180.0)?;
            within("datum.height_m", datum.height_m, -1_000.0, 20_000.0)?;
        }
        self.check_targets()?;
        self.check_daemon()?;
        within("detector.min_px", self.detector.min_px, 8.0, 1_000.0)?;
        within("detector.max_hamming", f64::from(self.detector.max_hamming), 0.0, 3.0)?;
        within("detector.ground_features", self.detector.ground_features as f64, 0.0, 64.0)?;
        self.check_estimator()?;
        self.store.check()?;
        self.link.check()?;
        self.mavlink.check()?;
        self.video.check()?;
        self.check_montecarlo()
    }

    fn check_montecarlo(&self) -> Result<(), ConfigError> {
        let mc = &self.montecarlo;
        for (axis, value) in mc.position_ned_m.iter().enumerate() {
            within(format!("montecarlo.position_ned_m[{axis}]"), *value, -20_000.0, 20_000.0)?;
        }
        for (axis, value) in mc.pixel.iter().flatten().enumerate() {
            within(format!("montecarlo.pixel[{axis}]"), *value, -1e5, 1e5)?;
        }
        for (key, value, high) in [
            ("heading_deg", mc.heading_deg, 360.0),
            ("pitch_deg", mc.pitch_deg, 90.0),
            ("roll_deg", mc.roll_deg, 180.0),
            ("above_ground_m", mc.above_ground_m, 1_000.0),
        ] {
            within(format!("montecarlo.{key}"), value, -high, high)?;
        }
        for (key, value, high) in [
            ("gps_horizontal_sigma_m", mc.gps_horizontal_sigma_m, 1_000.0),
            ("gps_vertical_sigma_m", mc.gps_vertical_sigma_m, 1_000.0),
            ("heading_sigma_deg", mc.heading_sigma_deg, 90.0),
            ("pitch_sigma_deg", mc.pitch_sigma_deg, 90.0),
            ("roll_sigma_deg", mc.roll_sigma_deg, 90.0),
            ("pixel_sigma_px", mc.pixel_sigma_px, 1_000.0),
            ("ground_sigma_m", mc.ground_sigma_m, 1_000.0),
            ("mount_sigma_deg", mc.mount_sigma_deg, 90.0),
            ("focal_sigma_px", mc.focal_sigma_px, 1_000.0),
            ("principal_sigma_px", mc.principal_sigma_px, 1_000.0),
        ] {
            within(format!("montecarlo.{key}"), value, 0.0, high)?;
        }
        Ok(())
    }

    fn check_estimator(&self) -> Result<(), ConfigError> {
        let e = &self.estimator;
        within("estimator.ownship_hz", e.ownship_hz, 0.1, 100.0)?;
        within("estimator.history_ms", e.history_ms, 500.0, 10_000.0)?;
        within("estimator.smoother_lag_ms", e.smoother_lag_ms, 0.0, 2_000.0)?;
        within("estimator.lost_after_s", e.lost_after_s, 0.1, 600.0)?;
        within("estimator.learn_s", e.learn_s, 1.0, 1e4)?;
        within("estimator.gate_probability", e.gate_probability, 0.5, 0.999_999)?;
        within("estimator.rejections_to_restart", f64::from(e.rejections_to_restart), 1.0, 1_000.0)?;
        within("estimator.features", e.features as f64, 0.0, 32.0)?;
        within("estimator.feature_sigma_factor", e.feature_sigma_factor, 0.1, 100.0)?;
        within("estimator.marker_noise_px", e.marker_noise_px, 0.0, 100.0)?;
        within("estimator.force_tau_s", e.force_tau_s, 0.01, 1e4)?;
        for (key, value) in [
            ("tilt_rate_walk", e.tilt_rate_walk),
            ("yaw_rate_walk", e.yaw_rate_walk),
            ("side_force_mps2", e.side_force_mps2),
            ("thrust_mps2", e.thrust_mps2),
            ("target_speed_walk", e.target_speed_walk),
            ("target_yaw_rate_walk", e.target_yaw_rate_walk),
            ("target_slip_walk", e.target_slip_walk),
        ] {
            within(format!("estimator.{key}"), value, 1e-6, 1e3)?;
        }
        Ok(())
    }

    fn check_sensors(&self) -> Result<(), ConfigError> {
        baud("gps.baud", self.gps.baud)?;
        baud("compass.baud", self.compass.baud)?;
        self.check_autopilot()?;
        self.check_shared_line()?;
        self.check_setup()?;
        let given = |what| self.autopilot.as_ref().is_some_and(|autopilot| autopilot.gives(what));
        for (key, device, what) in [
            ("gps.device", &self.gps.device, Some(AutopilotUse::Gps)),
            ("compass.device", &self.compass.device, Some(AutopilotUse::Attitude)),
            ("camera.device", &self.camera.device, None),
        ] {
            if device.is_empty() && !what.is_some_and(given) {
                refuse(key, "is empty; give a path such as /dev/ttyS0")?;
            }
        }
        network_device("gps.device", &self.gps.device)?;
        network_device("compass.device", &self.compass.device)?;
        for (axis, value) in self.gps.antenna_position_m.iter().enumerate() {
            within(format!("gps.antenna_position_m[{axis}]"), *value, -20.0, 20.0)?;
        }
        within("gps.latency_ms", self.gps.latency_ms, -200.0, 2_000.0)?;
        within("gps.latency_sigma_ms", self.gps.latency_sigma_ms, 0.0, 1_000.0)?;
        within("gps.bias_sigma_m", self.gps.bias_sigma_m, 0.0, 1_000.0)?;
        within("gps.bias_tau_s", self.gps.bias_tau_s, 1.0, 1e6)?;
        within("gps.noise_m", self.gps.noise_m, 1e-4, 1_000.0)?;
        within("gps.velocity_noise_mps", self.gps.velocity_noise_mps, 1e-4, 100.0)?;
        let compass = &self.compass;
        match (compass.declination_deg, compass.declination) {
            (Some(_), Some(_)) => refuse(
                "compass.declination",
                "declination_deg is given too; keep either the value or the model",
            )?,
            (Some(figure), None) => within("compass.declination_deg", figure, -180.0, 180.0)?,
            _ => {}
        }
        within("compass.latency_ms", compass.latency_ms, -200.0, 2_000.0)?;
        within("compass.yaw_offset_deg", compass.yaw_offset_deg, -180.0, 180.0)?;
        within("compass.pitch_offset_deg", compass.pitch_offset_deg, -45.0, 45.0)?;
        within("compass.roll_offset_deg", compass.roll_offset_deg, -45.0, 45.0)?;
        within("compass.heading_bias_sigma_deg", compass.heading_bias_sigma_deg, 0.0, 180.0)?;
        within("compass.heading_noise_deg", compass.heading_noise_deg, 1e-3, 90.0)?;
        within("compass.tilt_noise_deg", compass.tilt_noise_deg, 1e-3, 90.0)?;
        self.imu.as_ref().map_or(Ok(()), check_imu)?;
        self.attitude.as_ref().map_or(Ok(()), check_attitude)
    }

    /// A receiver may also provide the heading; another device cannot be on its line.
    fn check_shared_line(&self) -> Result<(), ConfigError> {
        let (gps, compass) = (&self.gps, &self.compass);
        if compass.imu && !compass.format.has_inertial() {
            refuse("compass.imu", format!("{} has no rates; remove this key", compass.format.name()))?;
        }
        if !shares_line(gps, compass) {
            return Ok(());
        }
        let device = &compass.device;
        if !compass.format.is_of_receivers() {
            let format = compass.format.name();
            let words = "is the GPS receiver's line too, whose heading needs format nmea or ubx";
            refuse("compass.device", format!("{device} is {words}, not {format}"))?;
        }
        if (gps.baud, gps.framing) != (compass.baud, compass.framing) {
            refuse(
                "compass.baud",
                format!(
                    "{device} is the GPS receiver's line too: both sections must have the same line settings"
                ),
            )?;
        }
        Ok(())
    }

    fn check_setup(&self) -> Result<(), ConfigError> {
        let gps = &self.gps;
        let is_network = gps.device.contains("://");
        for (key, is_asked) in
            [("gps.configure_garmin", gps.configure_garmin), ("gps.configure", gps.configure)]
        {
            if is_asked && is_network {
                refuse(key, "a receiver on the network cannot be configured; remove this key")?;
            }
        }
        if gps.configure && gps.configure_garmin {
            refuse("gps.configure", "is for u-blox, and configure_garmin is set too; keep one of them")?;
        }
        if gps.configure && gps.format == GpsFormat::Nmea {
            refuse("gps.configure", "switches u-blox's packets on, and gps.format is \"nmea\"")?;
        }
        within("gps.rate_hz", gps.rate_hz, 0.1, 25.0)
    }

    fn check_autopilot(&self) -> Result<(), ConfigError> {
        let to_autopilot = self.mavlink.send_to.iter().any(|station| station == AUTOPILOT);
        let Some(autopilot) = &self.autopilot else {
            if to_autopilot {
                refuse("mavlink.send_to", "names the autopilot, but there is no [autopilot]")?;
            }
            return Ok(());
        };
        baud("autopilot.baud", autopilot.baud)?;
        match (&autopilot.device, autopilot.listen_at()) {
            (Some(_), Some(_)) => refuse("autopilot.listen", "device is given too; keep one of them")?,
            (None, None) => refuse("autopilot", "give device, or listen = \"udp://0.0.0.0:14550\"")?,
            (Some(device), None) if [&self.gps.device, &self.compass.device].contains(&device) => {
                refuse("autopilot.device", format!("{device} is another device's line too"))?;
            }
            (None, Some(address)) if address.parse::<std::net::SocketAddr>().is_err() => {
                refuse("autopilot.listen", format!("{address:?} is not udp://ADDRESS:PORT"))?;
            }
            _ => {}
        }
        let mavlink = &self.mavlink;
        if autopilot.system_id.is_some_and(|id| id == mavlink.system_id) {
            refuse("autopilot.system_id", "is the system id of the first target, mavlink.system_id")?;
        }
        Ok(())
    }

    fn check_daemon(&self) -> Result<(), ConfigError> {
        within("daemon.answer_within_s", self.daemon.answer_within_s, 1.0, 600.0)?;
        within("daemon.frame_queue", self.daemon.frame_queue as f64, 1.0, 30.0)?;
        if let Some(address) = self.daemon.metrics.filter(|address| !address.ip().is_loopback()) {
            refuse(
                "daemon.metrics",
                format!("{address} is not on loopback; for other machines the station serves the metrics"),
            )?;
        }
        if let Some(volts) = self.power.low_voltage_v {
            within("power.low_voltage_v", volts, 0.1, 1_000.0)?;
        }
        within("power.hot_c", self.power.hot_c, -40.0, 200.0)?;
        within("log.file_mb", self.log.file_mb, 0.01, 10_000.0)?;
        within("log.files_kept", f64::from(self.log.files_kept), 0.0, 1_000.0)
    }

    fn check_targets(&self) -> Result<(), ConfigError> {
        if self.target.is_empty() {
            return refuse("target", "there is no [[target]]: name the vehicle to watch");
        }
        let markers: usize = self.target.iter().map(|target| target.marker.len()).sum();
        for (key, count, most) in
            [("target", self.target.len(), MOST_TARGETS), ("target.marker", markers, MOST_MARKERS)]
        {
            if count > most {
                refuse(key, format!("there are {count}; the most for one helicopter is {most}"))?;
            }
        }
        let mut names = std::collections::BTreeSet::new();
        let mut tags = std::collections::BTreeSet::new();
        for target in &self.target {
            check_target(target)?;
            if !names.insert(&target.name) {
                refuse("target.name", format!("two targets are called {:?}", target.name))?;
            }
            for marker in &target.marker {
                if let (Some(family), Some(id)) = (marker.family, marker.id)
                    && !tags.insert((family.name(), id))
                {
                    refuse("target.marker.id", format!("tag {id} of {} is used twice", family.name()))?;
                }
            }
        }
        Ok(())
    }
}

fn check_imu(imu: &ImuConfig) -> Result<(), ConfigError> {
    within("imu.latency_ms", imu.latency_ms, -200.0, 2_000.0)?;
    within("imu.yaw_deg", imu.yaw_deg, -180.0, 180.0)?;
    within("imu.pitch_deg", imu.pitch_deg, -90.0, 90.0)?;
    within("imu.roll_deg", imu.roll_deg, -180.0, 180.0)?;
    within("imu.rate_noise_dps", imu.rate_noise_dps, 1e-3, 1_000.0)?;
    within("imu.rate_bias_dps", imu.rate_bias_dps, 0.0, 1_000.0)?;
    within("imu.force_noise_mps2", imu.force_noise_mps2, 1e-3, 100.0)?;
    within("imu.force_bias_mps2", imu.force_bias_mps2, 0.0, 100.0)
}

fn check_attitude(attitude: &AttitudeConfig) -> Result<(), ConfigError> {
    within("attitude.latency_ms", attitude.latency_ms, -200.0, 2_000.0)?;
    within("attitude.heading_bias_sigma_deg", attitude.heading_bias_sigma_deg, 0.0, 180.0)?;
    within("attitude.heading_noise_deg", attitude.heading_noise_deg, 1e-3, 90.0)?;
    within("attitude.tilt_noise_deg", attitude.tilt_noise_deg, 1e-3, 90.0)
}

fn check_ground(ground: &GroundConfig) -> Result<(), ConfigError> {
    let given = [ground.elevation_msl_m.is_some(), ground.source.is_some(), ground.terrain.is_some()];
    if given.iter().filter(|g| **g).count() != 1 {
        return refuse("ground", "give exactly one of elevation_msl_m, source = \"takeoff\", terrain");
    }
    ground.elevation_msl_m.map_or(Ok(()), |m| within("ground.elevation_msl_m", m, -500.0, 9_000.0))
}

fn check_target(target: &TargetConfig) -> Result<(), ConfigError> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    if target.name.is_empty() || !target.name.chars().all(allowed) {
        refuse("target.name", format!("{:?} must be letters, digits, - and _ only", target.name))?;
    }
    match (target.model, target.wheelbase_m) {
        (TargetModel::Ackermann, None) => {
            refuse("target.wheelbase_m", "an ackermann target needs wheelbase_m")?;
        }
        (_, Some(wheelbase)) => within("target.wheelbase_m", wheelbase, 0.05, 50.0)?,
        (_, None) => {}
    }
    within("target.reference_m", target.reference_m, -50.0, 50.0)?;
    if target.marker.is_empty() {
        refuse("target.marker", format!("target {:?} has no [[target.marker]]", target.name))?;
    }
    target.marker.iter().try_for_each(check_marker)
}

fn check_marker(marker: &MarkerConfig) -> Result<(), ConfigError> {
    for (axis, value) in marker.position_m.iter().enumerate() {
        within(format!("target.marker.position_m[{axis}]"), *value, -50.0, 50.0)?;
    }
    within("target.marker.yaw_deg", marker.yaw_deg, -360.0, 360.0)?;
    match marker.kind {
        MarkerKind::Apriltag => {
            let (Some(family), Some(id)) = (marker.family, marker.id) else {
                return refuse("target.marker", "an apriltag needs family and id");
            };
            if id as usize >= family.codes() {
                refuse("target.marker.id", format!("{} has ids 0 to {}", family.name(), family.codes() - 1))?;
            }
            within("target.marker.border", f64::from(marker.border), 1.0, 2.0)?;
            match marker.size_m {
                Some(size) => within("target.marker.size_m", size, 0.005, 50.0),
                None => refuse("target.marker.size_m", "an apriltag needs the edge of its black square"),
            }
        }
        MarkerKind::Disc => {
            if marker.brightness.is_some() == marker.color.is_some() {
                refuse("target.marker", "a disc needs either brightness or color")?;
            }
            if let Some(color) = &marker.color
                && !(color.len() == 7
                    && color.starts_with('#')
                    && color[1..].chars().all(|c| c.is_ascii_hexdigit()))
            {
                refuse("target.marker.color", format!("{color:?} is not #rrggbb"))?;
            }
            match marker.diameter_m {
                Some(d) => within("target.marker.diameter_m", d, 0.005, 50.0),
                None => refuse("target.marker.diameter_m", "a disc needs its diameter"),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The error for the shipped configuration with these replacements; `None` where it is accepted.
    fn refusal(replaced: &[(&str, &str)]) -> Option<String> {
        let mut text = include_str!("../../config/windhover.toml").to_owned();
        for (from, to) in replaced {
            assert!(text.contains(from), "{from}");
            text = text.replacen(from, to, 1);
        }
        Config::parse(&text).err().map(|error| error.to_string())
    }

    #[test]
    fn a_line_is_shared_with_a_receiver_that_tells_its_heading_and_with_nothing_else() {
        let shared = ("device = \"/dev/ttyS1\"", "device = \"/dev/ttyS0\"");
        let format = |name: &'static str| ("format = \"tcm2\"", name);
        for name in ["format = \"nmea\"", "format = \"ubx\""] {
            assert_eq!(refusal(&[shared, format(name)]), None, "{name}");
        }
        let message = refusal(&[shared]).expect("a TCM2 is another device");
        assert!(message.contains("compass.device") && message.contains("tcm2"), "{message}");
        let other_speed = ("baud = 38400\n#", "baud = 9600\n#");
        let message =
            refusal(&[shared, format("format = \"ubx\""), other_speed]).expect("one line, two speeds");
        assert!(message.contains("compass.baud"), "{message}");
    }

    #[test]
    fn a_receiver_is_configured_in_one_way() {
        let on = |key: &'static str, to: &'static str| (key, to);
        let ublox = on("#configure = false", "configure = true");
        assert_eq!(refusal(&[ublox]), None);
        for (more, key) in [
            (on("#configure_garmin = false", "configure_garmin = true"), "gps.configure"),
            (on("#format = \"auto\"", "format = \"nmea\""), "gps.configure"),
            (on("#rate_hz = 5.0", "rate_hz = 100.0"), "gps.rate_hz"),
            (on("device = \"/dev/ttyS0\"", "device = \"tcp://gps:2000\""), "gps.configure"),
        ] {
            let message = refusal(&[ublox, more]).expect(key);
            assert!(message.contains(key), "{message}");
        }
        let imu = refusal(&[on("#imu = false", "imu = true")]).expect("a TCM2 has no rates");
        assert!(imu.contains("compass.imu"), "{imu}");
    }
}
