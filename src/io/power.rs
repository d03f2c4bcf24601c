//! Temperature and supply voltage as the kernel provides them: hwmon and power_supply in sysfs.

use std::path::{Path, PathBuf};

use crate::text;

/// A reading of power and temperature. `None` where the kernel provides nothing.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct PowerReading {
    /// Hottest temperature sensor, degrees Celsius.
    pub temperature_c: Option<f64>,
    /// Supply voltage, volts: the lowest of the supplies that are present.
    pub voltage_v: Option<f64>,
    /// Charge of the weakest battery, percent.
    pub charge_percent: Option<f64>,
    /// Whether a mains or external supply exists and is off line, or a UPS runs on its battery.
    pub mains_off: bool,
    /// Whether the line or flag that signals a power failure is set.
    pub line_set: bool,
}

/// Reads sysfs below a root (`/sys`; tests give a folder that looks like it).
#[derive(Clone, Debug)]
pub struct PowerReader {
    root: PathBuf,
    voltage_file: Option<PathBuf>,
    going_file: Option<PathBuf>,
}

impl PowerReader {
    /// A reader below `root`. `voltage_file`, where given, is read for the supply voltage instead of all supplies: a
    /// file with millivolts (hwmon `in*_input`) or microvolts (power_supply `voltage_now`). `going_file`: a GPIO line's
    /// value or a UPS program's flag.
    pub fn new(root: &Path, voltage_file: Option<PathBuf>, going_file: Option<PathBuf>) -> Self {
        Self { root: root.to_owned(), voltage_file, going_file }
    }

    /// One reading; takes a few file reads of sysfs.
    pub fn read(&self) -> PowerReading {
        let mut reading = PowerReading::default();
        self.read_hwmon(&mut reading);
        self.read_supplies(&mut reading);
        if let Some(file) = &self.voltage_file {
            reading.voltage_v = voltage(file);
        }
        reading.line_set = self.going_file.as_deref().and_then(words).is_some_and(|value| value != "0");
        reading
    }

    fn read_hwmon(&self, reading: &mut PowerReading) {
        let chips = children(&self.root.join("class/hwmon"));
        for file in chips.iter().flat_map(|chip| children(chip)) {
            let name = file_name(&file);
            if name.starts_with("temp") && name.ends_with("_input") {
                // A sensor that is not connected reads 0, or an impossible value.
                let celsius = number(&file).map(|milli| milli / 1000.0);
                let sane = celsius.filter(|c| (-60.0..=200.0).contains(c) && *c != 0.0);
                reading.temperature_c = highest(reading.temperature_c, sane);
            }
        }
    }

    fn read_supplies(&self, reading: &mut PowerReading) {
        for supply in children(&self.root.join("class/power_supply")) {
            let kind = words(&supply.join("type")).unwrap_or_default();
            if kind == "Mains" || kind == "USB" {
                reading.mains_off |= number(&supply.join("online")) == Some(0.0);
                continue;
            }
            if kind == "UPS" {
                reading.mains_off |= words(&supply.join("status")).as_deref() == Some("Discharging");
            }
            if number(&supply.join("present")) == Some(0.0) {
                continue;
            }
            reading.voltage_v = lowest(reading.voltage_v, voltage(&supply.join("voltage_now")));
            reading.charge_percent = lowest(reading.charge_percent, number(&supply.join("capacity")));
        }
    }
}

/// Volts from a file of micro- or millivolts, by its name.
fn voltage(file: &Path) -> Option<f64> {
    let per_volt = if file_name(file).starts_with("voltage") { 1e6 } else { 1e3 };
    number(file).map(|figure| figure / per_volt)
}

fn highest(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    a.into_iter().chain(b).reduce(f64::max)
}

fn lowest(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    a.into_iter().chain(b).reduce(f64::min)
}

fn children(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

fn file_name(file: &Path) -> &str {
    file.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

fn words(file: &Path) -> Option<String> {
    std::fs::read_to_string(file).ok().map(|text| text.trim().to_owned())
}

fn number(file: &Path) -> Option<f64> {
    text::number(&words(file)?).ok()
}

/// Decides when power is failing: a voltage below its threshold for a while, mains off where configured, or at once
/// when a line signals it.
#[derive(Clone, Debug)]
pub struct PowerWatch {
    low_voltage_v: Option<f64>,
    on_mains_off: bool,
    low_for: u32,
}

/// Number of consecutive low readings that are required: a motor's inrush current lowers the supply for a moment.
const LOW_READINGS: u32 = 3;
/// Ratio to the threshold above which the alarm ends.
const RECOVERED: f64 = 1.02;

/// The judgement of a reading.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum PowerState {
    /// Sufficient, or not known.
    Good,
    /// Failing: the flight must be closed.
    Going,
}

impl PowerWatch {
    /// A watch with a threshold in volts (`None`: voltage is not watched), and whether mains going off line counts.
    pub const fn new(low_voltage_v: Option<f64>, on_mains_off: bool) -> Self {
        Self { low_voltage_v, on_mains_off, low_for: 0 }
    }

    /// Judges a reading, one each second.
    pub fn judge(&mut self, reading: &PowerReading) -> PowerState {
        let low = match (self.low_voltage_v, reading.voltage_v) {
            (Some(limit), Some(volts)) if volts < limit => true,
            (Some(limit), Some(volts)) => self.low_for >= LOW_READINGS && volts < limit * RECOVERED,
            _ => false,
        };
        if low || (self.on_mains_off && reading.mains_off) {
            self.low_for = self.low_for.saturating_add(1);
        } else {
            self.low_for = 0;
        }
        if reading.line_set {
            return PowerState::Going;
        }
        if self.low_for >= LOW_READINGS { PowerState::Going } else { PowerState::Good }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(root: &Path, file: &str, content: &str) {
        let path = root.join(file);
        std::fs::create_dir_all(path.parent().expect("below the root")).expect("created");
        std::fs::write(path, content).expect("written");
    }

    #[test]
    fn sysfs_is_read_and_absence_is_none() {
        let root = tempfile::tempdir().expect("a folder");
        let reader = PowerReader::new(root.path(), None, None);
        assert_eq!(reader.read(), PowerReading::default());

        write(root.path(), "class/hwmon/hwmon0/temp1_input", "41500\n");
        write(root.path(), "class/hwmon/hwmon1/temp1_input", "63000\n");
        write(root.path(), "class/hwmon/hwmon1/temp2_input", "-128000\n");
        write(root.path(), "class/power_supply/BAT0/type", "Battery\n");
        write(root.path(), "class/power_supply/BAT0/voltage_now", "11400000\n");
        write(root.path(), "class/power_supply/BAT0/capacity", "57\n");
        write(root.path(), "class/power_supply/AC/type", "Mains\n");
        write(root.path(), "class/power_supply/AC/online", "0\n");
        let reading = reader.read();
        assert_eq!(reading.temperature_c, Some(63.0));
        assert_eq!((reading.voltage_v, reading.charge_percent), (Some(11.4), Some(57.0)));
        assert!(reading.mains_off);

        write(root.path(), "class/hwmon/hwmon0/in1_input", "12100\n");
        let chip = root.path().join("class/hwmon/hwmon0/in1_input");
        let named = PowerReader::new(root.path(), Some(chip), None);
        assert_eq!(named.read().voltage_v, Some(12.1));
    }

    #[test]
    fn a_line_that_is_set_and_a_ups_on_battery_are_seen() {
        let root = tempfile::tempdir().expect("a folder");
        let flag = root.path().join("gpio17/value");
        let reader = PowerReader::new(root.path(), None, Some(flag));
        let mut watch = PowerWatch::new(None, true);
        assert_eq!(
            watch.judge(&reader.read()),
            PowerState::Good,
            "without the file there is no power failure"
        );
        write(root.path(), "gpio17/value", "0\n");
        assert_eq!(watch.judge(&reader.read()), PowerState::Good);
        write(root.path(), "gpio17/value", "1\n");
        assert_eq!(watch.judge(&reader.read()), PowerState::Going, "at once");
        write(root.path(), "gpio17/value", "0\n");
        assert_eq!(watch.judge(&reader.read()), PowerState::Good);

        write(root.path(), "class/power_supply/ups0/type", "UPS\n");
        write(root.path(), "class/power_supply/ups0/status", "Charging\n");
        assert!(!reader.read().mains_off);
        write(root.path(), "class/power_supply/ups0/status", "Discharging\n");
        assert!(reader.read().mains_off);
    }

    #[test]
    fn power_goes_when_the_voltage_stays_low() {
        let at = |volts| PowerReading { voltage_v: Some(volts), ..PowerReading::default() };
        let mut watch = PowerWatch::new(Some(10.5), false);
        let volts = [11.0, 10.0, 11.0, 10.4, 10.4, 10.4, 10.6, 10.8];
        let going: Vec<bool> = volts.iter().map(|&v| watch.judge(&at(v)) == PowerState::Going).collect();
        assert_eq!(going, [false, false, false, false, false, true, true, false]);
        let mut unwatched = PowerWatch::new(None, false);
        assert!((0..9).all(|_| unwatched.judge(&at(1.0)) == PowerState::Good));
    }
}
