//! The reference of the configuration: every key with its type, default and meaning, and every value of its enums,
//! from the documentation comments of the types themselves and from the shipped configuration.

use std::collections::BTreeMap;
use std::fmt::Write;

/// Sources of all types in the configuration.
const SOURCES: [&str; 17] = [
    include_str!("../../config/mod.rs"),
    include_str!("../../config/daemon.rs"),
    include_str!("../../config/link.rs"),
    include_str!("../../config/log.rs"),
    include_str!("../../config/store.rs"),
    include_str!("../../config/video.rs"),
    include_str!("../../../crates/base/src/settings/autopilot.rs"),
    include_str!("../../../crates/base/src/settings/camera.rs"),
    include_str!("../../../crates/base/src/settings/estimator.rs"),
    include_str!("../../../crates/base/src/settings/framing.rs"),
    include_str!("../../../crates/base/src/settings/inertial.rs"),
    include_str!("../../../crates/base/src/settings/montecarlo.rs"),
    include_str!("../../../crates/base/src/settings/sensors.rs"),
    include_str!("../../../crates/base/src/settings/target.rs"),
    include_str!("../../../crates/base/src/geo/camera.rs"),
    include_str!("../../../crates/base/src/geo/rotations.rs"),
    include_str!("../../../crates/base/src/msg/family/mod.rs"),
];

/// The shipped configuration, which contains every default.
const SHIPPED: &str = include_str!("../../../config/windhover.toml");

/// Table and type of each section, in the order of the shipped configuration.
const SECTIONS: [(&str, &str); 21] = [
    ("gps", "GpsConfig"),
    ("compass", "CompassConfig"),
    ("autopilot", "AutopilotConfig"),
    ("imu", "ImuConfig"),
    ("attitude", "AttitudeConfig"),
    ("camera", "CameraConfig"),
    ("camera.intrinsics", "CameraModel"),
    ("camera.mount", "CameraMount"),
    ("ground", "GroundConfig"),
    ("datum", "Datum"),
    ("target", "TargetConfig"),
    ("target.marker", "MarkerConfig"),
    ("detector", "DetectorConfig"),
    ("estimator", "EstimatorConfig"),
    ("store", "StoreConfig"),
    ("link", "LinkConfig"),
    ("mavlink", "MavlinkConfig"),
    ("video", "VideoConfig"),
    ("log", "LogConfig"),
    ("daemon", "DaemonConfig"),
    ("power", "PowerConfig"),
];

/// The section of the error analysis, which has no part in a flight.
const ANALYSIS: (&str, &str) = ("montecarlo", "MonteCarloConfig");

/// A field of a section, or a value of an enum: its name, its type (empty for a value), its meaning.
struct Item {
    name: String,
    of_type: String,
    meaning: String,
}

/// The page as Markdown.
pub(super) fn page() -> String {
    let mut page = String::from(
        "# Configuration reference\n\nThis page is generated from the program's types by `windhover generate reference`. \
         [config/windhover.toml](../config/windhover.toml) has the same keys with further remarks. `windhover \
         check-config FILE` checks a file and prints every effective value.\n\nA key without a default has to be given where \
         its table is used; a key with “–” is optional and absent by default.\n",
    );
    for (table, of_type) in SECTIONS.into_iter().chain([ANALYSIS]) {
        section(&mut page, table, of_type);
    }
    page
}

fn section(page: &mut String, table: &str, of_type: &str) {
    let many = if table.starts_with("target") { format!("[[{table}]]") } else { format!("[{table}]") };
    let defaults = defaults_of(table);
    let items = items_of(of_type);
    // Writing into a String cannot fail.
    let _ = write!(page, "\n## `{many}`\n\n| key | type | default | meaning |\n|---|---|---|---|\n");
    for item in items.iter().filter(|item| !is_table(table, &item.name)) {
        let default = defaults.get(&item.name).map_or("–", String::as_str);
        let (kind, key) = (shown_type(&item.of_type), &item.name);
        let _ = writeln!(page, "| `{key}` | {kind} | {default} | {} |", in_cell(&item.meaning));
    }
    for item in &items {
        let values = items_of(inner(&item.of_type));
        if values.is_empty() || !values.iter().all(|value| value.of_type.is_empty()) {
            continue;
        }
        let _ = write!(page, "\n| `{}` = | meaning |\n|---|---|\n", item.name);
        for value in values {
            let _ = writeln!(page, "| `\"{}\"` | {} |", value.name, in_cell(&value.meaning));
        }
    }
}

/// Whether a field is a table with a section of its own.
fn is_table(table: &str, field: &str) -> bool {
    SECTIONS.iter().any(|(name, _)| *name == format!("{table}.{field}"))
}

fn in_cell(text: &str) -> String {
    text.replace('|', "\\|")
}

/// A Rust type in the words of TOML.
fn shown_type(of_type: &str) -> String {
    let name = inner(of_type);
    let shown = match name {
        "String" => "text",
        "f64" => "number",
        "bool" => "true, false",
        "SocketAddr" => "address:port",
        "Framing" => "text",
        "GpioLine" => "table",
        name if name.starts_with('[') => "numbers",
        name if name.starts_with(['u', 'i']) => "whole number",
        _ => "one of the values below",
    };
    if of_type.starts_with("Vec<") { format!("list: {shown}") } else { shown.to_owned() }
}

/// The type inside `Option` and `Vec`.
fn inner(of_type: &str) -> &str {
    let without = |text: &'static str| of_type.strip_prefix(text).and_then(|rest| rest.strip_suffix('>'));
    without("Option<").or_else(|| without("Vec<")).map_or(of_type, inner)
}

/// Values of a table's keys in the shipped configuration: as defaults, or “required”.
fn defaults_of(table: &str) -> BTreeMap<String, String> {
    let mut found = BTreeMap::new();
    let mut here = false;
    for line in SHIPPED.lines() {
        let active = line.trim_start_matches(['#', ' ']);
        if active.starts_with('[') {
            here = active.trim_matches(['[', ']']) == table;
        } else if let Some((key, value)) = active.split_once(" = ").filter(|_| here) {
            let (key, value) = (key.trim(), value.split("   #").next().unwrap_or(value).trim());
            // These two tables are shown as a whole behind "# ", with the defaults of their keys.
            let whole = matches!(table, "imu" | "attitude");
            if line.starts_with('#') && (whole || !line.starts_with("# ")) {
                found.entry(key.to_owned()).or_insert_with(|| format!("`{value}`"));
            } else if !line.starts_with('#') {
                found.entry(key.to_owned()).or_insert_with(|| "required".to_owned());
            }
        }
    }
    found
}

/// Fields of a struct, values of an enum, or rows of the macro that makes an enum.
fn items_of(of_type: &str) -> Vec<Item> {
    let rows = match of_type {
        "CompassFormat" => Some("compass_formats! {"),
        "TagFamily" => Some("families! {"),
        _ => None,
    };
    let marks = [format!("pub struct {of_type} {{"), format!("pub enum {of_type} {{")];
    let starts = |line: &str| rows.map_or_else(|| marks.iter().any(|mark| line == mark), |mark| line == mark);
    SOURCES.iter().find_map(|source| body_of(source, starts)).unwrap_or_default()
}

/// The items of the block after the line that `starts` finds.
fn body_of(source: &str, starts: impl Fn(&str) -> bool) -> Option<Vec<Item>> {
    let lines: Vec<&str> = source.lines().collect();
    let at = lines.iter().position(|line| starts(line))?;
    let attributes = lines[..at].iter().rev().take_while(|line| line.starts_with("#["));
    let style = attributes.filter_map(|line| quoted_after(line, "rename_all = ")).next();
    let (mut items, mut meaning, mut renamed) = (Vec::new(), String::new(), None);
    for line in lines[at + 1..].iter().take_while(|line| **line != "}") {
        let line = line.trim();
        if let Some(text) = line.strip_prefix("///") {
            meaning = format!("{meaning}{text}").trim().to_owned();
        } else if line.starts_with("#[") {
            renamed = quoted_after(line, "rename = ").or(renamed);
        } else if let Some((name, of_type)) = item(line, style.as_deref()) {
            let name = renamed.take().unwrap_or(name);
            items.push(Item { name, of_type, meaning: std::mem::take(&mut meaning) });
        }
    }
    Some(items)
}

/// Name and type of a field, or name of a value.
fn item(line: &str, style: Option<&str>) -> Option<(String, String)> {
    if let Some((name, of_type)) = line.strip_prefix("pub ").and_then(|field| field.split_once(": ")) {
        return Some((name.to_owned(), of_type.trim_end_matches(',').to_owned()));
    }
    if !line.starts_with(|c: char| c.is_ascii_uppercase()) {
        return None;
    }
    if line.contains('"') {
        return quoted_after(line, "").map(|name| (name, String::new()));
    }
    let name = line.trim_end_matches(',');
    Some((restyled(name, style), String::new()))
}

/// A variant's name as serde writes it.
fn restyled(name: &str, style: Option<&str>) -> String {
    match style {
        Some("lowercase") => name.to_lowercase(),
        Some("SCREAMING_SNAKE_CASE") => {
            let parts = name.char_indices().map(|(at, c)| {
                let gap = if at > 0 && c.is_ascii_uppercase() { "_" } else { "" };
                format!("{gap}{}", c.to_ascii_uppercase())
            });
            parts.collect()
        }
        _ => name.to_owned(),
    }
}

/// The text in the first quotation marks after `mark`.
fn quoted_after(line: &str, mark: &str) -> Option<String> {
    let rest = &line[line.find(mark)? + mark.len()..];
    let mut parts = rest.split('"');
    parts.next()?;
    parts.next().map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, FramePolicy, LandingFrame, LogFormat, LogLevel, MavlinkMessage, Part};
    use serde::de::{DeserializeOwned, IntoDeserializer, value::Error};
    use windhover_base::geo::{ImageTop, TiltConvention};
    use windhover_base::msg::TagFamily;
    use windhover_base::settings::{
        AutopilotUse, Brightness, CompassFormat, Distribution, GpsFormat, MarkerKind, PixelFormat,
        TargetModel, TiltKind,
    };

    /// Checks that the program accepts every listed value of an enum; returns their number.
    fn accepted<T: DeserializeOwned>(name: &str) -> usize {
        let values = items_of(name);
        for value in &values {
            let text: serde::de::value::StrDeserializer<'_, Error> = value.name.as_str().into_deserializer();
            assert!(T::deserialize(text).is_ok(), "{name} has no value {:?}", value.name);
            assert!(!value.meaning.is_empty(), "{name}: {:?} is not explained", value.name);
        }
        values.len()
    }

    #[test]
    fn every_listed_value_is_one() {
        assert_eq!(accepted::<CompassFormat>("CompassFormat"), CompassFormat::ALL.len());
        assert_eq!(accepted::<TagFamily>("TagFamily"), TagFamily::ALL.len());
        assert_eq!(accepted::<Part>("Part"), Part::ALL.len());
        assert_eq!(accepted::<GpsFormat>("GpsFormat"), 3);
        assert_eq!(accepted::<TiltConvention>("TiltConvention"), 4);
        assert_eq!(accepted::<TiltKind>("TiltKind"), 3);
        assert_eq!(accepted::<PixelFormat>("PixelFormat"), 14);
        assert_eq!(accepted::<ImageTop>("ImageTop"), 4);
        assert_eq!(accepted::<TargetModel>("TargetModel"), 3);
        assert_eq!(accepted::<MarkerKind>("MarkerKind"), 2);
        assert_eq!(accepted::<Brightness>("Brightness"), 2);
        assert_eq!(accepted::<AutopilotUse>("AutopilotUse"), 3);
        assert_eq!(accepted::<Distribution>("Distribution"), 2);
        assert_eq!(accepted::<FramePolicy>("FramePolicy"), 5);
        assert_eq!(accepted::<MavlinkMessage>("MavlinkMessage"), 9);
        assert_eq!(accepted::<LandingFrame>("LandingFrame"), 2);
        assert_eq!(accepted::<LogLevel>("LogLevel"), 5);
        assert_eq!(accepted::<LogFormat>("LogFormat"), 4);
    }

    #[test]
    fn every_key_of_the_effective_configuration_is_listed() {
        let page = page();
        let effective = Config::parse(SHIPPED).expect("shipped").to_toml().expect("written");
        for key in effective.lines().filter_map(|line| line.split_once(" = ")).map(|(key, _)| key) {
            assert!(page.contains(&format!("| `{key}` |")), "{key} is missing");
        }
    }

    #[test]
    fn the_page_of_the_book_is_this_one() {
        let written = include_str!("../../../docs/configuration.md");
        assert!(written == page(), "write it again: windhover generate reference docs");
    }
}
