//! The marks of a chart.

use std::fmt::Write as _;

use super::Scale;
use super::ink::Ink;
use crate::text::xml;

/// A mark in data coordinates. A NaN point breaks a line or band.
#[derive(Clone, PartialEq, Debug)]
pub enum Mark {
    /// A line through points (x, y).
    Line(Vec<[f64; 2]>),
    /// The same, dashed.
    Dashed(Vec<[f64; 2]>),
    /// Between `low` and `high`: points (x, low, high).
    Band(Vec<[f64; 3]>),
    /// Dots at (x, y) with this radius in picture units.
    Dots(Vec<[f64; 2]>, f64),
    /// Bars from zero: (x, height) with this width in data units.
    Bars(Vec<[f64; 2]>, f64),
    /// Arrows from (x, y) by (dx, dy).
    Arrows(Vec<[f64; 4]>),
    /// Text at (x, y).
    Text([f64; 2], String),
}

impl Mark {
    pub(super) fn xs(&self) -> Box<dyn Iterator<Item = f64> + '_> {
        match self {
            Self::Line(p) | Self::Dashed(p) | Self::Dots(p, _) => Box::new(p.iter().map(|p| p[0])),
            Self::Bars(p, w) => Box::new(p.iter().flat_map(move |p| [p[0] - w / 2.0, p[0] + w / 2.0])),
            Self::Band(p) => Box::new(p.iter().map(|p| p[0])),
            Self::Arrows(p) => Box::new(p.iter().flat_map(|p| [p[0], p[0] + p[2]])),
            Self::Text(at, _) => Box::new(std::iter::once(at[0])),
        }
    }

    pub(super) fn ys(&self) -> Box<dyn Iterator<Item = f64> + '_> {
        match self {
            Self::Line(p) | Self::Dashed(p) | Self::Dots(p, _) => Box::new(p.iter().map(|p| p[1])),
            Self::Bars(p, _) => Box::new(p.iter().map(|p| p[1]).chain(std::iter::once(0.0))),
            Self::Band(p) => Box::new(p.iter().flat_map(|p| [p[1], p[2]])),
            Self::Arrows(p) => Box::new(p.iter().flat_map(|p| [p[1], p[1] + p[3]])),
            Self::Text(at, _) => Box::new(std::iter::once(at[1])),
        }
    }
}

/// Appends a mark to an SVG text.
pub(super) fn draw_mark(out: &mut String, mark: &Mark, ink: Ink, x: &Scale, y: &Scale) {
    let class = ink.class();
    match mark {
        Mark::Line(points) => {
            let _ = write!(out, "<path class=\"{class} line\" d=\"{}\"/>", path(points, x, y));
        }
        Mark::Dashed(points) => {
            let _ = write!(out, "<path class=\"{class} line dash\" d=\"{}\"/>", path(points, x, y));
        }
        Mark::Band(points) => {
            let whole = |p: &[f64; 3]| p.iter().all(|v| v.is_finite());
            for run in points.split(|p| !whole(p)).filter(|run| run.len() > 1) {
                let upper = run.iter().map(|p| [p[0], p[2]]);
                let outline: Vec<_> = run.iter().map(|p| [p[0], p[1]]).chain(upper.rev()).collect();
                let _ = write!(out, "<path class=\"{class} band\" d=\"{}Z\"/>", path(&outline, x, y));
            }
        }
        Mark::Dots(points, radius) => {
            // One path of round zero-length strokes is much smaller than as many circles.
            let mut d = String::new();
            for p in points.iter().filter(|p| p[0].is_finite() && p[1].is_finite()) {
                let _ = write!(d, "M{:.1} {:.1}h0", x.at(p[0]), y.at(p[1]));
            }
            let _ = write!(
                out,
                "<path class=\"{class} line\" style=\"stroke-width:{:.1};stroke-linecap:round;stroke-opacity:.55\" d=\"{d}\"/>",
                2.0 * radius
            );
        }
        Mark::Bars(points, width) => {
            for p in points.iter().filter(|p| p[1].is_finite()) {
                let (a, b) = (y.at(0.0), y.at(p[1]));
                let (left, right) = (x.at(p[0] - width / 2.0), x.at(p[0] + width / 2.0));
                let _ = write!(
                    out,
                    "<rect class=\"{class} bars\" x=\"{left:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\"/>",
                    a.min(b),
                    (right - left).max(0.5),
                    (a - b).abs()
                );
            }
        }
        Mark::Arrows(arrows) => draw_arrows(out, arrows, class, x, y),
        Mark::Text(at, words) => {
            let _ = write!(
                out,
                "<text class=\"{class}\" style=\"fill:currentColor\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                x.at(at[0]),
                y.at(at[1]),
                xml(words)
            );
        }
    }
}

fn draw_arrows(out: &mut String, arrows: &[[f64; 4]], class: &str, x: &Scale, y: &Scale) {
    let mut d = String::new();
    for a in arrows.iter().filter(|a| a.iter().all(|v| v.is_finite())) {
        let (x0, y0) = (x.at(a[0]), y.at(a[1]));
        let (x1, y1) = (x.at(a[0] + a[2]), y.at(a[1] + a[3]));
        let (dx, dy) = (x1 - x0, y1 - y0);
        let head = 0.3;
        let _ = write!(
            d,
            "M{x0:.1} {y0:.1}L{x1:.1} {y1:.1}M{:.1} {:.1}L{x1:.1} {y1:.1}L{:.1} {:.1}",
            x1 - head * (dx + 0.5 * dy),
            y1 - head * (dy - 0.5 * dx),
            x1 - head * (dx - 0.5 * dy),
            y1 - head * (dy + 0.5 * dx)
        );
    }
    let _ = write!(out, "<path class=\"{class} line thin\" d=\"{d}\"/>");
}

/// Path data of a polyline; a NaN point interrupts it.
fn path(points: &[[f64; 2]], x: &Scale, y: &Scale) -> String {
    let mut d = String::with_capacity(points.len() * 12);
    let mut pen_down = false;
    for p in points {
        if !(p[0].is_finite() && p[1].is_finite()) {
            pen_down = false;
            continue;
        }
        let _ = write!(d, "{}{:.1} {:.1}", if pen_down { 'L' } else { 'M' }, x.at(p[0]), y.at(p[1]));
        pen_down = true;
    }
    d
}
