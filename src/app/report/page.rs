//! The page: skeleton, style, and the elements of sections.

use std::fmt::Write as _;

use base64::Engine as _;

use crate::plot::{CHART_CSS, MADE_BY, PALETTE_CSS};
use crate::text::xml;

/// A section of the page.
pub(super) struct Section {
    /// Its anchor.
    pub(super) id: &'static str,
    /// Its title.
    pub(super) title: &'static str,
    /// Its body, HTML.
    pub(super) body: String,
}

const PAGE_CSS: &str = "\
*{box-sizing:border-box}html{scroll-behavior:smooth;-webkit-text-size-adjust:100%}\
body{margin:0;background:var(--ground);color:var(--text);font:16px/1.5 system-ui,sans-serif}\
header,main,footer{max-width:1180px;margin:0 auto;padding:0 20px}\
header{padding-top:28px}h1{font-size:1.7rem;line-height:1.2;margin:0 0 4px;overflow-wrap:anywhere}\
h2{font-size:1.2rem;margin:0 0 12px}h3{font-size:1rem;margin:20px 0 8px}\
p{margin:0 0 10px;max-width:75ch}.soft{color:var(--soft)}\
nav{position:sticky;top:0;z-index:1;background:var(--ground);border-bottom:1px solid var(--rule)}\
nav div{max-width:1180px;margin:0 auto;padding:8px 20px;display:flex;gap:4px 18px;overflow-x:auto;white-space:nowrap}\
nav a{color:var(--soft);text-decoration:none;font-size:.9rem}nav a:hover{color:var(--text)}\
section{padding:26px 0 8px;scroll-margin-top:36px}section+section{border-top:1px solid var(--rule)}\
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(140px,1fr));gap:10px;margin:14px 0}\
.tile{background:var(--panel);border:1px solid var(--rule);border-radius:8px;padding:10px 14px}\
.tile b{display:block;white-space:nowrap;font-size:1.25rem;font-weight:650;line-height:1.25;font-variant-numeric:tabular-nums}\
.tile span{color:var(--soft);font-size:.85rem}\
.grid{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,470px),1fr));gap:14px}\
figure{margin:0;background:var(--panel);border:1px solid var(--rule);border-radius:8px;padding:8px;overflow-x:auto}\
figure svg{min-width:310px}.wide svg{min-width:520px}figcaption{color:var(--soft);font-size:.85rem;padding:6px 4px 0}\
.wide{margin-bottom:14px;max-width:900px}.scroll{overflow-x:auto}\
table{border-collapse:collapse;font-size:.9rem;font-variant-numeric:tabular-nums;margin:8px 0 14px}\
th,td{text-align:right;padding:4px 12px 4px 0;border-bottom:1px solid var(--grid);white-space:nowrap}\
th{color:var(--soft);font-weight:500}th:first-child,td:first-child{text-align:left}th.words,td.words{text-align:left}td.words{white-space:normal}\
ul{margin:6px 0 12px;padding-left:20px}li{margin:3px 0;max-width:75ch}\
.good{color:var(--green)}.warn{color:var(--orange)}.bad{color:var(--red)}\
.picture{position:relative}.picture img,.picture svg{display:block;width:100%;height:auto;min-width:0}\
.picture svg{position:absolute;inset:0}\
pre{background:var(--panel);border:1px solid var(--rule);border-radius:8px;padding:12px;overflow-x:auto;font-size:.82rem}\
summary{cursor:pointer;color:var(--soft)}footer{color:var(--soft);font-size:.85rem;padding-top:20px;padding-bottom:40px}\
@media print{nav,#configuration{display:none}body{font-size:10pt}header,main,footer{padding:0}\
section{padding:16px 0 4px}h2,h3,thead,p:has(+.scroll){break-after:avoid}figure,.tile,tr{break-inside:avoid}\
.scroll{overflow:visible}table{font-size:7.5pt}th,td{padding:2px 8px 2px 0}p,li{max-width:none}\
.grid{grid-template-columns:1fr 1fr}.wide{max-width:560px}}";

/// The whole page.
pub(super) fn page(name: &str, sections: Vec<Section>) -> String {
    let name = xml(name);
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <meta name=\"generator\" content=\"report {MADE_BY}\">\
         <meta name=\"color-scheme\" content=\"light dark\"><title>Flight {name}</title>\
         <style>{PALETTE_CSS}{CHART_CSS}{PAGE_CSS}</style></head><body>\n\
         <header><p class=\"soft\">Flight report</p><h1>{name}</h1></header>\n<nav><div>"
    );
    for section in &sections {
        let _ = write!(out, "<a href=\"#{}\">{}</a>", section.id, section.title);
    }
    out.push_str("</div></nav>\n<main>\n");
    for section in &sections {
        let _ = writeln!(
            out,
            "<section id=\"{}\"><h2>{}</h2>\n{}</section>",
            section.id, section.title, section.body
        );
    }
    let _ = write!(
        out,
        "</main>\n<footer>Made by windhover {}. Bands are one sigma, ellipses hold 95 %. \
         Positions share the error of the GPS receiver, which nothing on board can see.</footer></body></html>\n",
        env!("CARGO_PKG_VERSION")
    );
    out
}

/// A chart in its frame.
pub(super) fn figure(svg: &str) -> String {
    format!("<figure>{svg}</figure>\n")
}

/// Charts side by side where there is room; empty where there is no chart.
pub(super) fn grid(figures: &str) -> String {
    if figures.is_empty() { String::new() } else { format!("<div class=\"grid\">{figures}</div>\n") }
}

/// Values with their names, in large type.
pub(super) fn tiles(tiles: &[(String, String)]) -> String {
    let one = |(value, name): &(String, String)| {
        format!("<div class=\"tile\"><b>{}</b><span>{}</span></div>", xml(value), xml(name))
    };
    format!("<div class=\"tiles\">{}</div>\n", tiles.iter().map(one).collect::<String>())
}

/// A table; cells are text.
pub(super) fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let mut out = String::from("<div class=\"scroll\"><table><thead><tr>");
    for cell in head {
        let _ = write!(out, "<th>{}</th>", xml(cell));
    }
    out.push_str("</tr></thead><tbody>");
    for row in rows {
        out.push_str("<tr>");
        for cell in row {
            let _ = write!(out, "<td>{}</td>", xml(cell));
        }
        out.push_str("</tr>");
    }
    out.push_str("</tbody></table></div>\n");
    out
}

/// A paragraph of text.
pub(super) fn paragraph(text: &str) -> String {
    format!("<p>{}</p>\n", xml(text))
}

/// A list of text.
pub(super) fn list(class: &str, items: &[String]) -> String {
    if items.is_empty() {
        return String::new();
    }
    let items: String = items.iter().map(|i| format!("<li>{}</li>", xml(i))).collect();
    format!("<ul class=\"{class}\">{items}</ul>\n")
}

/// Bytes as base 64 (RFC 4648), for pictures inside the page.
pub(super) fn base64(bytes: &[u8]) -> String {
    base64::engine::general_purpose::STANDARD.encode(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_as_the_rfc_has_it() {
        for (bytes, text) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
    }

    #[test]
    fn text_from_a_flight_cannot_become_markup() {
        let table = table(&["a"], &[vec!["<script>".into()]]);
        assert!(table.contains("&lt;script&gt;") && !table.contains("<script>"));
    }
}
