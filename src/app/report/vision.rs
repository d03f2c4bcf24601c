//! Vision: markers, features, and image quality.

use std::collections::BTreeMap;

use super::page::{Section, figure, grid, table};
use super::pictures::Pictures;
use super::sensors::quantile;
use super::{Context, cloud, line};
use crate::io::proto::windhover as wh;
use crate::plot::{Ink, Mark};

/// The section; empty without frames.
pub(super) fn section(context: &Context<'_>, pictures: &Pictures) -> Option<Section> {
    let flight = context.flight;
    if flight.detections.is_empty() && pictures.quality.is_empty() {
        return None;
    }
    let mut body = String::new();
    let mut charts = String::new();
    let markers = by_marker(&flight.detections);
    if !markers.is_empty() {
        body += &marker_table(&markers, flight.frames.len().max(flight.detections.len()));
        charts += &marker_chart(context, &markers, "Size of markers in the image", "px", |m| m.size_px);
        charts += &marker_chart(context, &markers, "Contrast of tags (margin)", "grey levels", |m| {
            f64::from(m.margin)
        });
    }
    let features: Vec<[f64; 2]> = flight
        .detections
        .iter()
        .map(|d| [flight.at(d.timestamp.as_ref()), d.features.len() as f64])
        .collect();
    if features.iter().any(|p| p[1] > 0.0) {
        let most = features.iter().map(|p| p[1]).fold(0.0, f64::max);
        let mut chart = context.chart("Ground features followed", "").y_range(0.0, most + 1.0);
        chart.mark(line(&features), Ink::Orange);
        charts += &figure(&chart.render());
    }
    charts += &quality_charts(context, pictures);
    body += &grid(&charts);
    Some(Section { id: "vision", title: "Camera", body })
}

type Sightings<'a> = BTreeMap<String, Vec<(&'a wh::Detections, &'a wh::Marker)>>;

fn by_marker(detections: &[wh::Detections]) -> Sightings<'_> {
    let mut markers = Sightings::new();
    for d in detections {
        for m in &d.markers {
            let name = match m.kind.as_str() {
                "apriltag" => format!("tag {} {}", m.family, m.id),
                kind => format!("{kind} {}", m.id),
            };
            markers.entry(name).or_default().push((d, m));
        }
    }
    markers
}

fn marker_table(markers: &Sightings<'_>, frames: usize) -> String {
    let rows: Vec<Vec<String>> = markers
        .iter()
        .map(|(name, seen)| {
            let of =
                |pick: &dyn Fn(&wh::Marker) -> f64| seen.iter().map(|(_, m)| pick(m)).collect::<Vec<f64>>();
            let (size, margin) = (of(&|m| m.size_px), of(&|m| f64::from(m.margin)));
            let corrected = seen.iter().filter(|(_, m)| m.hamming > 0).count();
            vec![
                name.clone(),
                seen.len().to_string(),
                format!("{:.1} %", 100.0 * seen.len() as f64 / frames.max(1) as f64),
                format!("{:.0} – {:.0}", quantile(&size, 0.0), quantile(&size, 1.0)),
                format!("{:.0}", quantile(&margin, 0.5)),
                format!("{:.0}", quantile(&margin, 0.05)),
                corrected.to_string(),
            ]
        })
        .collect();
    let head =
        ["marker", "frames", "of all", "size px", "usual contrast", "5 % below", "with corrected bits"];
    table(&head, &rows)
}

fn marker_chart(
    context: &Context<'_>,
    markers: &Sightings<'_>,
    title: &str,
    unit: &str,
    of: fn(&wh::Marker) -> f64,
) -> String {
    let inks = [Ink::Blue, Ink::Orange, Ink::Green, Ink::Violet, Ink::Red, Ink::Grey];
    let mut chart = context.chart(title, unit);
    for (k, (name, seen)) in markers.iter().enumerate().take(inks.len()) {
        let points: Vec<[f64; 2]> =
            seen.iter().map(|(d, m)| [context.flight.at(d.timestamp.as_ref()), of(m)]).collect();
        chart.named(name.clone(), cloud(&points, 1.0), inks[k]);
    }
    chart.mark(Mark::Dots(vec![[0.0, 0.0]], 0.0), Ink::Grey);
    figure(&chart.render())
}

fn quality_charts(context: &Context<'_>, pictures: &Pictures) -> String {
    let of = |pick: fn(&super::pictures::Quality) -> f64| -> Vec<[f64; 2]> {
        pictures.quality.iter().map(|(t, q)| [context.flight.seconds(*t), pick(q)]).collect()
    };
    if pictures.quality.len() < 2 {
        return String::new();
    }
    let mut light = context.chart("Brightness of the image", "grey levels").y_range(0.0, 255.0);
    light.named("mean", super::line(&of(|q| q.mean)), Ink::Blue);
    light.named("spread (one sigma)", super::line(&of(|q| q.spread)), Ink::Orange);
    let mut charts = figure(&light.render());
    let mut sharp = context.chart("Sharpness of the image", "edge strength, grey levels");
    sharp.mark(super::line(&of(|q| q.sharpness)), Ink::Blue);
    sharp.mark(Mark::Dots(vec![[0.0, 0.0]], 0.0), Ink::Grey);
    charts += &figure(&sharp.render());
    charts
}
