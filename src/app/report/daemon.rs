//! Data of the daemon alone (card, link, temperature), its notices, and the configuration.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use super::page::{Section, grid, paragraph, table};
use super::{Context, single};
use crate::io::proto::foxglove as fox;
use crate::plot::Ink;
use crate::text::xml;

/// Most notices that are listed; in a flight with more, the first ones show the fault.
const MOST_NOTICES: usize = 200;

/// Card and link.
pub(super) fn section(context: &Context<'_>) -> Option<Section> {
    let health = &context.flight.health;
    let names: BTreeSet<&String> = health.iter().flat_map(|h| h.figures.keys()).collect();
    if health.is_empty() {
        return None;
    }
    let mut body = String::new();
    if names.is_empty() {
        body += &paragraph(
            "The health messages of this recording hold no figures of card or link: it was not flown by a \
             daemon.",
        );
    }
    let mut charts = String::new();
    for name in names {
        let points: Vec<[f64; 2]> = health
            .iter()
            .filter_map(|h| Some([context.flight.at(h.timestamp.as_ref()), *h.figures.get(name)?]))
            .collect();
        charts += &single(context, &name.replace('_', " "), "", &points, Ink::Blue);
    }
    body += &grid(&charts);
    let mut words: BTreeMap<(&String, &String), (usize, f64)> = BTreeMap::new();
    for h in health {
        for pair in &h.words {
            let at = context.flight.at(h.timestamp.as_ref());
            words.entry(pair).or_insert((0, at)).0 += 1;
        }
    }
    if !words.is_empty() {
        let rows: Vec<Vec<String>> = words
            .iter()
            .map(|((name, value), (seconds, first))| {
                vec![name.replace('_', " "), (*value).clone(), seconds.to_string(), format!("{first:.0}")]
            })
            .collect();
        body += &table(&["what", "state", "seconds", "first at s"], &rows);
    }
    Some(Section { id: "daemon", title: "Card and link", body })
}

/// Notices, in order.
pub(super) fn notices(context: &Context<'_>) -> Option<Section> {
    let notices = &context.flight.notices;
    if notices.is_empty() {
        return None;
    }
    let mut body = String::from(
        "<div class=\"scroll\"><table><thead><tr><th>time s</th><th class=\"words\">what</th><th class=\"words\">in words</th></tr></thead><tbody>",
    );
    for n in notices.iter().take(MOST_NOTICES) {
        let class = match n.level() {
            fox::log::Level::Error | fox::log::Level::Fatal => "bad",
            fox::log::Level::Warning => "warn",
            _ => "",
        };
        let _ = write!(
            body,
            "<tr><td>{:.2}</td><td class=\"words {class}\">{}</td><td class=\"words\">{}</td></tr>",
            context.flight.at(n.timestamp.as_ref()),
            xml(&n.name.replace('_', " ")),
            xml(&n.message)
        );
    }
    body += "</tbody></table></div>\n";
    if notices.len() > MOST_NOTICES {
        body += &paragraph(&format!("and {} more.", notices.len() - MOST_NOTICES));
    }
    Some(Section { id: "notices", title: "Notices", body })
}

/// The configuration, collapsed.
pub(super) fn configuration(context: &Context<'_>) -> Option<Section> {
    let text = context.flight.config_text.as_ref()?;
    let body = format!(
        "<details><summary>The configuration of the flight</summary><pre>{}</pre></details>\n",
        xml(text)
    );
    Some(Section { id: "configuration", title: "Configuration", body })
}
