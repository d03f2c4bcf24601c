//! Checks of a configuration beyond its syntax.

use windhover_base::settings::GroundConfig;

use super::Config;

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
}

fn check_ground(ground: &GroundConfig) -> Result<(), ConfigError> {
    let given = [ground.elevation_msl_m.is_some(), ground.source.is_some(), ground.terrain.is_some()];
    if given.iter().filter(|g| **g).count() != 1 {
        return refuse("ground", "give exactly one of elevation_msl_m, source = \"takeoff\", terrain");
    }
    ground.elevation_msl_m.map_or(Ok(()), |m| within("ground.elevation_msl_m", m, -500.0, 9_000.0))
}
