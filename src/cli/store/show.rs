//! `windhover store list` and `show`.

use std::path::Path;

use crate::cli::CliResult;
use crate::io::store::flight::FlightInfo;
use crate::io::store::inspect::{self, Dropout};
use crate::io::store::summary::TopicStats;
use crate::io::store::volume::Volume;
use crate::io::store::wear;
use windhover_base::time::UtcTime;

/// Silences shorter than this are not worth a line.
const GAP_SHOWN_NS: u64 = 1_000_000_000;

pub(super) fn list(root: &Path, json: bool) -> CliResult {
    let (flights, errors) = inspect::list(root)?;
    let present = inspect::in_the_air(root)?;
    for error in errors {
        eprintln!("windhover: {error}");
    }
    if json {
        for info in &flights {
            println!("{}", as_json(info, present.as_deref()));
        }
        return Ok(());
    }
    println!("{:<20} {:>9} {:>9} {:>9} {:>10}  ", "FLIGHT", "DURATION", "SIZE", "SEGMENTS", "ESTIMATES");
    for info in &flights {
        let duration = info.span_ns().map_or_else(|| "-".into(), |(first, last)| span(last - first));
        let estimates = info.estimates().map_or(0, |e| e.count);
        let marks = marks(info, present.as_deref());
        let (name, bytes, segments) = (&info.name, size(info.bytes), info.segments);
        println!("{name:<20} {duration:>9} {bytes:>9} {segments:>9} {estimates:>10}  {marks}");
    }
    Ok(())
}

fn marks(info: &FlightInfo, present: Option<&str>) -> String {
    let mut marks = Vec::new();
    if present == Some(&info.name) {
        marks.push("in the air");
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
        println!("{all}");
        return Ok(());
    }
    let marks = marks(&info, present.as_deref());
    println!("{name}{}{marks}", if marks.is_empty() { "" } else { ": " });
    println!("  size       {} in {} segments", size(info.bytes), info.segments);
    if let Some((first, last)) = info.span_ns() {
        println!("  duration   {}, from {} to {}", span(last - first), stamp(first), stamp(last));
    }
    match info.estimates() {
        Some(e) => println!("  estimates  {}, from {} to {}", e.count, stamp(e.first_ns), stamp(e.last_ns)),
        None => println!("  estimates  none"),
    }
    for (key, value) in &info.metadata {
        println!("  {key:<10} {value}");
    }
    show_topics(&info);
    show_dropouts(&dropouts);
    show_wear(&info, capacity);
    Ok(())
}

fn show_topics(info: &FlightInfo) {
    if info.topics.is_empty() {
        return;
    }
    println!("\n  {:<28} {:>9} {:>8} {:>12}", "TOPIC", "MESSAGES", "HZ", "LONGEST GAP");
    for (topic, stats) in &info.topics {
        let gap = if stats.gap_ns >= GAP_SHOWN_NS {
            format!("{:.1} s at {}", stats.gap_ns as f64 * 1e-9, stamp(stats.gap_from_ns))
        } else {
            format!("{:.0} ms", stats.gap_ns as f64 * 1e-6)
        };
        println!("  {topic:<28} {:>9} {:>8.2} {gap:>12}", stats.count, rate_hz(stats));
    }
}

fn rate_hz(stats: &TopicStats) -> f64 {
    let seconds = (stats.last_ns - stats.first_ns) as f64 * 1e-9;
    if seconds > 0.0 { (stats.count - 1) as f64 / seconds } else { 0.0 }
}

fn show_dropouts(dropouts: &[Dropout]) {
    println!();
    if dropouts.is_empty() {
        println!("  nothing was dropped");
    }
    for d in dropouts {
        let count: u64 = d.messages.values().sum();
        let topics: Vec<&str> = d.messages.keys().map(String::as_str).collect();
        let length = d.to_ns.saturating_sub(d.from_ns) as f64 * 1e-9;
        println!(
            "  dropped {count} messages ({}) in {length:.1} s from {} on {}: {}",
            size(d.bytes),
            stamp(d.from_ns),
            topics.join(" "),
            d.reason
        );
    }
}

fn show_wear(info: &FlightInfo, capacity: Option<u64>) {
    let (Some((first, last)), Some(capacity)) = (info.span_ns(), capacity) else { return };
    let seconds = (last - first) as f64 * 1e-9;
    if seconds <= 0.0 {
        return;
    }
    let rate = info.bytes as f64 / seconds;
    println!(
        "\n  recording like this costs the card {} an hour; one of {}",
        size(((rate + wear::OVERHEAD_BYTES_PER_S) * 3600.0) as u64),
        size(capacity)
    );
    for cycles in [10_000.0, 100_000.0] {
        let life = wear::life(capacity, cycles, rate);
        println!("    and {cycles:>6} cycles lasts about {:.0} hours in the air", life.hours);
    }
}

/// Bytes for people.
pub(super) fn size(bytes: u64) -> String {
    match bytes as f64 {
        b if b >= 1e9 => format!("{:.2} GB", b * 1e-9),
        b if b >= 1e6 => format!("{:.1} MB", b * 1e-6),
        b => format!("{:.0} kB", b * 1e-3),
    }
}

/// A length of time for people.
fn span(ns: u64) -> String {
    let s = ns / 1_000_000_000;
    if s >= 3600 {
        format!("{}:{:02}:{:02}", s / 3600, s / 60 % 60, s % 60)
    } else {
        format!("{}:{:02}", s / 60, s % 60)
    }
}

/// Host time for people: close to UTC where the computer's clock was right.
fn stamp(ns: u64) -> String {
    let text = UtcTime::from_unix_ns(i64::try_from(ns).unwrap_or(i64::MAX)).to_string();
    text.get(11..23).unwrap_or(&text).to_owned()
}
