//! The style sheet of charts, light and dark, and the frame that makes a chart a file.

/// Colours by name, for light, dark and paper. Each has a contrast of at least 3:1 on its background.
pub const PALETTE_CSS: &str = "\
:root{--ground:#ffffff;--panel:#f6f7f9;--text:#1b1f24;--soft:#5b6570;--rule:#d5dae0;--grid:#e8ebef;\
--blue:#1f6feb;--orange:#c4570a;--green:#1a7f4b;--violet:#8745c7;--red:#cf222e;--grey:#7a838d}\
@media (prefers-color-scheme:dark){:root{--ground:#14181d;--panel:#1c2128;--text:#e6eaef;--soft:#9aa5b1;\
--rule:#373f49;--grid:#262c34;--blue:#62a8ff;--orange:#f39a4a;--green:#4fc98a;--violet:#c092f5;\
--red:#ff7b72;--grey:#8b949e}}\
@media print{:root{--ground:#ffffff;--panel:#ffffff;--text:#000000;--soft:#444444;--rule:#bbbbbb;\
--grid:#e4e4e4;--blue:#1f6feb;--orange:#c4570a;--green:#1a7f4b;--violet:#8745c7;--red:#cf222e;\
--grey:#7a838d}}";

/// Classes that charts use, in terms of [`PALETTE_CSS`].
pub const CHART_CSS: &str = "\
.chart{font:12px system-ui,sans-serif;fill:var(--text);color:var(--text);display:block;width:100%;height:auto}\
.chart .frame{fill:none;stroke:var(--rule)}.chart .grid{stroke:var(--grid);fill:none}\
.chart .tick{fill:var(--soft);font-size:11px}.chart .label{fill:var(--soft)}\
.chart .title{font-weight:600;font-size:13px}\
.chart .line{fill:none;stroke:currentColor;stroke-width:1.6;stroke-linejoin:round}\
.chart .dash{stroke-dasharray:5 4}.chart .thin{stroke-width:1}\
.chart .band{fill:currentColor;fill-opacity:.16;stroke:none}\
.chart .dots{fill:currentColor;fill-opacity:.55;stroke:none}.chart .bars{fill:currentColor;fill-opacity:.75}\
.chart .blue{color:var(--blue)}.chart .orange{color:var(--orange)}.chart .green{color:var(--green)}\
.chart .violet{color:var(--violet)}.chart .red{color:var(--red)}.chart .grey{color:var(--grey)}\
.chart .black{color:var(--text)}";

/// The mark near the start of every file of ours with a drawing, a map or a page.
pub const MADE_BY: &str = "made by windhover";

/// A chart as an SVG file: with its style sheet and a painted background.
pub fn standalone(chart: &str) -> String {
    let style = format!(
        "<style>{PALETTE_CSS}{CHART_CSS}</style><rect width=\"100%\" height=\"100%\" fill=\"var(--ground)\"/>"
    );
    let body = match chart.find('>') {
        Some(end) => format!("{}{style}{}", &chart[..=end], &chart[end + 1..]),
        None => chart.to_owned(),
    };
    format!("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<!-- {MADE_BY} -->\n{body}\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_has_its_style_inside_the_root() {
        let file = standalone("<svg class=\"chart\"><g/></svg>");
        assert!(file.starts_with("<?xml"));
        assert!(file.find("<style>").expect("styled") > file.find("<svg").expect("root"));
        assert!(file.trim_end().ends_with("<g/></svg>"));
    }
}
