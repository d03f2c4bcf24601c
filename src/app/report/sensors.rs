//! Sensors: rates, gaps, latency, losses, the fit of clocks.

use super::page::{Section, figure, grid, table};
use super::{Context, cloud, single};
use crate::io::proto::host_time;
use crate::plot::{Ink, Mark};
use windhover_base::time::MonoTime;

/// One stream of messages: times of validity and of reception.
pub(super) struct Stream {
    /// Its name.
    pub(super) name: &'static str,
    /// (validity, reception), in order of reception.
    pub(super) times: Vec<(MonoTime, MonoTime)>,
}

/// Statistics of a stream's times.
#[derive(Clone, Copy, Debug)]
pub(super) struct Timing {
    /// Messages a second.
    pub(super) rate_hz: f64,
    /// Median time between two messages, ms.
    pub(super) median_ms: f64,
    /// Longest time between two messages, ms, and when it began.
    pub(super) longest: (f64, MonoTime),
    /// Median and 95 % of the latency, ms.
    pub(super) latency_ms: (f64, f64),
}

/// The streams of a flight that have messages.
pub(super) fn streams(context: &Context<'_>) -> Vec<Stream> {
    let flight = context.flight;
    let of = |t: &Option<prost_types::Timestamp>, received: &Option<prost_types::Timestamp>| {
        (host_time(t.as_ref()), host_time(received.as_ref()))
    };
    let streams = [
        Stream { name: "gps", times: flight.epochs.iter().map(|e| of(&e.timestamp, &e.heard)).collect() },
        Stream {
            name: "compass",
            times: flight.attitudes.iter().map(|a| of(&a.timestamp, &a.heard)).collect(),
        },
        Stream { name: "camera", times: flight.frames.iter().map(|f| (f.t_exposure, f.t_recv)).collect() },
    ];
    streams.into_iter().filter(|s| !s.times.is_empty()).collect()
}

impl Stream {
    fn gaps_ms(&self) -> Vec<(MonoTime, f64)> {
        self.times.windows(2).map(|w| (w[0].1, (w[1].1 - w[0].1).ms())).collect()
    }

    fn latencies_ms(&self) -> Vec<f64> {
        self.times.iter().map(|(t, received)| (*received - *t).ms()).collect()
    }

    /// `None` for fewer than two messages.
    pub(super) fn timing(&self) -> Option<Timing> {
        let gaps = self.gaps_ms();
        let longest = gaps.iter().copied().max_by(|a, b| a.1.total_cmp(&b.1))?;
        let length_s = (self.times.last()?.1 - self.times.first()?.1).s();
        let sizes: Vec<f64> = gaps.iter().map(|g| g.1).collect();
        let latency = self.latencies_ms();
        Some(Timing {
            rate_hz: if length_s > 0.0 { gaps.len() as f64 / length_s } else { 0.0 },
            median_ms: quantile(&sizes, 0.5),
            longest: (longest.1, longest.0),
            latency_ms: (quantile(&latency, 0.5), quantile(&latency, 0.95)),
        })
    }
}

/// The value that this share does not exceed; NaN for no values.
pub(super) fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        n => sorted[((share * n as f64) as usize).min(n - 1)],
    }
}

/// The section; empty where nothing was received.
pub(super) fn section(context: &Context<'_>) -> Option<Section> {
    let streams = streams(context);
    if streams.is_empty() && context.flight.reads == 0 {
        return None;
    }
    let mut body = timing_table(context, &streams);
    let mut charts = String::new();
    for stream in &streams {
        charts += &gap_chart(context, stream);
    }
    charts += &latency_chart(context, &streams);
    charts += &satellite_chart(context);
    let fit: Vec<[f64; 2]> = context
        .flight
        .health
        .iter()
        .filter(|h| h.clock_sigma_ms >= 0.0)
        .map(|h| [context.flight.at(h.timestamp.as_ref()), h.clock_sigma_ms])
        .collect();
    charts += &single(context, "Fit of UTC to host time: one-sigma", "ms", &fit, Ink::Blue);
    body += &grid(&charts);
    Some(Section { id: "sensors", title: "Sensors", body })
}

fn timing_table(context: &Context<'_>, streams: &[Stream]) -> String {
    let last = context.flight.health.last();
    let rows: Vec<Vec<String>> = streams
        .iter()
        .map(|stream| {
            let health = last.and_then(|h| h.sources.iter().find(|s| s.name == stream.name));
            let count = |of: Option<u64>| of.map_or("–".to_owned(), |n| n.to_string());
            let mut row = vec![stream.name.to_owned(), stream.times.len().to_string()];
            row.extend(match stream.timing() {
                Some(t) => vec![
                    format!("{:.2}", t.rate_hz),
                    format!("{:.1}", t.median_ms),
                    format!("{:.1} at {:.1} s", t.longest.0, context.flight.seconds(t.longest.1)),
                    format!("{:.1}", t.latency_ms.0),
                    format!("{:.1}", t.latency_ms.1),
                ],
                None => vec!["–".to_owned(); 5],
            });
            row.extend([count(health.map(|h| h.refused)), count(health.map(|h| h.dropped))]);
            row
        })
        .collect();
    let head = [
        "sensor",
        "messages",
        "rate Hz",
        "usual gap ms",
        "longest gap ms",
        "latency ms",
        "95 % below",
        "refused",
        "dropped",
    ];
    table(&head, &rows)
}

fn gap_chart(context: &Context<'_>, stream: &Stream) -> String {
    let points: Vec<[f64; 2]> =
        stream.gaps_ms().into_iter().map(|(t, ms)| [context.flight.seconds(t), ms]).collect();
    if points.is_empty() {
        return String::new();
    }
    let mut chart = context.chart(&format!("Time between messages: {}", stream.name), "ms");
    chart.mark(cloud(&points, 1.2), Ink::Blue);
    chart.mark(Mark::Dots(vec![[0.0, 0.0]], 0.0), Ink::Grey);
    figure(&chart.render())
}

fn latency_chart(context: &Context<'_>, streams: &[Stream]) -> String {
    if streams.is_empty() {
        return String::new();
    }
    let mut chart = context.chart("From validity to reception", "ms");
    for (stream, ink) in streams.iter().zip([Ink::Blue, Ink::Orange, Ink::Green]) {
        let points: Vec<[f64; 2]> = stream
            .times
            .iter()
            .map(|(t, received)| [context.flight.seconds(*received), (*received - *t).ms()])
            .collect();
        chart.named(stream.name, cloud(&points, 1.0), ink);
    }
    figure(&chart.render())
}

fn satellite_chart(context: &Context<'_>) -> String {
    let flight = context.flight;
    let of = |pick: &dyn Fn(&crate::io::proto::windhover::GnssEpoch) -> Option<f64>| -> Vec<[f64; 2]> {
        flight.epochs.iter().filter_map(|e| Some([flight.at(e.timestamp.as_ref()), pick(e)?])).collect()
    };
    let satellites = of(&|e| e.sats.map(f64::from));
    let (hdop, hpe) = (of(&|e| e.hdop), of(&|e| e.hpe_m));
    if satellites.is_empty() && hdop.is_empty() && hpe.is_empty() {
        return String::new();
    }
    let mut chart = context.chart("Satellites and quality", "");
    for (name, points, ink) in [
        ("satellites", satellites, Ink::Blue),
        ("HDOP", hdop, Ink::Orange),
        ("reported error (m)", hpe, Ink::Green),
    ] {
        if !points.is_empty() {
            chart.named(name, super::line(&points), ink);
        }
    }
    figure(&chart.render())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_is_found_with_its_place() {
        let ms = |t: i64| MonoTime::from_ns(t * 1_000_000);
        let times = [0, 100, 200, 700, 800].map(|t| (ms(t), ms(t + 20))).to_vec();
        let timing = Stream { name: "gps", times }.timing().expect("five messages");
        assert_eq!((timing.longest.0, timing.longest.1), (500.0, ms(220)));
        assert_eq!((timing.median_ms, timing.latency_ms.0), (100.0, 20.0));
        assert!((timing.rate_hz - 5.0).abs() < 1e-9);
    }
}
