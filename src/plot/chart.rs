//! A chart: axes, grid, marks and a legend, as one SVG element.

use std::fmt::Write as _;

use super::Scale;
use super::ink::Ink;
use super::mark::{Mark, draw_mark};
use super::scale::range;
use crate::text::xml;

/// A chart under construction.
#[derive(Clone, PartialEq, Debug)]
pub struct Chart {
    title: String,
    x_label: String,
    y_label: String,
    size: [f64; 2],
    x_range: Option<(f64, f64)>,
    y_range: Option<(f64, f64)>,
    equal: bool,
    y_down: bool,
    marks: Vec<(Mark, Ink)>,
    legend: Vec<(String, Ink, bool)>,
}

const LEFT: f64 = 56.0;
const RIGHT: f64 = 14.0;
const BOTTOM: f64 = 40.0;
/// Room for one row of the legend.
const LEGEND_ROW: f64 = 17.0;

impl Chart {
    /// An empty chart of this title and size in picture units.
    pub fn new(title: impl Into<String>, width: f64, height: f64) -> Self {
        Self {
            title: title.into(),
            x_label: String::new(),
            y_label: String::new(),
            size: [width, height],
            x_range: None,
            y_range: None,
            equal: false,
            y_down: false,
            marks: Vec::new(),
            legend: Vec::new(),
        }
    }

    /// Names the axes, with units.
    pub fn labels(mut self, x: impl Into<String>, y: impl Into<String>) -> Self {
        (self.x_label, self.y_label) = (x.into(), y.into());
        self
    }

    /// Fixes the horizontal range; otherwise it follows the marks.
    pub fn x_range(mut self, low: f64, high: f64) -> Self {
        self.x_range = Some((low, high));
        self
    }

    /// Fixes the vertical range; otherwise it follows the marks.
    pub fn y_range(mut self, low: f64, high: f64) -> Self {
        self.y_range = Some((low, high));
        self
    }

    /// Sets the vertical range to that of these values, whatever else is drawn.
    pub fn y_range_of(self, values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = range(values, 0.15);
        self.y_range(low, high)
    }

    /// The same scale on both axes, as in maps.
    pub fn equal(mut self) -> Self {
        self.equal = true;
        self
    }

    /// The vertical axis points down, as in images.
    pub fn y_down(mut self) -> Self {
        self.y_down = true;
        self
    }

    /// Adds a mark.
    pub fn mark(&mut self, mark: Mark, ink: Ink) {
        self.marks.push((mark, ink));
    }

    /// Adds a mark and its line in the legend.
    pub fn named(&mut self, name: impl Into<String>, mark: Mark, ink: Ink) {
        self.legend.push((name.into(), ink, matches!(mark, Mark::Dashed(_))));
        self.marks.push((mark, ink));
    }

    /// The SVG element.
    pub fn render(&self) -> String {
        let rows = self.legend_rows();
        let top = 8.0 + if self.title.is_empty() { 0.0 } else { 18.0 } + rows.len() as f64 * LEGEND_ROW;
        let (x, y) = self.scales(top);
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"chart\" viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{}\">",
            self.size[0],
            self.size[1],
            xml(&self.title)
        );
        if !self.title.is_empty() {
            let _ = write!(out, "<text class=\"title\" x=\"{LEFT}\" y=\"18\">{}</text>", xml(&self.title));
        }
        self.draw_legend(&mut out, &rows);
        self.draw_axes(&mut out, &x, &y);
        let _ = write!(
            out,
            "<svg x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" viewBox=\"{:.1} {:.1} {:.1} {:.1}\">",
            x.from,
            y.to.min(y.from),
            x.to - x.from,
            (y.from - y.to).abs(),
            x.from,
            y.to.min(y.from),
            x.to - x.from,
            (y.from - y.to).abs()
        );
        for (mark, ink) in &self.marks {
            draw_mark(&mut out, mark, *ink, &x, &y);
        }
        out.push_str("</svg></svg>");
        out
    }

    /// Legend entries with their horizontal places, row by row.
    fn legend_rows(&self) -> Vec<Vec<(f64, usize)>> {
        let mut rows: Vec<Vec<(f64, usize)>> = Vec::new();
        let mut at = f64::INFINITY;
        for (k, (name, ..)) in self.legend.iter().enumerate() {
            // System fonts are about 6.3 units a letter at 12 px.
            let width = 30.0 + 6.3 * name.chars().count() as f64;
            if at + width > self.size[0] - RIGHT {
                rows.push(Vec::new());
                at = LEFT;
            }
            if let Some(row) = rows.last_mut() {
                row.push((at, k));
            }
            at += width + 12.0;
        }
        rows
    }

    fn draw_legend(&self, out: &mut String, rows: &[Vec<(f64, usize)>]) {
        let first = if self.title.is_empty() { 16.0 } else { 35.0 };
        for (r, row) in rows.iter().enumerate() {
            let y = first + r as f64 * LEGEND_ROW;
            for &(x, k) in row {
                let (name, ink, dashed) = &self.legend[k];
                let dash = if *dashed { " dash" } else { "" };
                let _ = write!(
                    out,
                    "<g class=\"{}\"><path class=\"line{dash}\" style=\"stroke-width:3\" d=\"M{x:.1} {:.1}h18\"/></g>\
                     <text class=\"label\" x=\"{:.1}\" y=\"{y:.1}\">{}</text>",
                    ink.class(),
                    y - 4.0,
                    x + 23.0,
                    xml(name)
                );
            }
        }
    }

    fn scales(&self, top: f64) -> (Scale, Scale) {
        let (mut x_low, mut x_high) =
            self.x_range.unwrap_or_else(|| range(self.marks.iter().flat_map(|(m, _)| m.xs()), 0.0));
        let (mut y_low, mut y_high) =
            self.y_range.unwrap_or_else(|| range(self.marks.iter().flat_map(|(m, _)| m.ys()), 0.06));
        let (width, height) = (self.size[0] - LEFT - RIGHT, self.size[1] - top - BOTTOM);
        if self.equal {
            let per_unit = ((x_high - x_low) / width).max((y_high - y_low) / height) * 1.04;
            let (cx, cy) = ((x_low + x_high) / 2.0, (y_low + y_high) / 2.0);
            (x_low, x_high) = (cx - per_unit * width / 2.0, cx + per_unit * width / 2.0);
            (y_low, y_high) = (cy - per_unit * height / 2.0, cy + per_unit * height / 2.0);
        }
        let (from, to) = if self.y_down { (top, top + height) } else { (top + height, top) };
        let x = Scale { low: x_low, high: x_high, from: LEFT, to: LEFT + width };
        (x, Scale { low: y_low, high: y_high, from, to })
    }

    fn draw_axes(&self, out: &mut String, x: &Scale, y: &Scale) {
        let (top, bottom) = (y.from.min(y.to), y.from.max(y.to));
        let xs = x.ticks(((x.to - x.from) / 90.0) as usize + 1);
        let ys = y.ticks(((bottom - top) / 45.0) as usize + 1);
        let step = |t: &[f64]| if t.len() > 1 { t[1] - t[0] } else { 1.0 };
        let mut grid = String::new();
        for &t in &xs {
            let at = x.at(t);
            let _ = write!(grid, "M{at:.1} {top:.1}V{bottom:.1}");
            let _ = write!(
                out,
                "<text class=\"tick\" text-anchor=\"middle\" x=\"{at:.1}\" y=\"{:.1}\">{}</text>",
                bottom + 14.0,
                Scale::label(t, step(&xs))
            );
        }
        for &t in &ys {
            let at = y.at(t);
            let _ = write!(grid, "M{:.1} {at:.1}H{:.1}", x.from, x.to);
            let _ = write!(
                out,
                "<text class=\"tick\" text-anchor=\"end\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                x.from - 5.0,
                at + 4.0,
                Scale::label(t, step(&ys))
            );
        }
        let _ = write!(
            out,
            "<path class=\"grid\" d=\"{grid}\"/><path class=\"frame\" d=\"M{:.1} {top:.1}V{bottom:.1}H{:.1}\"/>\
             <text class=\"label\" text-anchor=\"middle\" x=\"{:.1}\" y=\"{:.1}\">{}</text>\
             <text class=\"label\" text-anchor=\"middle\" transform=\"translate(13 {:.1}) rotate(-90)\">{}</text>",
            x.from,
            x.to,
            (x.from + x.to) / 2.0,
            bottom + 31.0,
            xml(&self.x_label),
            (top + bottom) / 2.0,
            xml(&self.y_label)
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_land_where_the_axes_say() {
        let mut chart = Chart::new("", 170.0, 148.0).x_range(0.0, 10.0).y_range(0.0, 1.0);
        chart.mark(Mark::Line(vec![[0.0, 0.0], [f64::NAN, 0.0], [10.0, 1.0]]), Ink::Blue);
        // Plot area: x from 56 to 156, y from 108 (bottom) to 8 (top); a gap interrupts the line.
        assert!(chart.render().contains("d=\"M56.0 108.0M156.0 8.0\""), "{}", chart.render());
    }

    #[test]
    fn an_equal_chart_keeps_circles_round() {
        let chart = Chart::new("m", 400.0, 300.0).x_range(-1.0, 1.0).y_range(-5.0, 5.0).equal();
        let (x, y) = chart.scales(26.0);
        let per_x = (x.at(1.0) - x.at(0.0)).abs();
        let per_y = (y.at(1.0) - y.at(0.0)).abs();
        assert!((per_x - per_y).abs() < 1e-9);
    }

    #[test]
    fn an_empty_chart_is_still_a_picture() {
        let text = Chart::new("nothing <yet>", 300.0, 200.0).render();
        assert!(text.contains("nothing &lt;yet&gt;") && !text.contains("NaN"));
    }
}
