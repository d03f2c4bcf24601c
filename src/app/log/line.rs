//! One line of the operator's log, and how it looks as text, as JSON and in the journal.

use std::fmt::Write as _;

use crate::config::LogLevel;
use windhover_base::time::{MonoTime, UtcTime};

/// A value of a field.
#[derive(Clone, PartialEq, Debug)]
pub enum Value {
    /// Words.
    Text(String),
    /// A whole number.
    Count(i64),
    /// A figure, shown with so many decimals.
    Figure(f64, usize),
    /// A figure with its one-sigma, shown as `12.34±0.05`; two fields in JSON and the journal.
    Estimate(f64, f64, usize),
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<String> for Value {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

/// One line: when, how grave, the event's fixed name, words for people, and fields.
#[derive(Clone, PartialEq, Debug)]
pub struct Line {
    /// When, host time; shown as UTC.
    pub t: MonoTime,
    /// How grave.
    pub level: LogLevel,
    /// Fixed name of the event.
    pub event: &'static str,
    /// Words for people; may be empty.
    pub message: String,
    /// Fields in the order they are shown.
    pub fields: Vec<(String, Value)>,
}

impl Line {
    /// A line without words and fields.
    pub const fn new(t: MonoTime, level: LogLevel, event: &'static str) -> Self {
        Self { t, level, event, message: String::new(), fields: Vec::new() }
    }

    /// With words for people.
    #[must_use]
    pub fn says(mut self, message: impl Into<String>) -> Self {
        self.message = message.into();
        self
    }

    /// With one more field.
    #[must_use]
    pub fn with(mut self, name: impl Into<String>, value: impl Into<Value>) -> Self {
        self.fields.push((name.into(), value.into()));
        self
    }

    /// With one more figure.
    #[must_use]
    pub fn figure(self, name: impl Into<String>, value: f64, decimals: usize) -> Self {
        self.with(name, Value::Figure(value, decimals))
    }

    /// With one more whole number.
    #[must_use]
    pub fn count(self, name: impl Into<String>, value: u64) -> Self {
        self.with(name, Value::Count(i64::try_from(value).unwrap_or(i64::MAX)))
    }

    /// logfmt with time and severity: `time=… level=info event=… msg="…" key=value …`.
    pub fn text(&self) -> String {
        format!("time={} level={} event={}", self.utc(), self.level.name(), self.logfmt())
    }

    /// The event's name, words and fields in logfmt; time and severity are left to the journal.
    pub fn logfmt(&self) -> String {
        let mut out = self.event.to_owned();
        if !self.message.is_empty() {
            out.push_str(" msg=");
            put_word(&mut out, &self.message);
        }
        for (name, value) in &self.fields {
            out.push(' ');
            out.push_str(name);
            out.push('=');
            put_word(&mut out, &shown(value));
        }
        out
    }

    /// One JSON object.
    pub fn json(&self) -> String {
        let mut object = serde_json::Map::new();
        object.insert("time".into(), self.utc().to_string().into());
        object.insert("level".into(), self.level.name().into());
        object.insert("event".into(), self.event.into());
        if !self.message.is_empty() {
            object.insert("msg".into(), self.message.clone().into());
        }
        for (name, value) in self.plain_fields() {
            object.insert(name, value);
        }
        serde_json::Value::Object(object).to_string()
    }

    /// A datagram of the journal's native protocol: `MESSAGE`, `PRIORITY`, `SYSLOG_IDENTIFIER`,
    /// `WINDHOVER_EVENT`, and each field as `WINDHOVER_NAME`.
    /// Source: systemd, "Native Journal Protocol".
    pub fn journal(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(512);
        put_journal_field(&mut out, "MESSAGE", &self.logfmt());
        put_journal_field(&mut out, "PRIORITY", priority(self.level));
        put_journal_field(&mut out, "SYSLOG_IDENTIFIER", "windhover");
        put_journal_field(&mut out, "WINDHOVER_EVENT", self.event);
        for (name, value) in self.plain_fields() {
            let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            put_journal_field(&mut out, &journal_name(&name), &text);
        }
        out
    }

    fn utc(&self) -> UtcTime {
        UtcTime::from_unix_ns(self.t.ns())
    }

    /// Fields as plain values: an estimate becomes two.
    fn plain_fields(&self) -> Vec<(String, serde_json::Value)> {
        let mut out = Vec::with_capacity(self.fields.len());
        for (name, value) in &self.fields {
            match value {
                Value::Text(text) => out.push((name.clone(), text.clone().into())),
                Value::Count(count) => out.push((name.clone(), (*count).into())),
                Value::Figure(figure, decimals) => out.push((name.clone(), rounded(*figure, *decimals))),
                Value::Estimate(figure, sigma, decimals) => {
                    out.push((name.clone(), rounded(*figure, *decimals)));
                    out.push((format!("{name}_sigma"), rounded(*sigma, *decimals)));
                }
            }
        }
        out
    }
}

fn shown(value: &Value) -> String {
    match value {
        Value::Text(text) => text.clone(),
        Value::Count(count) => count.to_string(),
        Value::Figure(figure, decimals) => format!("{figure:.decimals$}"),
        Value::Estimate(figure, sigma, decimals) => format!("{figure:.decimals$}±{sigma:.decimals$}"),
    }
}

/// A number as JSON with so many decimals; null where it is not finite.
fn rounded(figure: f64, decimals: usize) -> serde_json::Value {
    format!("{figure:.decimals$}").parse::<f64>().ok().map_or(serde_json::Value::Null, Into::into)
}

/// A logfmt word: bare where it can be, else quoted with `"` and `\` escaped and line ends as `\n`.
fn put_word(out: &mut String, text: &str) {
    let bare = !text.is_empty()
        && !text.contains(|c: char| c.is_whitespace() || c.is_control() || "\"=\\".contains(c));
    if bare {
        out.push_str(text);
        return;
    }
    out.push('"');
    for c in text.chars() {
        match c {
            '"' => out.push_str("\\\""),
            '\\' => out.push_str("\\\\"),
            '\n' => out.push_str("\\n"),
            c if c.is_control() => {
                // Writing to a string cannot fail.
                let _ = write!(out, "\\u{:04x}", u32::from(c));
            }
            c => out.push(c),
        }
    }
    out.push('"');
}

/// syslog's priorities, as the journal takes them.
const fn priority(level: LogLevel) -> &'static str {
    match level {
        LogLevel::Error => "3",
        LogLevel::Warn => "4",
        LogLevel::Info => "6",
        LogLevel::Debug | LogLevel::Trace => "7",
    }
}

/// Upper case, and nothing but letters, digits and underscores.
fn journal_name(name: &str) -> String {
    let clean = name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' });
    "WINDHOVER_".chars().chain(clean).collect()
}

fn put_journal_field(out: &mut Vec<u8>, name: &str, value: &str) {
    out.extend_from_slice(name.as_bytes());
    if value.contains('\n') {
        out.push(b'\n');
        out.extend_from_slice(&(value.len() as u64).to_le_bytes());
    } else {
        out.push(b'=');
    }
    out.extend_from_slice(value.as_bytes());
    out.push(b'\n');
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line() -> Line {
        Line::new(MonoTime::from_ns(1_795_014_245_501_000_000), LogLevel::Info, "device_up")
            .says("ready \"now\"\nor later")
            .with("source", "gps")
            .with("north_m", Value::Estimate(12.345, 0.054, 2))
            .figure("temp_c", 41.26, 1)
            .count("drops", 3)
    }

    #[test]
    fn text_is_logfmt() {
        let expected = r#"time=2026-11-18T15:04:05.501Z level=info event=device_up msg="ready \"now\"\nor later" source=gps north_m=12.35±0.05 temp_c=41.3 drops=3"#;
        assert_eq!(line().text(), expected);
    }

    #[test]
    fn json_has_numbers() {
        let object: serde_json::Value = serde_json::from_str(&line().json()).expect("JSON");
        assert_eq!(object["event"], "device_up");
        assert_eq!(object["north_m_sigma"], 0.05);
        assert_eq!(object["drops"], 3);
        assert_eq!(object["msg"], "ready \"now\"\nor later");
    }

    #[test]
    fn journal_fields_are_framed() {
        let datagram = String::from_utf8(line().journal()).expect("UTF-8");
        for part in [
            "PRIORITY=6\n",
            "WINDHOVER_EVENT=device_up\n",
            "WINDHOVER_TEMP_C=41.3\n",
            "WINDHOVER_SOURCE=gps\n",
        ] {
            assert!(datagram.contains(part), "{datagram}");
        }
        let mut framed = Vec::new();
        put_journal_field(&mut framed, "MESSAGE", "a\nb");
        assert_eq!(framed, b"MESSAGE\n\x03\0\0\0\0\0\0\0a\nb\n");
    }
}
