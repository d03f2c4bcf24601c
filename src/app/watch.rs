//! The health task's work: readiness, watchdog, power, reload of the configuration. Nothing here blocks.

use std::collections::BTreeSet;

use tokio::sync::watch;

use super::config_file::ConfigFileError;
use super::context::TaskContext;
use super::devices;
use super::events::OperatorEvent;
use super::flight_store::StoreOrders;
use super::log::Log;
use super::power_task::{PowerView, Supply};
use super::presence::Presence;
use super::reload;
use super::status::SharedStatus;
use super::supervise::Supervisor;
use crate::config::{Config, PowerConfig};
use crate::io::camera::ExposureSettings;
use crate::io::clock::HostClock;
use crate::io::notify::ServiceManager;
use crate::io::power::{PowerState, PowerWatch};
use windhover_base::msg::SourceHealth;
use windhover_base::time::{MonoTime, Span};

/// Everything the health task keeps.
pub(super) struct Watch {
    config: Config,
    context: TaskContext,
    status: SharedStatus,
    orders: StoreOrders,
    power: PowerView,
    exposure: watch::Sender<ExposureSettings>,
    log: Log,
    ready: bool,
    missing: String,
    silent: BTreeSet<&'static str>,
    power_watch: PowerWatch,
    /// The judgement of the last reading, without the line.
    judged: PowerState,
    power_state: PowerState,
    second: Option<MonoTime>,
    processor: Span,
}

/// `not_ready` is reported only after devices had time to open.
const SETTLING: Span = Span::from_ns(3_000_000_000);

/// A change from the power task.
pub(super) enum PowerChange {
    /// A new reading of supply and temperature.
    Supply(Supply),
    /// The line that signals a power failure may have changed.
    Line,
}

impl Watch {
    pub(super) fn new(
        config: Config,
        context: TaskContext,
        log: Log,
        (status, orders, power, exposure): (
            SharedStatus,
            StoreOrders,
            PowerView,
            watch::Sender<ExposureSettings>,
        ),
    ) -> Self {
        Self {
            context,
            log,
            status,
            orders,
            power,
            exposure,
            ready: false,
            missing: String::new(),
            silent: BTreeSet::new(),
            power_watch: power_watch(&config.power),
            judged: PowerState::Good,
            power_state: PowerState::Good,
            second: None,
            processor: HostClock::processor_time(),
            config,
        }
    }

    /// One check: notifies the watchdog while every task answers.
    pub(super) fn look_round(&mut self, tasks: &Supervisor) {
        if self.all_answer(tasks) {
            ServiceManager.alive();
        }
        self.look_for_readiness();
    }

    fn all_answer(&mut self, tasks: &Supervisor) -> bool {
        let limit = Span::from_s(self.config.daemon.answer_within_s);
        let silences = tasks.silent(limit);
        for (name, silence) in &silences {
            self.silent.insert(name);
            OperatorEvent::TaskSilent.emit(name, format!("has not answered for {:.1} s", silence.s()));
        }
        let back: Vec<&str> =
            self.silent.iter().copied().filter(|name| silences.iter().all(|(s, _)| s != name)).collect();
        for name in back {
            self.silent.remove(name);
            OperatorEvent::TaskBack.emit(name, "answers again");
        }
        silences.is_empty()
    }

    fn look_for_readiness(&mut self) {
        let context = &self.context;
        let missing = Presence::words(&context.presence.missing(&self.config.optional_parts()));
        let estimating = self.status.with(|shown| shown.health.is_some());
        if missing.is_empty() && estimating {
            if !std::mem::replace(&mut self.ready, true) {
                let after = context.clock.now() - context.began;
                OperatorEvent::Ready.emit("", format!("after {:.1} s", after.s()));
                ServiceManager.ready("ready");
            }
        } else if !self.ready && missing != self.missing && context.clock.now() - context.began > SETTLING {
            OperatorEvent::NotReady.emit("", format!("waiting: {missing}"));
        } else {
            return;
        }
        self.missing = missing;
    }

    /// Waits for a change from the power task.
    pub(super) async fn power_news(&mut self) -> PowerChange {
        tokio::select! {
            Ok(()) = self.power.supply.changed() => {
                PowerChange::Supply(self.power.supply.borrow_and_update().clone())
            }
            Ok(()) = self.power.line.changed() => PowerChange::Line,
            // The power task has ended, which ends the process.
            else => std::future::pending().await,
        }
    }

    /// Handles a change from the power task.
    pub(super) fn power(&mut self, news: PowerChange) {
        if let PowerChange::Supply(supply) = news {
            self.supply(&supply);
        }
        let line_set = *self.power.line.borrow_and_update();
        let state = if line_set { PowerState::Going } else { self.judged };
        self.orders.power_going.send_if_modified(|going| {
            let goes = state == PowerState::Going;
            std::mem::replace(going, goes) != goes
        });
        if state == std::mem::replace(&mut self.power_state, state) {
            return;
        }
        let supply = self.power.supply.borrow();
        let reading = &supply.reading;
        let what = match reading.voltage_v {
            _ if line_set || reading.line_set => "the power-failure line is active".to_owned(),
            Some(volts) => format!("{volts:.2} V"),
            None => "mains off".to_owned(),
        };
        match state {
            PowerState::Going => {
                OperatorEvent::PowerGoing.emit("", format!("{what}: closing the segment"));
            }
            PowerState::Good => OperatorEvent::PowerBack.emit("", what),
        }
    }

    /// Handles a reading.
    fn supply(&mut self, supply: &Supply) {
        let reading = &supply.reading;
        let now = self.context.clock.now();
        let since = self.second.replace(now).map(|last| now - last);
        let used = HostClock::processor_time();
        let share = since.map(|since| (used - self.processor).s() / since.s() * 100.0);
        self.processor = used;
        let hot = reading.temperature_c.is_some_and(|c| c > self.config.power.hot_c);
        self.judged = self.power_watch.judge(reading);
        let going = self.judged == PowerState::Going || *self.power.line.borrow();
        self.status.with(|status| {
            let figures = &mut status.figures;
            figures.temperature_c = reading.temperature_c;
            figures.voltage_v = reading.voltage_v;
            figures.cpu_percent = share;
            figures.memory_mb = supply.memory_mb;
            figures.warn = hot || going;
        });
        if hot && let Some(celsius) = reading.temperature_c {
            let limit = self.config.power.hot_c;
            OperatorEvent::Hot.emit("", format!("{celsius:.1} °C; limit {limit:.0}"));
        }
        self.log.report_losses();
        self.show_status();
    }

    /// One line for `systemctl status`.
    fn show_status(&self) {
        let text = if self.ready {
            let health = self.status.with(|shown| shown.health.clone()).unwrap_or_default();
            let rate = |of: &SourceHealth| format!("{} {:.1} Hz", of.source.name(), of.rate_hz);
            let rates: Vec<String> = health.sources.iter().map(rate).collect();
            let targets = self.config.target.iter().zip(&health.targets);
            let targets: Vec<String> =
                targets.map(|(t, h)| format!("{} {}", t.name, h.last.status.name())).collect();
            format!("{}; {}", rates.join(", "), targets.join(", "))
        } else {
            let context = &self.context;
            format!("waiting: {}", Presence::words(&context.presence.missing(&self.config.optional_parts())))
        };
        ServiceManager.status(&text);
    }

    /// Reports that the configuration is being read again.
    pub(super) fn reloading(&self) {
        ServiceManager.reloading();
        self.log.reopen();
    }

    /// Handles the configuration that was read again: keys that can change are applied, the others are reported.
    pub(super) fn reload(&mut self, read: Result<Config, ConfigFileError>) {
        match read {
            Err(error) => OperatorEvent::ReloadRefused
                .emit("", format!("{error}; the previous configuration stays in use")),
            Ok(read) => {
                let differences = reload::differences(&self.config, &read);
                let changes = match differences.now.as_slice() {
                    [] => "no key that can change in flight has changed".to_owned(),
                    changes => changes.join(", "),
                };
                OperatorEvent::Reloaded.emit("", changes);
                if !differences.restart.is_empty() {
                    OperatorEvent::NeedsRestart.emit("", differences.restart.join(", "));
                }
                self.config = reload::merged(&self.config, &read);
                self.log.set_level(self.config.log.level);
                self.power_watch = power_watch(&self.config.power);
                self.power.settings.send_replace(self.config.power.clone());
                let exposure = devices::exposure(&self.config.camera);
                self.exposure.send_if_modified(|now| std::mem::replace(now, exposure) != exposure);
            }
        }
        if self.ready {
            ServiceManager.ready("ready");
        }
    }
}

fn power_watch(power: &PowerConfig) -> PowerWatch {
    PowerWatch::new(power.low_voltage_v, power.on_mains_off)
}
