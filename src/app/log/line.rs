//! One line of the operator's log, made from a `tracing` event, and its forms as logfmt and as JSON.

use std::fmt::Debug;

use tracing::field::{Field, Visit};
use tracing::{Event, Metadata, Subscriber};
use tracing_log::NormalizeEvent as _;
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

use super::span::SpanFields;
use super::throttle;
use crate::app::events::{self, OperatorEvent, TARGET};
use crate::config::LogLevel;
use crate::io::clock::HostClock;
use crate::text;
use windhover_base::time::{MonoTime, UtcTime};

/// The event name for messages of libraries.
const LIBRARY: &str = "library";

/// A value of a field.
#[derive(Clone, PartialEq, Debug)]
pub(super) enum Value {
    /// Text.
    Text(String),
    /// A whole number.
    Count(i64),
    /// A number with a fraction.
    Figure(f64),
}

/// A field by its name.
pub(super) type NamedValue = (&'static str, Value);

/// One line: time, severity, the event's fixed name, a message, and fields.
#[derive(Clone, PartialEq, Debug)]
pub(super) struct Line {
    /// Its host time; shown as UTC.
    pub(super) t: MonoTime,
    /// Its severity.
    pub(super) level: LogLevel,
    /// Fixed name of the event.
    pub(super) event: &'static str,
    /// The message; may be empty.
    pub(super) message: String,
    /// Fields in the order they are shown.
    pub(super) fields: Vec<NamedValue>,
    /// Fields of the spans around it (run, flight): in JSON and the journal.
    pub(super) context: Vec<NamedValue>,
}

impl Line {
    /// The content of an event, in its context.
    pub(super) fn of<S>(event: &Event<'_>, context: &Context<'_, S>, clock: HostClock) -> Self
    where
        S: Subscriber + for<'span> LookupSpan<'span>,
    {
        let mut said = Fields::default();
        event.record(&mut said);
        let mut line = Self::new(clock.now(), LogLevel::Info, LIBRARY);
        line.message = said.message;
        if let Some(row) = OperatorEvent::of(event.metadata()) {
            let passed = throttle::passed();
            line.event = row.name();
            line.level = level(event.metadata(), true);
            line.t = said.t.or_else(|| passed.map(|passed| passed.t)).unwrap_or(line.t);
            line.fields = said.values;
            if let Some(held) = passed.map(|passed| passed.held).filter(|held| *held > 0) {
                line.fields.push(("more_like_it", count(held)));
            }
        } else {
            // Messages from the `log` crate carry their own target.
            let normal = event.normalized_metadata();
            let metadata = normal.as_ref().unwrap_or_else(|| event.metadata());
            line.level = level(metadata, metadata.target().starts_with(TARGET));
            line.fields.push(("about", Value::Text(metadata.target().to_owned())));
            line.fields.extend(said.values);
        }
        for span in context.event_scope(event).into_iter().flat_map(|scope| scope.from_root()) {
            if let Some(fields) = span.extensions().get::<SpanFields>() {
                line.context.extend(fields.0.iter().cloned());
            }
        }
        line
    }

    /// A line without message and fields.
    pub(super) const fn new(t: MonoTime, level: LogLevel, event: &'static str) -> Self {
        Self { t, level, event, message: String::new(), fields: Vec::new(), context: Vec::new() }
    }

    /// logfmt with time and severity: `time=… level=info event=… msg="…" key=value …`.
    pub(super) fn text(&self) -> String {
        format!("time={} level={} event={}", self.utc(), self.level.name(), self.logfmt())
    }

    /// The event's name, message and fields in logfmt; the journal has its own time and severity. A value and its
    /// one-sigma are one word: `12.34±0.05`.
    pub(super) fn logfmt(&self) -> String {
        let mut out = self.event.to_owned();
        if !self.message.is_empty() {
            out.push_str(" msg=");
            put_word(&mut out, &text::without_numbers(&self.message));
        }
        let mut before = "";
        for (name, value) in &self.fields {
            let sigma = name.strip_suffix("_sigma").is_some_and(|figure| figure == before);
            if sigma {
                out.push('±');
            } else {
                out.push(' ');
                out.push_str(name);
                out.push('=');
            }
            put_word(&mut out, &shown(name, value));
            before = name;
        }
        out
    }

    /// For a terminal: the subject and the message.
    pub(super) fn plain(&self) -> String {
        let about = self.fields.iter().find(|(name, _)| *name == "about");
        let about = about.map(|(name, value)| shown(name, value) + ": ").unwrap_or_default();
        text::one_line(&text::without_numbers(&(about + &self.message))).into_owned()
    }

    /// One JSON object.
    pub(super) fn json(&self) -> String {
        let mut object = serde_json::Map::new();
        object.insert("time".into(), self.utc().to_string().into());
        object.insert("level".into(), self.level.name().into());
        object.insert("event".into(), self.event.into());
        if !self.message.is_empty() {
            object.insert("msg".into(), self.message.clone().into());
        }
        for (name, value) in self.context.iter().chain(&self.fields) {
            object.insert((*name).to_owned(), plain_value(name, value));
        }
        serde_json::Value::Object(object).to_string()
    }

    fn utc(&self) -> UtcTime {
        UtcTime::from_unix_ns(self.t.ns())
    }
}

/// The level of an event. Libraries write more than operators want to read: their information is our debug level.
fn level(metadata: &Metadata<'_>, ours: bool) -> LogLevel {
    use tracing::Level;
    match *metadata.level() {
        Level::ERROR if ours => LogLevel::Error,
        Level::ERROR | Level::WARN => LogLevel::Warn,
        Level::INFO if ours => LogLevel::Info,
        Level::INFO => LogLevel::Debug,
        Level::DEBUG if ours => LogLevel::Debug,
        Level::DEBUG | Level::TRACE => LogLevel::Trace,
    }
}

/// The fields of an event or a span as they are visited.
#[derive(Default)]
pub(super) struct Fields {
    /// The message.
    pub(super) message: String,
    /// The event's own time.
    pub(super) t: Option<MonoTime>,
    /// All other fields.
    pub(super) values: Vec<NamedValue>,
}

impl Fields {
    fn put(&mut self, field: &Field, value: Value) {
        match (field.name(), value) {
            ("message", Value::Text(words)) => self.message = words,
            ("t_ns", Value::Count(ns)) => self.t = Some(MonoTime::from_ns(ns)),
            // The place in the source of a message of the `log` crate.
            (name, _) if name.starts_with("log.") => {}
            (name, value) => self.values.push((name, value)),
        }
    }
}

fn count(value: u64) -> Value {
    Value::Count(i64::try_from(value).unwrap_or(i64::MAX))
}

impl Visit for Fields {
    fn record_f64(&mut self, field: &Field, value: f64) {
        self.put(field, Value::Figure(value));
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.put(field, Value::Count(value));
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.put(field, count(value));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.put(field, Value::Text(value.to_owned()));
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        self.put(field, Value::Text(format!("{value:?}")));
    }
}

/// A value as text, a number with its field's decimals.
pub(super) fn shown(name: &str, value: &Value) -> String {
    match value {
        Value::Text(text) => text.clone(),
        Value::Count(count) => count.to_string(),
        Value::Figure(figure) => match events::decimals(name) {
            Some(decimals) => format!("{figure:.decimals$}"),
            None => figure.to_string(),
        },
    }
}

/// A value in JSON; null where a number is not finite.
fn plain_value(name: &str, value: &Value) -> serde_json::Value {
    match value {
        Value::Text(text) => text.clone().into(),
        Value::Count(count) => (*count).into(),
        Value::Figure(_) => {
            shown(name, value).parse::<f64>().ok().map_or(serde_json::Value::Null, Into::into)
        }
    }
}

/// A logfmt value: unquoted where possible, else quoted with `"` and `\` escaped and line ends as `\n`.
fn put_word(out: &mut String, word: &str) {
    let bare = !word.is_empty()
        && text::is_one_line(word)
        && !word.contains(|c: char| c.is_whitespace() || "\"=\\".contains(c));
    if bare {
        out.push_str(word);
        return;
    }
    out.push('"');
    for c in word.chars() {
        match c {
            '"' => out.push_str("\\\""),
            '\\' => out.push_str("\\\\"),
            c => text::put_shown(out, c),
        }
    }
    out.push('"');
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line() -> Line {
        Line {
            message: "ready \"now\"\nor later".into(),
            fields: vec![
                ("source", Value::Text("gps".into())),
                ("north_m", Value::Figure(12.345)),
                ("north_m_sigma", Value::Figure(0.054)),
                ("temp_c", Value::Figure(41.26)),
                ("drops", Value::Count(3)),
            ],
            context: vec![("run", Value::Count(7))],
            ..Line::new(MonoTime::from_ns(1_795_014_245_501_000_000), LogLevel::Info, "device_up")
        }
    }

    #[test]
    fn text_is_logfmt() {
        let expected = r#"time=2026-11-18T15:04:05.501Z level=info event=device_up msg="ready \"now\"\nor later" source=gps north_m=12.35±0.05 temp_c=41.3 drops=3"#;
        assert_eq!(line().text(), expected);
    }

    #[test]
    fn json_has_numbers_and_the_context() {
        let object: serde_json::Value = serde_json::from_str(&line().json()).expect("JSON");
        assert_eq!(object["event"], "device_up");
        assert_eq!(object["north_m_sigma"], 0.05);
        assert_eq!(object["drops"], 3);
        assert_eq!(object["run"], 7);
        assert_eq!(object["msg"], "ready \"now\"\nor later");
    }
}
