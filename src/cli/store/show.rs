//! `windhover store list` and `show`.

use std::path::Path;

use crate::cli::CliResult;
use crate::cli::out::{note, outln};
use crate::io::store::flight::FlightInfo;
use crate::io::store::inspect::{self, Dropout};
use crate::io::store::summary::TopicStats;
use crate::io::store::volume::Volume;
use crate::io::store::wear;
use crate::text::{counted, one_line};
use windhover_base::time::{Civil, UtcTime};

/// Gaps shorter than this are not listed.
const GAP_SHOWN_NS: u64 = 1_000_000_000;

pub(super) fn list(root: &Path, json: bool) -> CliResult {
    let (flights, errors) = inspect::list(root)?;
    let present = inspect::in_the_air(root)?;
    for error in errors {
        note!("windhover: {}", one_line(&error.to_string()));
    }
    if json {
        for info in &flights {
            outln!("{}", as_json(info, present.as_deref()))?;
        }
        return Ok(());
    }
    outln!("{:<20} {:>9} {:>9} {:>9} {:>10}  ", "FLIGHT", "DURATION", "SIZE", "SEGMENTS", "ESTIMATES")?;
    for info in &flights {
        let duration = info.span_ns().map_or_else(|| "-".into(), |(first, last)| span(last - first));
        let estimates = info.estimates().map_or(0, |e| e.count);
        let marks = marks(info, present.as_deref());
        let (name, bytes, segments) = (&info.name, size(info.bytes), info.segments);
        outln!("{name:<20} {duration:>9} {bytes:>9} {segments:>9} {estimates:>10}  {marks}")?;
    }
    Ok(())
}

fn marks(info: &FlightInfo, present: Option<&str>) -> String {
    let mut marks = Vec::new();
    if present == Some(&info.name) {
        marks.push("being recorded");
    } else if !info.closed {
        marks.push("not sealed");
    }
    if info.keep {
        marks.push("keep");
    }
    if info.repaired > 0 {
        marks.push("repaired");
    }
    marks.join(", ")
}

fn as_json(info: &FlightInfo, present: Option<&str>) -> serde_json::Value {
    let span = info.span_ns();
    let estimates = info.estimates();
    serde_json::json!({
        "flight": info.name,
        "session": info.session,
        "keep": info.keep,
        "closed": info.closed,
        "in_the_air": present == Some(&info.name),
        "segments": info.segments,
        "repaired": info.repaired,
        "bytes": info.bytes,
        "first_ns": span.map(|s| s.0),
        "last_ns": span.map(|s| s.1),
        "estimates": estimates.map_or(0, |e| e.count),
        "first_estimate_ns": estimates.map(|e| e.first_ns),
        "last_estimate_ns": estimates.map(|e| e.last_ns),
    })
}

pub(super) fn show(root: &Path, name: &str, json: bool) -> CliResult {
    let info = inspect::glance(root, name)?;
    let present = inspect::in_the_air(root)?;
    let dropouts = inspect::dropouts(root, name)?;
    let capacity = Volume::new(root).space().ok().map(|(_, total)| total);
    if json {
        let mut all = as_json(&info, present.as_deref());
        all["topics"] = serde_json::to_value(&info.topics)?;
        all["metadata"] = serde_json::to_value(&info.metadata)?;
        all["dropouts"] = serde_json::to_value(&dropouts)?;
        outln!("{all}")?;
        return Ok(());
    }
    let marks = marks(&info, present.as_deref());
    outln!("{name}{}{marks}", if marks.is_empty() { "" } else { ": " })?;
    outln!("  size       {} in {}", size(info.bytes), counted(info.segments as usize, "segment"))?;
    let clock = FlightClock::of(&info);
    let stamp = |ns| clock.stamp(ns);
    if let Some((first, last)) = info.span_ns() {
        let (length, from, to) = (span(last - first), stamp(first), stamp(last));
        outln!("  duration   {length}, from {from} to {to} {}", clock.name())?;
    }
    match info.estimates() {
        Some(e) => outln!("  estimates  {}, from {} to {}", e.count, stamp(e.first_ns), stamp(e.last_ns))?,
        None => outln!("  estimates  none")?,
    }
    for (key, value) in &info.metadata {
        outln!("  {:<10} {}", one_line(key), one_line(value))?;
    }
    show_topics(&info, &clock)?;
    show_dropouts(&dropouts, &clock)?;
    show_wear(&info, capacity)
}

fn show_topics(info: &FlightInfo, clock: &FlightClock) -> CliResult {
    if info.topics.is_empty() {
        return Ok(());
    }
    outln!("\n  {:<28} {:>9} {:>8} {:>12}", "TOPIC", "MESSAGES", "HZ", "LONGEST GAP")?;
    for (topic, stats) in &info.topics {
        let gap = if stats.gap_ns >= GAP_SHOWN_NS {
            format!("{:.1} s at {}", stats.gap_ns as f64 * 1e-9, clock.stamp(stats.gap_from_ns))
        } else {
            format!("{:.0} ms", stats.gap_ns as f64 * 1e-6)
        };
        outln!("  {topic:<28} {:>9} {:>8.2} {gap:>12}", stats.count, rate_hz(stats))?;
    }
    Ok(())
}

fn rate_hz(stats: &TopicStats) -> f64 {
    let seconds = (stats.last_ns - stats.first_ns) as f64 * 1e-9;
    if seconds > 0.0 { (stats.count - 1) as f64 / seconds } else { 0.0 }
}

fn show_dropouts(dropouts: &[Dropout], clock: &FlightClock) -> CliResult {
    outln!()?;
    if dropouts.is_empty() {
        outln!("  no data were dropped")?;
    }
    for d in dropouts {
        let count: u64 = d.messages.values().sum();
        let topics: Vec<&str> = d.messages.keys().map(String::as_str).collect();
        let length = d.to_ns.saturating_sub(d.from_ns) as f64 * 1e-9;
        outln!(
            "  dropped {count} messages ({}) in {length:.1} s from {} on {}: {}",
            size(d.bytes),
            clock.stamp(d.from_ns),
            topics.join(" "),
            d.reason
        )?;
    }
    Ok(())
}

fn show_wear(info: &FlightInfo, capacity: Option<u64>) -> CliResult {
    let (Some((first, last)), Some(capacity)) = (info.span_ns(), capacity) else { return Ok(()) };
    let seconds = (last - first) as f64 * 1e-9;
    if seconds <= 0.0 {
        return Ok(());
    }
    let rate = info.bytes as f64 / seconds;
    outln!(
        "\n  recording like this writes {} an hour to the card; one of {}",
        size(((rate + wear::OVERHEAD_BYTES_PER_S) * 3600.0) as u64),
        size(capacity)
    )?;
    for cycles in [10_000.0, 100_000.0] {
        let life = wear::life(capacity, cycles, rate);
        outln!("    and {cycles:>6} cycles lasts about {:.0} hours of recording", life.hours)?;
    }
    Ok(())
}

/// Bytes in a readable form.
pub(super) fn size(bytes: u64) -> String {
    match bytes as f64 {
        b if b >= 1e9 => format!("{:.2} GB", b * 1e-9),
        b if b >= 1e6 => format!("{:.1} MB", b * 1e-6),
        b => format!("{:.0} kB", b * 1e-3),
    }
}

/// A duration in a readable form.
fn span(ns: u64) -> String {
    let s = ns / 1_000_000_000;
    if s >= 3600 {
        format!("{}:{:02}:{:02}", s / 3600, s / 60 % 60, s % 60)
    } else {
        format!("{}:{:02}", s / 60, s % 60)
    }
}

/// Times of a flight in a readable form. A flight with a date is named after the UTC of its start, from the receiver;
/// for any other flight only host time is known.
struct FlightClock {
    /// UTC less host time, to a second.
    utc_minus_host_ns: Option<i64>,
}

impl FlightClock {
    fn of(info: &FlightInfo) -> Self {
        let first_ns = info.span_ns().and_then(|(first, _)| i64::try_from(first).ok());
        let start = utc_of_name(&info.name);
        Self { utc_minus_host_ns: start.zip(first_ns).map(|(utc, first_ns)| utc.unix_ns() - first_ns) }
    }

    fn name(&self) -> &'static str {
        if self.utc_minus_host_ns.is_some() { "UTC" } else { "host time" }
    }

    /// The time of day: of UTC to a second, of host time to a millisecond.
    fn stamp(&self, ns: u64) -> String {
        let ns = i64::try_from(ns).unwrap_or(i64::MAX);
        let (ahead_ns, end) = self.utc_minus_host_ns.map_or((0, 23), |ahead_ns| (ahead_ns, 19));
        let text = UtcTime::from_unix_ns(ns.saturating_add(ahead_ns)).to_string();
        text.get(11..end).unwrap_or(&text).to_owned()
    }
}

/// UTC of the start of a flight named `YYYYMMDDTHHMMSSZ`, with or without `-N`.
fn utc_of_name(name: &str) -> Option<UtcTime> {
    let date = name.get(..16).filter(|date| date.is_ascii() && date.ends_with('Z'))?;
    let number = |from: usize, to: usize| date[from..to].parse::<u8>().ok();
    let civil = Civil {
        year: date[..4].parse().ok()?,
        month: number(4, 6)?,
        day: number(6, 8)?,
        hour: number(9, 11)?,
        minute: number(11, 13)?,
        second: number(13, 15)?,
        nanosecond: 0,
    };
    UtcTime::from_civil(civil)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn utc_is_that_of_the_flights_name_and_host_time_is_called_so() {
        let stats =
            TopicStats { count: 2, first_ns: 1_000_000_000, last_ns: 62_500_000_000, ..Default::default() };
        let topics: std::collections::BTreeMap<String, TopicStats> =
            [("/gps/serial".to_owned(), stats)].into();
        let named =
            |name: &str| FlightInfo { name: name.into(), topics: topics.clone(), ..FlightInfo::default() };
        let dated = FlightClock::of(&named("20261118T235930Z-2"));
        assert_eq!((dated.name(), dated.stamp(62_500_000_000)), ("UTC", "00:00:31".to_owned()));
        for name in ["boot-7", "20261399T000000Z", "20261118T2359é0Z"] {
            let clock = FlightClock::of(&named(name));
            assert_eq!((clock.name(), clock.stamp(62_500_000_000)), ("host time", "00:01:02.500".to_owned()));
        }
    }
}
