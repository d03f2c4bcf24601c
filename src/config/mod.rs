//! The configuration as values, its defaults and its checks.
//!
//! This is core: text in, values or errors out. Reading the file and reporting errors is `app`'s. Angles are degrees
//! here, as people write them; each section converts where it is used.

mod camera;
mod check;
mod daemon;
mod link;
mod log;
mod sensors;
mod store;
mod targets;
mod video;

pub use check::ConfigError;
pub use daemon::{DaemonConfig, Part, PowerConfig};
pub use link::{AUTOPILOT, LandingFrame, LinkConfig, MavlinkConfig, MavlinkMessage};
pub use log::{LogConfig, LogFormat, LogLevel};
pub use store::{FramePolicy, StoreConfig};
pub use video::VideoConfig;

use serde::{Deserialize, Serialize};
use windhover_base::settings::{
    AttitudeConfig, AutopilotConfig, AutopilotUse, CameraConfig, CompassConfig, Datum, DetectorConfig,
    EstimatorConfig, GpsConfig, GroundConfig, ImuConfig, MonteCarloConfig, Rig, TargetConfig, shares_line,
};

/// The whole configuration. Unknown keys are errors everywhere.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The GPS receiver.
    #[serde(default, skip_serializing_if = "GpsConfig::is_absent")]
    pub gps: GpsConfig,
    /// The digital compass.
    #[serde(default, skip_serializing_if = "CompassConfig::is_absent")]
    pub compass: CompassConfig,
    /// The helicopter's autopilot, where one is connected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub autopilot: Option<AutopilotConfig>,
    /// Gyros and accelerometers, where there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imu: Option<ImuConfig>,
    /// A second source of attitude, where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attitude: Option<AttitudeConfig>,
    /// The camera, its lens and its mount.
    pub camera: CameraConfig,
    /// The ground the vehicle drives on.
    pub ground: GroundConfig,
    /// Origin of the NED frame; the first fix at ground elevation where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub datum: Option<Datum>,
    /// The vehicles to watch.
    pub target: Vec<TargetConfig>,
    /// Marker detection.
    #[serde(default)]
    pub detector: DetectorConfig,
    /// The joint filter.
    #[serde(default)]
    pub estimator: EstimatorConfig,
    /// Flights on the data card.
    #[serde(default)]
    pub store: StoreConfig,
    /// The wireless link.
    #[serde(default)]
    pub link: LinkConfig,
    /// MAVLink for other ground stations and autopilots.
    #[serde(default)]
    pub mavlink: MavlinkConfig,
    /// The camera's picture, live.
    #[serde(default)]
    pub video: VideoConfig,
    /// The operator's log.
    #[serde(default)]
    pub log: LogConfig,
    /// Operation without an operator.
    #[serde(default)]
    pub daemon: DaemonConfig,
    /// Supply voltage and temperature.
    #[serde(default)]
    pub power: PowerConfig,
    /// The error analysis of `windhover montecarlo`.
    #[serde(default)]
    pub montecarlo: MonteCarloConfig,
}

impl Config {
    /// The configuration of a rig over known ground, with defaults in every other section.
    pub fn of_rig(rig: Rig, ground: GroundConfig) -> Self {
        let Rig { gps, compass, autopilot, imu, attitude, camera, target } = rig;
        Self {
            gps,
            compass,
            autopilot,
            imu,
            attitude,
            camera,
            ground,
            datum: None,
            target,
            detector: DetectorConfig::default(),
            estimator: EstimatorConfig::default(),
            store: StoreConfig::default(),
            link: LinkConfig::default(),
            mavlink: MavlinkConfig::default(),
            video: VideoConfig::default(),
            log: LogConfig::default(),
            daemon: DaemonConfig::default(),
            power: PowerConfig::default(),
            montecarlo: MonteCarloConfig::default(),
        }
    }

    /// The filter's section. It has no more features than the detector follows: without any the filter has no states
    /// for them.
    pub fn filter(&self) -> EstimatorConfig {
        let features = self.estimator.features.min(self.detector.ground_features);
        EstimatorConfig { features, ..self.estimator.clone() }
    }

    /// The instruments and the targets.
    pub fn rig(&self) -> Rig {
        let gives = |what| self.autopilot.as_ref().is_some_and(|autopilot| autopilot.gives(what));
        let second = gives(AutopilotUse::Attitude) && self.compass.is_there();
        Rig {
            gps: self.gps.clone(),
            compass: self.compass.clone(),
            autopilot: self.autopilot.clone(),
            imu: self.imu.or_else(|| (gives(AutopilotUse::Imu) || self.compass.imu).then(ImuConfig::default)),
            attitude: self.attitude.or_else(|| second.then(AttitudeConfig::default)),
            camera: self.camera.clone(),
            target: self.target.clone(),
        }
    }

    /// Parts that the daemon is ready without: the optional ones, and those that are not configured.
    pub fn optional_parts(&self) -> Vec<Part> {
        let absent = [
            (Part::Gps, self.gps.is_absent()),
            (Part::Compass, self.compass.is_absent() || shares_line(&self.gps, &self.compass)),
            (Part::Autopilot, self.autopilot.is_none()),
        ];
        let absent = absent.into_iter().filter(|(_, is)| *is).map(|(part, _)| part);
        self.daemon.optional.iter().copied().chain(absent).collect()
    }

    /// Parses and checks a configuration. The error names line and key where possible.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|e| ConfigError::syntax(&e, text))?;
        config.check().map_err(|e| e.at_line(text))?;
        Ok(config)
    }

    /// The effective configuration, defaults filled in, as TOML.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        toml::to_string_pretty(self).map_err(|e| ConfigError::Unwritable(e.to_string()))
    }
}
