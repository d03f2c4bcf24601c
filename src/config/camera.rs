//! Checks of `[camera]`.

use super::check::{refuse, within};
use super::{Config, ConfigError};
use windhover_base::geo::LensModel;

impl Config {
    pub(super) fn check_camera(&self) -> Result<(), ConfigError> {
        let camera = &self.camera;
        within("camera.width", f64::from(camera.width), 16.0, 16_384.0)?;
        within("camera.height", f64::from(camera.height), 16.0, 16_384.0)?;
        within("camera.fps", camera.fps, 0.1, 1_000.0)?;
        within("camera.exposure_offset_ms", camera.exposure_offset_ms, -1_000.0, 1_000.0)?;
        within("camera.readout_ms", camera.readout_ms, -200.0, 200.0)?;
        self.check_exposure()?;
        within("camera.intrinsics.fx", camera.intrinsics.fx, 1.0, 1e6)?;
        within("camera.intrinsics.fy", camera.intrinsics.fy, 1.0, 1e6)?;
        within("camera.intrinsics.cx", camera.intrinsics.cx, -1e5, 1e5)?;
        within("camera.intrinsics.cy", camera.intrinsics.cy, -1e5, 1e5)?;
        within("camera.intrinsics.skew", camera.intrinsics.skew, -1.0, 1.0)?;
        let terms = match camera.intrinsics.model {
            LensModel::Brown => ["k1", "k2", "p1", "p2", "k3"],
            LensModel::Fisheye => ["k1", "k2", "k3", "k4", "the fifth"],
        };
        if camera.intrinsics.model == LensModel::Fisheye && camera.intrinsics.distortion[4] != 0.0 {
            refuse("camera.intrinsics.distortion", "a fisheye has four terms: k1, k2, k3, k4".to_owned())?;
        }
        for (term, value) in terms.iter().zip(camera.intrinsics.distortion) {
            within(format!("camera.intrinsics.distortion ({term})"), value, -100.0, 100.0)?;
        }
        for (axis, value) in camera.mount.position_m.iter().enumerate() {
            within(format!("camera.mount.position_m[{axis}]"), *value, -20.0, 20.0)?;
        }
        within("camera.mount.yaw_deg", camera.mount.yaw_deg, -180.0, 180.0)?;
        within("camera.mount.pitch_deg", camera.mount.pitch_deg, -90.0, 90.0)?;
        within("camera.mount.roll_deg", camera.mount.roll_deg, -180.0, 180.0)
    }

    fn check_exposure(&self) -> Result<(), ConfigError> {
        let camera = &self.camera;
        let limits = [("camera.exposure_us", camera.exposure_us), ("camera.auto_max_us", camera.auto_max_us)];
        for (key, value) in limits {
            within(key, value.unwrap_or(1_000.0), 1.0, 1_000_000.0)?;
        }
        if camera.exposure_us.is_some() && camera.auto_max_us.is_some() {
            refuse("camera.auto_max_us", "exposure_us is given too; keep one of them")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use crate::config::Config;

    /// The error for the shipped configuration with this line in `[camera]`; `None` where it is accepted.
    fn refusal(line: &str) -> Option<String> {
        let text = include_str!("../../config/windhover.toml").replacen(
            "[camera]\n",
            &format!("[camera]\n{line}\n"),
            1,
        );
        Config::parse(&text).err().map(|error| error.to_string())
    }

    #[test]
    fn exposure_is_fixed_or_limited_not_both() {
        for accepted in
            ["exposure_us = 2000", "auto_max_us = 500.0", "exposure_us = 100\ngain = 16", "gain = -3"]
        {
            assert_eq!(refusal(accepted), None, "{accepted}");
        }
        for (refused, key) in [
            ("exposure_us = 2000\nauto_max_us = 2000", "camera.auto_max_us: exposure_us is given too"),
            ("exposure_us = 0", "camera.exposure_us"),
            ("exposure_us = -5", "camera.exposure_us"),
            ("auto_max_us = 2e6", "camera.auto_max_us"),
            ("auto_max_us = nan", "camera.auto_max_us"),
            ("gain = 1.5", "gain"),
            ("trigger_line = { chip = \"/dev/gpiochip0\" }", "line"),
        ] {
            let message = refusal(refused).unwrap_or_default();
            assert!(message.contains(key), "{refused}: {message}");
        }
    }
}
