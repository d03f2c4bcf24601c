//! The health line: the state of every part, once a second, on one line.

use tracing::Level;

use crate::config::Config;
use crate::io::records::DaemonFigures;
use windhover_base::msg::{Health, Source, SourceHealth, TargetHealth, TrackStatus};
use windhover_base::time::{MonoTime, Span};

use super::callsite::RuntimeCallsite;
use super::events::{OperatorEvent, TARGET};

/// Values that only a running daemon has.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Figures {
    /// Exposure to estimate, median, of the last ten seconds.
    pub latency_p50: Option<Span>,
    /// Exposure to estimate, 99th percentile.
    pub latency_p99: Option<Span>,
    /// State of the data card, and its values.
    pub card: CardFigures,
    /// State of the link; empty where there is none.
    pub link: String,
    /// Where MAVLink is sent, and how many datagrams were and were not sent, as text; empty where it is off.
    pub mavlink: String,
    /// Temperature, degrees Celsius.
    pub temperature_c: Option<f64>,
    /// Supply voltage, volts.
    pub voltage_v: Option<f64>,
    /// Share of one core this process used in the last second, percent.
    pub cpu_percent: Option<f64>,
    /// Resident memory, megabytes.
    pub memory_mb: Option<f64>,
    /// Whether one of these values deserves a warning.
    pub warn: bool,
}

/// State of the data card.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct CardFigures {
    /// `ok`, `off`, `full`, `failed`, ….
    pub state: String,
    /// Name of the flight; empty while there is none.
    pub flight: String,
    /// Free space, megabytes.
    pub free_mb: Option<f64>,
    /// How long this flight has been recorded.
    pub recording: Option<Span>,
    /// How long the free space lasts at the flight's data rate.
    pub left: Option<Span>,
    /// Time to make a second's data durable, 99th percentile.
    pub sync_p99: Option<Span>,
    /// Messages that could not be stored since the start.
    pub dropped: u64,
}

impl Figures {
    /// Latency, card, computer, in this order; empty where not known.
    fn numbers(&self) -> [(&'static str, Option<f64>); 11] {
        let ms = |span: Option<Span>| span.map(|span| span.ms());
        let dropped = (self.card.dropped > 0).then_some(self.card.dropped as f64);
        [
            ("latency_p50_ms", ms(self.latency_p50)),
            ("latency_p99_ms", ms(self.latency_p99)),
            ("card_free_mb", self.card.free_mb),
            ("card_sync_p99_ms", ms(self.card.sync_p99)),
            ("card_dropped", dropped),
            ("recording_s", self.card.recording.map(|span| span.s())),
            ("card_left_s", self.card.left.map(|span| span.s())),
            ("temp_c", self.temperature_c),
            ("supply_v", self.voltage_v),
            ("cpu_pct", self.cpu_percent),
            ("mem_mb", self.memory_mb),
        ]
    }

    /// The form of the flight's health messages: numbers and texts by name.
    pub fn by_name(&self) -> DaemonFigures {
        let known = self.numbers().into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?)));
        let words = [
            ("card", &self.card.state),
            ("flight", &self.card.flight),
            ("link", &self.link),
            ("mavlink", &self.mavlink),
        ];
        let said = words.into_iter().filter(|(_, word)| !word.is_empty());
        DaemonFigures {
            figures: known.collect(),
            words: said.map(|(name, word)| (name.to_owned(), word.clone())).collect(),
        }
    }
}

/// A value of the health line.
enum Value {
    Time(i64),
    Text(String),
    Count(u64),
    Figure(f64),
}

impl Value {
    fn as_tracing(&self) -> &dyn tracing::Value {
        match self {
            Self::Time(ns) => ns,
            Self::Text(text) => text,
            Self::Count(count) => count,
            Self::Figure(figure) => figure,
        }
    }
}

/// Fields in their order, each with its value where it has one.
#[derive(Default)]
struct Fields(Vec<(String, Option<Value>)>);

impl Fields {
    fn text(&mut self, name: &str, text: Option<&str>) {
        self.0.push((name.to_owned(), text.map(|text| Value::Text(text.to_owned()))));
    }

    fn count(&mut self, name: &str, count: Option<u64>) {
        self.0.push((name.to_owned(), count.map(Value::Count)));
    }

    fn figure(&mut self, name: &str, figure: Option<f64>) {
        self.0.push((name.to_owned(), figure.map(Value::Figure)));
    }

    /// A value and its one-sigma, which is left out where it is not finite.
    fn estimate(&mut self, name: &str, figure: Option<f64>, sigma: Option<f64>) {
        self.figure(name, figure);
        self.figure(&format!("{name}_sigma"), sigma.filter(|sigma| sigma.is_finite()));
    }

    /// Rate, and the age where there is one, of a configured source.
    fn source(&mut self, source: Source, health: Option<&SourceHealth>) {
        let name = source.name();
        self.figure(&format!("{name}_hz"), health.map(|health| health.rate_hz));
        self.figure(&format!("{name}_age_s"), health.and_then(|health| health.age).map(|age| age.s()));
    }

    /// Status, values and the age of a target's last estimate at `t`.
    fn target(&mut self, name: &str, target: Option<&TargetHealth>, t: MonoTime) {
        self.text(name, target.map(|target| target.last.status.name()));
        self.count(&format!("{name}_seen"), target.map(|target| u64::from(target.frames_seen)));
        let last = target.map(|target| &target.last).filter(|last| last.status != TrackStatus::Lost);
        let state = last.and_then(|last| last.state);
        let sigma = |index: usize| Some(state?.covariance?[(index, index)].max(0.0).sqrt());
        let degrees = |radians: Option<f64>| radians.map(f64::to_degrees);
        let heading_deg = degrees(state.map(|s| s.heading_rad)).map(|heading| heading.rem_euclid(360.0));
        self.estimate("north_m", state.map(|s| s.north_m), sigma(0));
        self.estimate("east_m", state.map(|s| s.east_m), sigma(1));
        self.estimate("heading_deg", heading_deg, degrees(sigma(2)));
        self.estimate("speed_mps", state.map(|s| s.speed_mps), sigma(3));
        self.estimate("yaw_rate_dps", degrees(state.map(|s| s.yaw_rate_radps)), degrees(sigma(4)));
        let age = target.filter(|target| target.last.t_valid != MonoTime::default());
        self.figure(&format!("{name}_age_s"), age.map(|target| (t - target.last.t_valid).s()));
    }

    fn daemon(&mut self, figures: &Figures) {
        let word = |word: &'static str, text| (word, Some(text).filter(|text: &&String| !text.is_empty()));
        let numbers = figures.numbers();
        let (card, link) = (word("card", &figures.card.state), word("link", &figures.link));
        let mavlink = word("mavlink", &figures.mavlink);
        self.numbers(&numbers[..2]);
        self.text(card.0, card.1.map(String::as_str));
        self.numbers(&numbers[2..7]);
        self.text(link.0, link.1.map(String::as_str));
        self.text(mavlink.0, mavlink.1.map(String::as_str));
        self.numbers(&numbers[7..]);
    }

    fn numbers(&mut self, numbers: &[(&str, Option<f64>)]) {
        for (name, value) in numbers {
            self.figure(name, *value);
        }
    }
}

/// The health line: an event whose fields contain the names of the targets.
pub struct HealthLine {
    targets: Vec<String>,
    info: &'static RuntimeCallsite,
    warn: &'static RuntimeCallsite,
}

impl HealthLine {
    /// The line for these targets; made once.
    pub fn new(config: &Config) -> Self {
        Self::of(config.target.iter().map(|target| target.name.clone()).collect())
    }

    fn of(targets: Vec<String>) -> Self {
        let all = fields(&Health::default(), &targets, Some(&Figures::default())).0;
        let names: Vec<String> = all.into_iter().map(|(name, _)| name).collect();
        let callsite = |level| RuntimeCallsite::new(OperatorEvent::Health.name(), TARGET, level, &names);
        Self { targets, info: callsite(Level::INFO), warn: callsite(Level::WARN) }
    }

    /// Emits the line, at its own time; `figures` where a daemon runs, `None` in replay. Normal flight is information;
    /// a silent source, a misfit or a failing card is a warning.
    pub fn emit(&self, health: &Health, figures: Option<&Figures>) {
        let silent = health.sources.iter().any(|source| source.rate_hz <= 0.0);
        let troubled = silent || !health.misfits.is_empty();
        let callsite = if troubled || figures.is_some_and(|f| f.warn) { self.warn } else { self.info };
        let fields = fields(health, &self.targets, figures).0;
        let values: Vec<_> = fields.iter().map(|(_, value)| value.as_ref().map(Value::as_tracing)).collect();
        callsite.emit(&values);
    }
}

/// The fields and their values; the fields do not depend on the health.
fn fields(health: &Health, targets: &[String], figures: Option<&Figures>) -> Fields {
    let mut fields = Fields::default();
    fields.0.push(("t_ns".into(), Some(Value::Time(health.t.ns()))));
    for &source in Source::ALL {
        fields.source(source, health.sources.iter().find(|listed| listed.source == source));
        if source == Source::Gps {
            fields.text("fix", Some(health.fix.name()));
            fields.count("sats", health.sats.map(u64::from));
        }
    }
    for (number, name) in targets.iter().enumerate() {
        fields.target(name, health.targets.get(number), health.t);
    }
    let misfits: Vec<&str> = health.misfits.iter().map(|misfit| misfit.source.as_str()).collect();
    fields.text("misfit", (!misfits.is_empty()).then(|| misfits.join(", ")).as_deref());
    fields.count("dropped", Some(health.sources.iter().map(|s| s.dropped).sum()));
    if let Some(figures) = figures {
        fields.daemon(figures);
    }
    fields
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::log::tests::lines_of;
    use windhover_base::msg::{MisfitWords, TargetEstimate, TargetState};

    #[test]
    fn the_flight_gets_what_the_line_tells() {
        let card = CardFigures { state: "ok".into(), free_mb: Some(812.0), ..CardFigures::default() };
        let figures = Figures { card, latency_p99: Some(Span::from_ms(31.0)), ..Figures::default() };
        let by_name = figures.by_name();
        let numbers: Vec<(&str, f64)> =
            by_name.figures.iter().map(|(name, value)| (&**name, *value)).collect();
        assert_eq!(numbers, [("card_free_mb", 812.0), ("latency_p99_ms", 31.0)]);
        assert_eq!(by_name.words.iter().map(|(a, b)| (&**a, &**b)).collect::<Vec<_>>(), [("card", "ok")]);
        let line = HealthLine::new(&config());
        let text = lines_of(|| line.emit(&Health::default(), Some(&figures)));
        assert!(text.contains("latency_p99_ms=31.0 card=ok card_free_mb=812"), "{text}");
    }

    fn config() -> Config {
        Config::parse(include_str!("../../config/windhover.toml")).expect("valid")
    }

    #[test]
    fn a_silent_source_is_a_warning() {
        let line = HealthLine::new(&config());
        let age = Some(Span::from_ms(120.0));
        let up = |&source: &Source| SourceHealth { rate_hz: 5.0, age, ..SourceHealth::nothing_from(source) };
        let mut health = Health { sources: Source::ALL.iter().map(up).collect(), ..Health::default() };
        let text = lines_of(|| line.emit(&health, None));
        assert!(text.contains("level=info event=health gps_hz=5.0 gps_age_s=0.12 fix=none"), "{text}");
        health.sources[1].rate_hz = 0.0;
        let figures = Figures { link: "off".into(), temperature_c: Some(41.3), ..Figures::default() };
        let text = lines_of(|| line.emit(&health, Some(&figures)));
        assert!(text.contains("level=warn") && text.contains("link=off temp_c=41.3"), "{text}");
    }

    #[test]
    fn what_does_not_fit_is_named_and_a_warning() {
        let misfit = |source: &str| MisfitWords {
            source: source.into(),
            kind: "noise",
            figure: "3.0 times".into(),
            cause: "it scatters".into(),
            advice: "look".into(),
        };
        let misfits = vec![misfit("gps_velocity"), misfit("ugv tag 1")];
        let health = Health { misfits, ..Health::default() };
        let text = lines_of(|| HealthLine::new(&config()).emit(&health, None));
        assert!(text.contains("level=warn") && text.contains("misfit=\"gps_velocity, ugv tag 1\""), "{text}");
    }

    #[test]
    fn every_target_has_its_figures_with_their_sigmas() {
        let line = HealthLine::of(vec!["ugv".into(), "rover".into()]);
        let state = TargetState {
            north_m: 12.345,
            east_m: 0.0,
            heading_rad: -0.1,
            speed_mps: 2.0,
            yaw_rate_radps: 0.0,
            lat_deg: 0.0,
            lon_deg: 0.0,
            height_m: 0.0,
            relative_sigma_m: None,
            covariance: Some(nalgebra::SMatrix::from_diagonal_element(0.0025)),
        };
        let target = |number| {
            let last = TargetEstimate {
                t_valid: Default::default(),
                frame: 0,
                target: number,
                status: TrackStatus::Tracking,
                state: Some(state),
            };
            TargetHealth { last, frames_seen: 15 }
        };
        let health = Health { targets: vec![target(0), target(1)], ..Health::default() };
        let text = lines_of(|| line.emit(&health, None));
        assert!(
            text.contains(
                "ugv=tracking ugv_seen=15 north_m=12.35±0.05 east_m=0.00±0.05 heading_deg=354.3±2.9"
            ),
            "{text}"
        );
        assert!(text.contains("rover=tracking rover_seen=15 north_m=12.35±0.05"), "{text}");
    }
}
