//! The health line: everything an operator wants to see, once a second, on one line.

use crate::config::{Config, LogLevel};
use crate::io::records::DaemonFigures;
use windhover_base::msg::{FixKind, Health, Source, SourceHealth, TargetHealth, TrackStatus};
use windhover_base::time::Span;

use super::log::{Line, Value};

/// Figures that only a running daemon has.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Figures {
    /// Exposure to estimate, median, of the last ten seconds.
    pub latency_p50: Option<Span>,
    /// Exposure to estimate, 99 of 100.
    pub latency_p99: Option<Span>,
    /// State of the data card in a word, and its figures.
    pub card: CardFigures,
    /// State of the link in a word; empty where there is none.
    pub link: String,
    /// Temperature, degrees Celsius.
    pub temperature_c: Option<f64>,
    /// Supply voltage, volts.
    pub voltage_v: Option<f64>,
    /// Share of one core this process used in the last second, percent.
    pub cpu_percent: Option<f64>,
    /// Resident memory, megabytes.
    pub memory_mb: Option<f64>,
    /// Whether something here deserves a warning.
    pub warn: bool,
}

/// How the data card does.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct CardFigures {
    /// `ok`, `off`, `full`, `failed`, ….
    pub state: String,
    /// Free space, megabytes.
    pub free_mb: Option<f64>,
    /// Time to make a second's data safe, 99 of 100.
    pub sync_p99: Option<Span>,
    /// Messages that could not be kept since the start.
    pub dropped: u64,
}

/// A figure by its name, and the decimals it is told with.
type Number = (&'static str, Option<f64>, usize);

impl Figures {
    /// Latency, card, computer, in this order; nothing where it is not known.
    fn numbers(&self) -> [Number; 9] {
        let ms = |span: Option<Span>| span.map(|span| span.ms());
        let dropped = (self.card.dropped > 0).then_some(self.card.dropped as f64);
        [
            ("latency_p50_ms", ms(self.latency_p50), 1),
            ("latency_p99_ms", ms(self.latency_p99), 1),
            ("card_free_mb", self.card.free_mb, 0),
            ("card_sync_p99_ms", ms(self.card.sync_p99), 1),
            ("card_dropped", dropped, 0),
            ("temp_c", self.temperature_c, 1),
            ("supply_v", self.voltage_v, 2),
            ("cpu_pct", self.cpu_percent, 0),
            ("mem_mb", self.memory_mb, 0),
        ]
    }

    /// As the flight's health messages have them: figures and words by name.
    pub fn by_name(&self) -> DaemonFigures {
        let known = self.numbers().into_iter().filter_map(|(name, value, _)| Some((name.to_owned(), value?)));
        let words = [("card", &self.card.state), ("link", &self.link)];
        let said = words.into_iter().filter(|(_, word)| !word.is_empty());
        DaemonFigures {
            figures: known.collect(),
            words: said.map(|(name, word)| (name.to_owned(), word.clone())).collect(),
        }
    }
}

/// The health line; `figures` where a daemon runs, none in replay.
pub fn line(health: &Health, config: &Config, figures: Option<&Figures>) -> Line {
    let mut line = Line::new(health.t, level(health, figures), "health");
    for of_source in &health.sources {
        line = source(line, of_source);
        if of_source.source == Source::Gps {
            line = fix(line, health);
        }
    }
    for (target, name) in health.targets.iter().zip(config.target.iter().map(|t| t.name.as_str())) {
        line = of_target(line, name, target);
    }
    line = line.count("dropped", health.sources.iter().map(|s| s.dropped).sum());
    match figures {
        Some(figures) => of_daemon(line, figures),
        None => line,
    }
}

/// Normal flight is information; a silent source or a failing card is a warning.
fn level(health: &Health, figures: Option<&Figures>) -> LogLevel {
    let troubled = health.sources.iter().any(|source| source.rate_hz <= 0.0);
    if troubled || figures.is_some_and(|f| f.warn) { LogLevel::Warn } else { LogLevel::Info }
}

fn fix(line: Line, health: &Health) -> Line {
    let fix = match health.fix {
        FixKind::None => "none",
        FixKind::TwoD => "2d",
        FixKind::ThreeD => "3d",
    };
    let line = line.with("fix", fix);
    match health.sats {
        Some(sats) => line.count("sats", u64::from(sats)),
        None => line,
    }
}

/// Rate, and the age where there is one: `gps=5.0Hz/0.12s`.
fn source(line: Line, health: &SourceHealth) -> Line {
    let name = health.source.name();
    let line = line.figure(format!("{name}_hz"), health.rate_hz, 1);
    match health.age {
        Some(age) => line.figure(format!("{name}_age_s"), age.s(), 2),
        None => line,
    }
}

fn of_target(line: Line, name: &str, target: &TargetHealth) -> Line {
    let line = line
        .with(name, target.last.status.name())
        .count(format!("{name}_seen"), u64::from(target.frames_seen));
    let Some(state) = target.last.state.filter(|_| target.last.status != TrackStatus::Lost) else {
        return line;
    };
    let sigma = |index: usize| state.covariance.map_or(f64::NAN, |p| p[(index, index)].max(0.0).sqrt());
    let estimate = |value: f64, sigma: f64, decimals| match sigma.is_finite() {
        true => Value::Estimate(value, sigma, decimals),
        false => Value::Figure(value, decimals),
    };
    let heading_deg = state.heading_rad.to_degrees().rem_euclid(360.0);
    line.with("north_m", estimate(state.north_m, sigma(0), 2))
        .with("east_m", estimate(state.east_m, sigma(1), 2))
        .with("heading_deg", estimate(heading_deg, sigma(2).to_degrees(), 1))
        .with("speed_mps", estimate(state.speed_mps, sigma(3), 2))
        .with("yaw_rate_dps", estimate(state.yaw_rate_radps.to_degrees(), sigma(4).to_degrees(), 1))
}

fn of_daemon(mut line: Line, figures: &Figures) -> Line {
    let told = |line: Line, numbers: &[Number]| {
        numbers.iter().fold(line, |line, (name, value, decimals)| match value {
            Some(value) => line.figure(*name, *value, *decimals),
            None => line,
        })
    };
    let numbers = figures.numbers();
    line = told(line, &numbers[..2]);
    if !figures.card.state.is_empty() {
        line = line.with("card", figures.card.state.as_str());
    }
    line = told(line, &numbers[2..5]);
    if !figures.link.is_empty() {
        line = line.with("link", figures.link.as_str());
    }
    told(line, &numbers[5..])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flight_gets_what_the_line_tells() {
        let card = CardFigures { state: "ok".into(), free_mb: Some(812.0), ..CardFigures::default() };
        let figures = Figures { card, latency_p99: Some(Span::from_ms(31.0)), ..Figures::default() };
        let told = figures.by_name();
        let numbers: Vec<(&str, f64)> = told.figures.iter().map(|(name, value)| (&**name, *value)).collect();
        assert_eq!(numbers, [("card_free_mb", 812.0), ("latency_p99_ms", 31.0)]);
        assert_eq!(told.words.iter().map(|(a, b)| (&**a, &**b)).collect::<Vec<_>>(), [("card", "ok")]);
        let text = of_daemon(
            Line::new(windhover_base::time::MonoTime::default(), LogLevel::Info, "health"),
            &figures,
        )
        .text();
        assert!(text.contains("latency_p99_ms=31.0 card=ok card_free_mb=812"), "{text}");
    }

    #[test]
    fn a_silent_source_is_a_warning() {
        let config =
            crate::config::Config::parse(include_str!("../../config/windhover.toml")).expect("valid");
        let age = Some(Span::from_ms(120.0));
        let up = |&source: &Source| SourceHealth { rate_hz: 5.0, age, ..SourceHealth::nothing_from(source) };
        let mut health = Health { sources: Source::ALL.iter().map(up).collect(), ..Health::default() };
        let text = line(&health, &config, None);
        assert_eq!(text.level, LogLevel::Info);
        assert!(text.text().contains("gps_hz=5.0 gps_age_s=0.12 fix=none"), "{}", text.text());
        health.sources[1].rate_hz = 0.0;
        let figures = Figures { link: "off".into(), temperature_c: Some(41.3), ..Figures::default() };
        let text = line(&health, &config, Some(&figures));
        assert_eq!(text.level, LogLevel::Warn);
        assert!(text.text().contains("link=off temp_c=41.3"), "{}", text.text());
    }
}
