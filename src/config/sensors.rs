//! Checks of the sections of receiver, compass, autopilot and other sensors.

use windhover_base::settings::{AttitudeConfig, AutopilotUse, GpsFormat, ImuConfig, shares_line};

use super::check::{ConfigError, refuse, within};
use super::{AUTOPILOT, Config};

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
    pub(super) fn check_sensors(&self) -> Result<(), ConfigError> {
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
