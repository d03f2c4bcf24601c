//! Use of the measurements: dispositions and innovations of each source.

use std::collections::BTreeMap;

use super::page::{Section, figure, grid, paragraph, table};
use super::{Context, cloud};
use crate::io::proto::windhover as wh;
use crate::plot::{Ink, Mark};
use windhover_base::msg::{Disposition, FusionSource};

/// Sources in the order of the page, with the unit and scale of their innovations.
const SOURCES: [(FusionSource, &str, f64); 10] = [
    (FusionSource::GpsPosition, "m", 1.0),
    (FusionSource::GpsVelocity, "m/s", 1.0),
    (FusionSource::CompassHeading, "°", 180.0 / std::f64::consts::PI),
    (FusionSource::CompassTilt, "°", 180.0 / std::f64::consts::PI),
    (FusionSource::AttitudeHeading, "°", 180.0 / std::f64::consts::PI),
    (FusionSource::AttitudeTilt, "°", 180.0 / std::f64::consts::PI),
    (FusionSource::ImuRate, "°/s", 180.0 / std::f64::consts::PI),
    (FusionSource::ImuForce, "m/s²", 1.0),
    (FusionSource::Marker, "px", 1.0),
    (FusionSource::Feature, "px", 1.0),
];

/// The section; empty where nothing was fused.
pub(super) fn section(context: &Context<'_>) -> Option<Section> {
    let fusion = &context.flight.fusion;
    if fusion.is_empty() {
        return None;
    }
    let mut body = paragraph(
        "Each measurement is compared with what the filter expects of it; the difference is its innovation. \
         The test ratio is the innovation squared over its gate: above 1 it lies outside and is weighed \
         down, or refused.",
    );
    body += &disposition_table(fusion);
    let mut charts = String::new();
    for (source, unit, scale) in SOURCES {
        charts += &innovation_chart(context, source, unit, scale);
    }
    body += &grid(&charts);
    Some(Section { id: "measurements", title: "Measurements", body })
}

fn disposition_table(fusion: &[wh::Fusion]) -> String {
    let mut counts: BTreeMap<&str, BTreeMap<&str, usize>> = BTreeMap::new();
    for f in fusion {
        *counts.entry(f.source.as_str()).or_default().entry(f.disposition.as_str()).or_default() += 1;
    }
    let seen: Vec<&str> = {
        let mut all: Vec<&str> = counts.values().flat_map(|c| c.keys().copied()).collect();
        all.sort_unstable_by_key(|name| (*name != Disposition::Fused.name(), *name));
        all.dedup();
        all
    };
    let mut head = vec!["source", "measurements"];
    head.extend(&seen);
    head.extend(["mean test ratio", "outside the gate"]);
    let rows: Vec<Vec<String>> = counts
        .iter()
        .map(|(source, by_kind)| {
            let of_source = || fusion.iter().filter(|f| f.source == *source && f.test_ratio.is_finite());
            let n = of_source().count().max(1) as f64;
            let mean = of_source().map(|f| f.test_ratio).sum::<f64>() / n;
            let outside = of_source().filter(|f| f.test_ratio > 1.0).count() as f64 / n;
            let mut row = vec![source.replace('_', " "), by_kind.values().sum::<usize>().to_string()];
            row.extend(seen.iter().map(|kind| by_kind.get(kind).copied().unwrap_or(0).to_string()));
            row.extend([format!("{mean:.3}"), format!("{:.1} %", 100.0 * outside)]);
            row
        })
        .collect();
    let head: Vec<String> = head.iter().map(|h| h.replace('_', " ")).collect();
    table(&head.iter().map(String::as_str).collect::<Vec<_>>(), &rows)
}

fn innovation_chart(context: &Context<'_>, source: FusionSource, unit: &str, scale: f64) -> String {
    let of_source = || context.flight.fusion.iter().filter(move |f| f.source == source.name());
    let parts: &[&str] = match source {
        FusionSource::GpsPosition | FusionSource::GpsVelocity => &["north", "east", "down"],
        FusionSource::CompassHeading | FusionSource::AttitudeHeading => &["heading"],
        FusionSource::CompassTilt | FusionSource::AttitudeTilt => &["first axis", "second axis"],
        FusionSource::ImuRate | FusionSource::ImuForce => &["forward", "right", "down"],
        FusionSource::Marker | FusionSource::Feature => &["u", "v"],
    };
    let points = |k: usize, refused: bool| -> Vec<[f64; 2]> {
        of_source()
            .filter(|f| (f.disposition == Disposition::Fused.name()) != refused)
            .filter_map(|f| Some([context.flight.at(f.timestamp.as_ref()), f.innovation.get(k)? * scale]))
            .filter(|p| p[1].is_finite())
            .collect()
    };
    let kept: Vec<Vec<[f64; 2]>> = (0..parts.len()).map(|k| points(k, false)).collect();
    let reach = {
        let mut sizes: Vec<f64> = kept.iter().flatten().map(|p| p[1].abs()).collect();
        sizes.sort_by(f64::total_cmp);
        // A few large innovations must not flatten all others.
        sizes.get(sizes.len() * 995 / 1000).copied().unwrap_or(1.0).max(1e-9) * 1.4
    };
    if of_source().next().is_none() {
        return String::new();
    }
    let title = format!("Innovation: {}", source.name().replace('_', " "));
    let mut chart = context.chart(&title, unit).y_range(-reach, reach);
    let inks = [Ink::Blue, Ink::Green, Ink::Violet];
    for (k, name) in parts.iter().enumerate().filter(|(k, _)| !kept[*k].is_empty()) {
        chart.named(*name, cloud(&kept[k], 1.0), inks[k]);
    }
    let refused: Vec<[f64; 2]> = (0..parts.len()).flat_map(|k| points(k, true)).collect();
    if !refused.is_empty() {
        // Values beyond the chart are drawn at its edge.
        let edge = 0.97 * reach;
        let clamped: Vec<[f64; 2]> = refused.iter().map(|p| [p[0], p[1].clamp(-edge, edge)]).collect();
        chart.named("down-weighted or refused", Mark::Dots(clamped, 2.0), Ink::Red);
    }
    figure(&chart.render())
}
