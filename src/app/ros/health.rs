//! State of the parts, as diagnostics and as the log.

use super::RosTranslator;
use crate::io::proto::foxglove::log::Level;
use crate::io::proto::windhover::{Health, SourceHealth, TargetHealth, TrackStatus};
use crate::io::proto::{foxglove as fox, host_time};
use crate::io::ros::{DiagnosticArray, DiagnosticStatus, Header, Log, RosRecord};
use windhover_base::msg::Source;
use windhover_base::time::MonoTime;

const OK: u8 = 0;
const WARN: u8 = 1;
const STALE: u8 = 3;

impl RosTranslator {
    /// `/diagnostics`: one status for each source, target and misfit, and one of the whole with every value of the daemon.
    pub(super) fn diagnostics(&self, health: &Health, log: MonoTime) -> RosRecord {
        let t = host_time(health.timestamp.as_ref());
        let mut status = vec![whole(health)];
        status.extend(health.sources.iter().map(source));
        status.extend(health.targets.iter().map(target));
        status.extend(health.misfits.iter().map(|misfit| DiagnosticStatus {
            level: WARN,
            name: format!("windhover: misfit of {}", misfit.source),
            message: format!("{}: {}", misfit.figure, misfit.cause),
            values: vec![pair("kind", &misfit.kind), pair("advice", &misfit.advice)],
        }));
        if let Some(helicopter) = &self.helicopter {
            status.iter_mut().for_each(|status| status.name.insert_str(0, &format!("{helicopter}/")));
        }
        RosRecord::new("/diagnostics", log, t, &DiagnosticArray { header: Header::new(t, ""), status })
    }

    /// `/rosout`
    pub(super) fn log(&self, line: fox::Log, log: MonoTime) -> RosRecord {
        let t = host_time(line.timestamp.as_ref());
        let level = match line.level() {
            Level::Unknown | Level::Debug => 10,
            Level::Info => 20,
            Level::Warning => 30,
            Level::Error => 40,
            Level::Fatal => 50,
        };
        let message = if line.message.is_empty() { line.name.clone() } else { line.message };
        let name = self
            .helicopter
            .as_ref()
            .map_or_else(|| line.name.clone(), |name| format!("{name}.{}", line.name));
        RosRecord::new("/rosout", log, t, &Log { stamp: t, level, name, message })
    }
}

fn pair(key: &str, value: impl ToString) -> (String, String) {
    (key.into(), value.to_string())
}

fn whole(health: &Health) -> DiagnosticStatus {
    let fix = match health.fix {
        0 => "no fix",
        2 => "two-dimensional fix",
        _ => "three-dimensional fix",
    };
    let mut values = vec![pair("satellites", health.sats), pair("clock_sigma_ms", health.clock_sigma_ms)];
    let measured = health.dispositions.iter().map(|(what, n)| pair(&format!("measurements_{what}"), n));
    let mut measured: Vec<_> = measured.collect();
    measured.extend(health.figures.iter().map(|(name, figure)| pair(name, figure)));
    measured.extend(health.words.iter().map(|(name, word)| pair(name, word)));
    measured.sort();
    values.extend(measured);
    let level = if health.fix == 3 { OK } else { WARN };
    DiagnosticStatus { level, name: "windhover: estimator".into(), message: fix.into(), values }
}

fn source(source: &SourceHealth) -> DiagnosticStatus {
    let limit = Source::named(&source.name).map_or(f64::INFINITY, |source| source.silent_after().ms());
    let (level, message) = match source.age_ms {
        age if age < 0.0 => (STALE, "nothing yet".to_owned()),
        age if age > limit => (STALE, format!("silent for {:.1} s", age / 1e3)),
        _ => (OK, format!("{:.1} Hz", source.rate_hz)),
    };
    let values = vec![
        pair("rate_hz", source.rate_hz),
        pair("age_ms", source.age_ms),
        pair("total", source.total),
        pair("refused", source.refused),
        pair("dropped", source.dropped),
    ];
    DiagnosticStatus { level, name: format!("windhover: {}", source.name), message, values }
}

fn target(target: &TargetHealth) -> DiagnosticStatus {
    let (level, message) = match target.status() {
        TrackStatus::Tracking => (OK, "tracking"),
        TrackStatus::Acquiring => (WARN, "acquiring"),
        TrackStatus::Coasting => (WARN, "coasting"),
        TrackStatus::Lost => (STALE, "lost"),
    };
    let values = vec![pair("frames_seen", target.frames_seen)];
    DiagnosticStatus {
        level,
        name: format!("windhover: target {}", target.name),
        message: message.into(),
        values,
    }
}
