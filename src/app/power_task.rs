//! The power task: reads supply and temperature once a second, and waits for the line that signals a power failure.

use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::sync::watch;

use super::context::TaskContext;
use super::events::{self, OperatorEvent};
use super::supervise::Heartbeat;
use crate::config::PowerConfig;
use crate::io::device::{Report, blocking};
use crate::io::power::{PowerReader, PowerReading};
use crate::io::power_line;
use crate::io::process;

/// How often supply and temperature are read.
const READING: Duration = Duration::from_secs(1);

/// The last reading.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Supply {
    /// Supply and temperature.
    pub reading: PowerReading,
    /// Resident memory of this process, megabytes.
    pub memory_mb: Option<f64>,
}

/// The health task's side: the readings and their settings.
#[derive(Debug)]
pub struct PowerView {
    /// The current settings; a change takes effect at once.
    pub settings: watch::Sender<PowerConfig>,
    /// The last reading; updated once a second.
    pub supply: watch::Receiver<Supply>,
    /// Whether the line that signals a power failure is active.
    pub line: watch::Receiver<bool>,
}

/// What the task works with.
pub struct PowerTask {
    settings: watch::Receiver<PowerConfig>,
    supply: watch::Sender<Supply>,
    line: watch::Sender<bool>,
}

/// The task's parts, and the health task's side.
pub fn parts(config: &PowerConfig) -> (PowerTask, PowerView) {
    let (settings, settings_in_force) = watch::channel(config.clone());
    let (supply, supply_read) = watch::channel(Supply::default());
    let (line, line_level) = watch::channel(false);
    let task = PowerTask { settings: settings_in_force, supply, line };
    (task, PowerView { settings, supply: supply_read, line: line_level })
}

/// Reads and waits until a stop is requested.
pub async fn run(mut task: PowerTask, context: TaskContext, heartbeat: Heartbeat) {
    loop {
        let settings = task.settings.borrow_and_update().clone();
        let watching = async {
            tokio::join!(read(&settings, &task.supply, &heartbeat), watch_line(&settings, &task.line))
        };
        // The branch that is dropped ends first: a line can have one reader only.
        tokio::select! {
            () = context.stop.cancelled() => return,
            Ok(()) = task.settings.changed() => {}
            ((), ()) = watching => {}
        }
    }
}

/// Reads supply and temperature without end. A sensor on a slow bus blocks, so a blocking thread reads it.
async fn read(settings: &PowerConfig, supply: &watch::Sender<Supply>, heartbeat: &Heartbeat) {
    let path = |file: &Option<String>| file.as_ref().map(PathBuf::from);
    let files = (path(&settings.voltage_file), path(&settings.going_file));
    let reader = PowerReader::new(Path::new(&settings.sysfs), files.0, files.1);
    let mut round = tokio::time::interval(READING);
    round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        heartbeat.while_waiting(round.tick()).await;
        let reader = reader.clone();
        let read = move || Supply { reading: reader.read(), memory_mb: process::resident_mb() };
        supply.send_replace(blocking(read).await);
    }
}

/// Waits for changes of the line without end, where one is configured.
async fn watch_line(settings: &PowerConfig, level: &watch::Sender<bool>) {
    level.send_replace(false);
    let Some(line) = &settings.going_line else { return std::future::pending().await };
    let reports = |report| match report {
        Report::Up(text) => OperatorEvent::DeviceUp.emit("power_line", text),
        Report::Down(fault) => events::device_down("power_line", &fault),
        _ => {}
    };
    let active = |active| {
        level.send_replace(active);
    };
    match power_line::run(line, &reports, &active).await {}
}
