//! Reload of the configuration: what changes at once, and what needs a restart.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use tokio::task::JoinHandle;

use super::config_file::{self, ConfigFileError, Loaded};
use crate::config::Config;
use crate::io::device::blocking;

/// A configuration file that is read on a blocking thread, as often as requested.
#[derive(Debug)]
pub struct Reloading {
    path: PathBuf,
    running: Option<JoinHandle<Result<Loaded, ConfigFileError>>>,
    /// Requested again while it was read: it may have changed since.
    again: bool,
}

impl Reloading {
    /// Reader of a file; nothing is read yet.
    pub fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), running: None, again: false }
    }

    /// Requests a read; where one is in progress, another follows it.
    pub fn ask(&mut self) {
        if self.running.is_some() {
            self.again = true;
            return;
        }
        let path = self.path.clone();
        self.running = Some(tokio::spawn(blocking(move || config_file::load_all(&path))));
    }

    /// Whether the file is being read.
    pub fn reads(&self) -> bool {
        self.running.is_some()
    }

    /// Waits until the file was read; without end where no read was requested. Nothing is lost where the future is
    /// dropped.
    pub async fn read(&mut self) -> Result<Loaded, ConfigFileError> {
        let Some(running) = &mut self.running else { return std::future::pending().await };
        let read = running.await;
        self.running = None;
        if std::mem::take(&mut self.again) {
            self.ask();
        }
        match read {
            Ok(read) => read,
            Err(error) => match error.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                // The runtime is being shut down.
                Err(_) => std::future::pending().await,
            },
        }
    }
}

/// Keys that can change in flight. A table's name stands for all its keys.
const CHANGEABLE: [&str; 12] = [
    "log.level",
    "daemon.answer_within_s",
    "daemon.optional",
    "camera.exposure_us",
    "camera.auto_max_us",
    "camera.gain",
    "power.low_voltage_v",
    "power.on_mains_off",
    "power.hot_c",
    "power.voltage_file",
    "power.going_file",
    "power.going_line",
];

/// Keys that differ between two configurations.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Differences {
    /// Those that take effect now: `key: old → new`.
    pub now: Vec<String>,
    /// Those that need a restart.
    pub restart: Vec<String>,
}

/// The differences between the running configuration and the one read again.
pub fn differences(running: &Config, read: &Config) -> Differences {
    let (old, new) = (flat(running), flat(read));
    let mut differences = Differences::default();
    let keys: std::collections::BTreeSet<&String> = old.keys().chain(new.keys()).collect();
    for key in keys {
        let (before, after) = (old.get(key), new.get(key));
        if before == after {
            continue;
        }
        let shown = |value: Option<&String>| value.cloned().unwrap_or_else(|| "unset".into());
        let text = format!("{key}: {} → {}", shown(before), shown(after));
        if CHANGEABLE.contains(&key.as_str()) {
            differences.now.push(text);
        } else {
            differences.restart.push(text);
        }
    }
    differences
}

/// The running configuration with the changeable keys of the one read again.
pub fn merged(running: &Config, read: &Config) -> Config {
    let mut merged = running.clone();
    merged.log.level = read.log.level;
    merged.daemon.answer_within_s = read.daemon.answer_within_s;
    merged.daemon.optional.clone_from(&read.daemon.optional);
    merged.camera.exposure_us = read.camera.exposure_us;
    merged.camera.auto_max_us = read.camera.auto_max_us;
    merged.camera.gain = read.camera.gain;
    merged.power.low_voltage_v = read.power.low_voltage_v;
    merged.power.on_mains_off = read.power.on_mains_off;
    merged.power.hot_c = read.power.hot_c;
    merged.power.voltage_file.clone_from(&read.power.voltage_file);
    merged.power.going_file.clone_from(&read.power.going_file);
    merged.power.going_line.clone_from(&read.power.going_line);
    merged
}

/// Every value by its dotted key, in TOML notation.
fn flat(config: &Config) -> BTreeMap<String, String> {
    let mut out = BTreeMap::new();
    if let Ok(value) = toml::Value::try_from(config) {
        put(&mut out, String::new(), &value);
    }
    out
}

fn put(out: &mut BTreeMap<String, String>, key: String, value: &toml::Value) {
    let below = |name: &str| if key.is_empty() { name.to_owned() } else { format!("{key}.{name}") };
    match value {
        toml::Value::Table(table) => {
            for (name, value) in table {
                put(out, below(name), value);
            }
        }
        toml::Value::Array(items) if items.iter().any(toml::Value::is_table) => {
            for (index, item) in items.iter().enumerate() {
                put(out, format!("{key}[{index}]"), item);
            }
        }
        value => {
            out.insert(key, value.to_string());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::LogLevel;

    #[test]
    fn what_can_change_changes_and_the_rest_is_reported() {
        let text = include_str!("../../config/windhover.toml");
        let running = Config::parse(text).expect("valid");
        let mut read = running.clone();
        read.log.level = LogLevel::Debug;
        read.gps.baud = 4800;
        read.target[0].marker[1].id = Some(7);
        read.power.low_voltage_v = Some(10.5);
        read.camera.exposure_us = Some(800.0);
        let found = differences(&running, &read);
        let now = [
            "camera.exposure_us: unset → 800.0",
            "log.level: \"info\" → \"debug\"",
            "power.low_voltage_v: unset → 10.5",
        ];
        assert_eq!(found.now, now);
        assert_eq!(found.restart, ["gps.baud: 38400 → 4800", "target[0].marker[1].id: 1 → 7"]);
        let merged = merged(&running, &read);
        assert!(differences(&merged, &read).now.is_empty());
        assert_eq!(merged.gps.baud, running.gps.baud);
    }
}
