//! Health as OpenMetrics, for Prometheus and compatible programs (<https://github.com/prometheus/OpenMetrics>, version
//! 1.0).

use std::fmt::Write as _;

use crate::io::proto::windhover::{Health, TrackStatus};

/// The content type of answers.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The state of one payload.
#[derive(Clone, Debug)]
pub struct PayloadMetrics<'a> {
    /// Its name; empty where the payload itself answers.
    pub payload: &'a str,
    /// Its latest health.
    pub health: &'a Health,
    /// Its age, where a station answers for the payload.
    pub age_s: Option<f64>,
    /// Whether it is connected, and the round-trip time, where there is a link.
    pub link: Option<(bool, f64)>,
}

/// Labels and a value.
type Sample = (Vec<(&'static str, String)>, f64);

/// One kind of value: name, gauge or counter, description, source.
struct Family {
    name: &'static str,
    kind: &'static str,
    help: &'static str,
    samples: fn(&PayloadMetrics<'_>) -> Vec<Sample>,
}

const FAMILIES: &[Family] = &[
    gauge("windhover_health_age_seconds", "Age of all values of the payload.", |t| one(t.age_s)),
    gauge("windhover_link_up", "Whether the payload is connected.", |t| {
        one(t.link.map(|(up, _)| f64::from(u8::from(up))))
    }),
    gauge("windhover_link_round_trip_seconds", "Round-trip time to the payload.", |t| {
        one(t.link.map(|(_, ms)| ms * 1e-3))
    }),
    gauge("windhover_source_rate_hertz", "Messages of a source in the last second.", |t| {
        sources(t, |s| Some(s.rate_hz))
    }),
    gauge("windhover_source_age_seconds", "Age of a source's last message; absent before the first.", |t| {
        sources(t, |s| (s.age_ms >= 0.0).then_some(s.age_ms * 1e-3))
    }),
    counter("windhover_source_messages", "Messages of a source.", |t| sources(t, |s| Some(s.total as f64))),
    counter("windhover_source_refused", "Messages of a source that were refused.", |t| {
        sources(t, |s| Some(s.refused as f64))
    }),
    counter("windhover_source_dropped", "Messages of a source lost before they were recorded.", |t| {
        sources(t, |s| Some(s.dropped as f64))
    }),
    counter("windhover_measurements", "Measurements by their disposition in the filter.", |t| {
        let of = |(what, count): (&String, &u64)| (vec![("disposition", what.clone())], *count as f64);
        t.health.dispositions.iter().map(of).collect()
    }),
    gauge("windhover_gps_fix_dimensions", "0 no fix, 2 or 3 dimensions.", |t| one(Some(t.health.fix.into()))),
    gauge("windhover_gps_satellites", "Satellites used.", |t| one(Some(t.health.sats.into()))),
    gauge("windhover_clock_sigma_seconds", "One sigma of the fit from UTC to host time.", |t| {
        one(Some(t.health.clock_sigma_ms).filter(|ms| *ms >= 0.0).map(|ms| ms * 1e-3))
    }),
    gauge("windhover_target_status", "1 for the present status.", |t| {
        let all = [
            (TrackStatus::Lost, "lost"),
            (TrackStatus::Acquiring, "acquiring"),
            (TrackStatus::Tracking, "tracking"),
            (TrackStatus::Coasting, "coasting"),
        ];
        let of = |(target, (status, word)): (&crate::io::proto::windhover::TargetHealth, _)| {
            let holds = f64::from(u8::from(target.status() == status));
            (vec![("target", target.name.clone()), ("status", String::from(word))], holds)
        };
        t.health.targets.iter().flat_map(|target| all.map(|status| (target, status))).map(of).collect()
    }),
    gauge(
        "windhover_target_frames_seen",
        "Frames of the last second in which a marker of the target was seen.",
        |t| {
            let of = |target: &crate::io::proto::windhover::TargetHealth| {
                (vec![("target", target.name.clone())], f64::from(target.frames_seen))
            };
            t.health.targets.iter().map(of).collect()
        },
    ),
    gauge("windhover_target_sigma", "One sigma of a target's state, in metres, radians and seconds.", sigmas),
    gauge("windhover_misfits", "Present misfits of the configuration.", |t| {
        one(Some(t.health.misfits.len() as f64))
    }),
    gauge(
        "windhover_figure",
        "Values of the daemon: card, link, temperature, latency; the name gives the unit.",
        |t| {
            let of = |(name, figure): (&String, &f64)| (vec![("name", name.clone())], *figure);
            let mut all: Vec<Sample> = t.health.figures.iter().map(of).collect();
            all.sort_by(|a, b| a.0.cmp(&b.0));
            all
        },
    ),
];

const fn gauge(
    name: &'static str,
    help: &'static str,
    samples: fn(&PayloadMetrics<'_>) -> Vec<Sample>,
) -> Family {
    Family { name, kind: "gauge", help, samples }
}

const fn counter(
    name: &'static str,
    help: &'static str,
    samples: fn(&PayloadMetrics<'_>) -> Vec<Sample>,
) -> Family {
    Family { name, kind: "counter", help, samples }
}

fn one(figure: Option<f64>) -> Vec<Sample> {
    figure.into_iter().map(|figure| (Vec::new(), figure)).collect()
}

fn sources(
    payload: &PayloadMetrics<'_>,
    of: fn(&crate::io::proto::windhover::SourceHealth) -> Option<f64>,
) -> Vec<Sample> {
    let sample = |s| {
        let s: &crate::io::proto::windhover::SourceHealth = s;
        Some((vec![("source", s.name.clone())], of(s)?))
    };
    payload.health.sources.iter().filter_map(sample).collect()
}

/// One sigmas, from the covariance's diagonal.
fn sigmas(payload: &PayloadMetrics<'_>) -> Vec<Sample> {
    const DIAGONAL: [(usize, &str); 5] =
        [(0, "north_m"), (5, "east_m"), (9, "heading_rad"), (12, "speed_mps"), (14, "yaw_rate_radps")];
    let mut all = Vec::new();
    for target in &payload.health.targets {
        let covariance = target.state.as_ref().map_or(&[][..], |state| &state.covariance);
        for (at, figure) in DIAGONAL {
            if let Some(variance) = covariance.get(at).filter(|variance| **variance >= 0.0) {
                let labels = vec![("target", target.name.clone()), ("figure", figure.to_owned())];
                all.push((labels, variance.sqrt()));
            }
        }
    }
    all
}

/// The text of all payloads.
pub fn render(payloads: &[PayloadMetrics<'_>]) -> String {
    let mut text = String::new();
    for Family { name, kind, help, samples } in FAMILIES {
        let mut head = false;
        for payload in payloads {
            for (mut labels, figure) in samples(payload) {
                if !figure.is_finite() {
                    continue;
                }
                if !std::mem::replace(&mut head, true) {
                    // Writing into a String cannot fail.
                    let _ = write!(text, "# TYPE {name} {kind}\n# HELP {name} {help}\n");
                }
                if !payload.payload.is_empty() {
                    labels.insert(0, ("payload", payload.payload.to_owned()));
                }
                let suffix = if *kind == "counter" { "_total" } else { "" };
                let _ = writeln!(text, "{name}{suffix}{} {figure}", braced(&labels));
            }
        }
    }
    text + "# EOF\n"
}

fn braced(labels: &[(&str, String)]) -> String {
    if labels.is_empty() {
        return String::new();
    }
    let escaped = |value: &str| value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
    let all: Vec<String> =
        labels.iter().map(|(name, value)| format!("{name}=\"{}\"", escaped(value))).collect();
    format!("{{{}}}", all.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::proto::windhover::SourceHealth;

    #[test]
    fn families_are_whole_and_labels_escaped() {
        let source = |name: &str, age_ms| SourceHealth {
            name: name.into(),
            rate_hz: 5.0,
            age_ms,
            total: 7,
            ..Default::default()
        };
        let health =
            Health { sources: vec![source("gps", 120.0), source("a\"b\n", -1.0)], ..Default::default() };
        let payload = |payload| PayloadMetrics { payload, health: &health, age_s: None, link: None };
        let text = render(&[payload("one"), payload("two")]);
        assert_eq!(text.matches("# TYPE windhover_source_rate_hertz gauge\n").count(), 1);
        assert!(
            text.contains("windhover_source_messages_total{payload=\"two\",source=\"gps\"} 7\n"),
            "{text}"
        );
        assert!(text.contains("{payload=\"one\",source=\"a\\\"b\\n\"} 5\n"), "{text}");
        assert_eq!(text.matches("windhover_source_age_seconds{").count(), 2, "{text}");
        assert!(text.ends_with("# EOF\n") && !text.contains("link_up"));
        assert!(
            render(&[PayloadMetrics { payload: "", ..payload("one") }])
                .contains("windhover_gps_satellites 0\n")
        );
    }
}
