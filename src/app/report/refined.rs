//! What a refinement shows about the configuration, and which measurements it rejected.

use super::Context;
use super::page::{Section, list, paragraph, table};
use crate::io::proto::windhover as wh;

/// Outliers listed.
const MOST_OUTLIERS: usize = 20;

/// The section; empty for a flight that was not refined.
pub(super) fn section(context: &Context<'_>) -> Option<Section> {
    let refined = context.flight.refined.as_ref()?;
    let mut body = paragraph(
        "Estimated from the whole flight, afterwards: constants beside the configured values, with one sigma. What the \
         flight does not determine stays near its configured value.",
    );
    let determined: Vec<Vec<String>> =
        refined.constants.iter().filter(|constant| constant.told).map(row).collect();
    if !determined.is_empty() {
        body += &table(&["constant", "unit", "found", "one sigma", "expected", "one sigma"], &determined);
    }
    let silent: Vec<&str> =
        refined.constants.iter().filter(|c| !c.told).map(|constant| constant.name.as_str()).collect();
    if !silent.is_empty() {
        body += &paragraph(&format!("Not determined by this flight: {}.", silent.join(", ")));
    }
    body += &list("", &refined.remarks);
    let rows: Vec<Vec<String>> = refined.sources.iter().map(source_row).collect();
    body += &table(&["source", "taken", "not explained", "noise over configured"], &rows);
    let outliers: Vec<Vec<String>> = refined
        .outliers
        .iter()
        .take(MOST_OUTLIERS)
        .map(|outlier| {
            let at = format!("{:.2}", context.flight.at(outlier.timestamp.as_ref()));
            vec![at, outlier.source.clone(), outlier.marker.clone(), format!("{:.1}", outlier.ratio)]
        })
        .collect();
    if !outliers.is_empty() {
        body += &table(&["at s", "source", "marker", "square over the gate"], &outliers);
    }
    Some(Section { id: "refined", title: "Configuration as the flight shows it", body })
}

fn row(constant: &wh::RefinedConstant) -> Vec<String> {
    let figure = |value: f64| format!("{value:.3}");
    vec![
        constant.name.replace('_', " "),
        constant.unit.clone(),
        figure(constant.value),
        figure(constant.sigma),
        figure(constant.expected),
        figure(constant.expected_sigma),
    ]
}

fn source_row(source: &wh::RefinedSource) -> Vec<String> {
    vec![
        source.name.replace('_', " "),
        source.taken.to_string(),
        source.outliers.to_string(),
        format!("{:.2}", source.noise_factor),
    ]
}
