//! The health task's round: readiness, watchdog, power, reload.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use super::config_file;
use super::events::{self, OperatorEvent as Event};
use super::presence::Presence;
use super::reload;
use super::topology::Graph;
use crate::config::Config;
use crate::io::clock::HostClock;
use crate::io::notify::ServiceManager;
use crate::io::power::{PowerReader, PowerState, PowerWatch};
use crate::io::power_line::PowerLine;
use crate::io::process;
use windhover_base::msg::Source;
use windhover_base::time::{MonoTime, Span};

/// Everything the health task keeps.
pub(super) struct Watch {
    path: PathBuf,
    config: Config,
    graph: Graph,
    ready: bool,
    began: MonoTime,
    missing: String,
    silent: BTreeSet<&'static str>,
    power: PowerReader,
    power_line: Option<PowerLine>,
    power_watch: PowerWatch,
    power_state: PowerState,
    second: Option<MonoTime>,
    processor: Span,
}

/// Not being ready is worth a line only after devices had time to be opened.
const SETTLING: Span = Span::from_ns(3_000_000_000);

impl Watch {
    pub(super) fn new(path: PathBuf, config: Config, graph: Graph) -> Self {
        let (power, power_watch) = power(&config);
        Self {
            path,
            began: graph.around.clock.now(),
            graph,
            ready: false,
            missing: String::new(),
            silent: BTreeSet::new(),
            power,
            power_line: config.power.going_line.clone().map(PowerLine::new),
            power_watch,
            power_state: PowerState::Good,
            second: None,
            processor: HostClock::processor_time(),
            config,
        }
    }

    pub(super) fn into_graph(self) -> Graph {
        self.graph
    }

    /// One round; the name of a task that ended though nobody asked it to.
    pub(super) fn look_round(&mut self) -> Result<(), &'static str> {
        if let Some(task) = self.graph.tasks.ended().first() {
            self.graph.around.log.tell(Event::TaskFailed, task.name, "ended by itself");
            return Err(task.name);
        }
        if self.all_answer() {
            ServiceManager.alive();
        }
        self.look_for_readiness();
        let now = self.graph.around.clock.now();
        if self.second.is_none_or(|last| now - last >= Span::from_s(1.0)) {
            let since = self.second.replace(now).map(|last| now - last);
            self.each_second(since);
        }
        Ok(())
    }

    fn all_answer(&mut self) -> bool {
        let log = &self.graph.around.log;
        let limit = Span::from_s(self.config.daemon.answer_within_s);
        let silences = self.graph.tasks.silent(limit);
        for (name, silence) in &silences {
            self.silent.insert(name);
            log.tell(Event::TaskSilent, name, format!("has not answered for {:.1} s", silence.s()));
        }
        let back: Vec<&str> =
            self.silent.iter().copied().filter(|name| silences.iter().all(|(s, _)| s != name)).collect();
        for name in back {
            self.silent.remove(name);
            log.tell(Event::TaskBack, name, "answers again");
        }
        silences.is_empty()
    }

    fn look_for_readiness(&mut self) {
        let around = &self.graph.around;
        let missing = Presence::words(&around.presence.missing(&self.config.daemon.optional));
        let estimating = self.graph.board.with(|shown| shown.health.is_some());
        if missing.is_empty() && estimating {
            if !std::mem::replace(&mut self.ready, true) {
                let after = around.clock.now() - self.began;
                around.log.tell(Event::Ready, "", format!("after {:.1} s", after.s()));
                ServiceManager.ready("ready");
            }
        } else if !self.ready && missing != self.missing && around.clock.now() - self.began > SETTLING {
            around.log.tell(Event::NotReady, "", format!("waiting: {missing}"));
        } else {
            return;
        }
        self.missing = missing;
    }

    fn each_second(&mut self, since: Option<Span>) {
        let mut reading = self.power.read();
        reading.line_set |= self.power_line();
        let used = HostClock::processor_time();
        let share = since.map(|since| (used - self.processor).s() / since.s() * 100.0);
        self.processor = used;
        let hot = reading.temperature_c.is_some_and(|c| c > self.config.power.hot_c);
        let state = self.power_watch.judge(&reading);
        self.graph.board.with(|shown| {
            let figures = &mut shown.figures;
            figures.temperature_c = reading.temperature_c;
            figures.voltage_v = reading.voltage_v;
            figures.cpu_percent = share;
            figures.memory_mb = process::resident_mb();
            figures.warn = hot || state == PowerState::Going;
        });
        let log = &self.graph.around.log;
        if hot && let Some(celsius) = reading.temperature_c {
            log.tell(Event::Hot, "", format!("{celsius:.1} °C; limit {:.0}", self.config.power.hot_c));
        }
        self.graph.orders.power_going.store(state == PowerState::Going, Ordering::Release);
        if state != std::mem::replace(&mut self.power_state, state) {
            let what = match reading.voltage_v {
                _ if reading.line_set => "the line that tells of it is set".to_owned(),
                Some(volts) => format!("{volts:.2} V"),
                None => "mains off".to_owned(),
            };
            match state {
                PowerState::Going => log.tell(Event::PowerGoing, "", format!("{what}: closing the segment")),
                PowerState::Good => log.tell(Event::PowerBack, "", what),
            }
        }
        self.graph.around.log.report_losses();
        self.status();
    }

    /// Whether the GPIO line that tells of power going is active; one that cannot be read is told.
    fn power_line(&mut self) -> bool {
        let Some(line) = &mut self.power_line else { return false };
        let log = &self.graph.around.log;
        match line.read() {
            Ok(reading) => {
                if reading.opened {
                    log.tell(Event::DeviceUp, "power_line", "read once a second");
                }
                reading.set
            }
            Err(fault) => {
                events::device_down("power_line", &fault);
                false
            }
        }
    }

    /// One line for `systemctl status`.
    fn status(&self) {
        let text = if self.ready {
            let health = self.graph.board.with(|shown| shown.health.clone()).unwrap_or_default();
            let rate =
                |&source: &Source| format!("{} {:.1} Hz", source.name(), health.source(source).rate_hz);
            let rates: Vec<String> = Source::ALL.iter().map(rate).collect();
            let targets = self.config.target.iter().zip(&health.targets);
            let targets: Vec<String> =
                targets.map(|(t, h)| format!("{} {}", t.name, h.last.status.name())).collect();
            format!("{}; {}", rates.join(", "), targets.join(", "))
        } else {
            let around = &self.graph.around;
            format!("waiting: {}", Presence::words(&around.presence.missing(&self.config.daemon.optional)))
        };
        ServiceManager.status(&text);
    }

    /// Reads the configuration again: what can change changes, the rest is told.
    pub(super) fn reload(&mut self) {
        ServiceManager.reloading();
        let log = &self.graph.around.log;
        log.reopen();
        match config_file::load(&self.path) {
            Err(error) => log.tell(Event::ReloadRefused, "", format!("{error}; the old one stays")),
            Ok(read) => {
                let told = reload::differences(&self.config, &read);
                log.tell(
                    Event::Reloaded,
                    "",
                    match told.now.as_slice() {
                        [] => "nothing that can change in flight has changed".to_owned(),
                        changes => changes.join(", "),
                    },
                );
                if !told.restart.is_empty() {
                    log.tell(Event::NeedsRestart, "", told.restart.join(", "));
                }
                self.config = reload::merged(&self.config, &read);
                log.set_level(self.config.log.level);
                (self.power, self.power_watch) = power(&self.config);
                // The old request ends first: a line is given to one reader.
                self.power_line = None;
                self.power_line = self.config.power.going_line.clone().map(PowerLine::new);
            }
        }
        if self.ready {
            ServiceManager.ready("ready");
        }
    }
}

fn power(config: &Config) -> (PowerReader, PowerWatch) {
    let power = &config.power;
    let path = |file: &Option<String>| file.as_ref().map(PathBuf::from);
    let reader =
        PowerReader::new(Path::new(&power.sysfs), path(&power.voltage_file), path(&power.going_file));
    (reader, PowerWatch::new(power.low_voltage_v, power.on_mains_off))
}
