//! The map: paths of helicopter and vehicles, with ellipses.

use nalgebra::Matrix2;

use super::accuracy::{covariance, is_held};
use super::page::{Section, figure};
use super::{Context, cloud, line};
use crate::io::proto::windhover as wh;
use crate::plot::{Chart, Ink, Mark, ellipse};
use windhover_base::geo::Geodetic;

/// Ellipses drawn along a path.
const ELLIPSES: usize = 10;
/// Mahalanobis distance that holds 95 % of a Gaussian in the plane.
const SCALE_95: f64 = 2.447_746_8;

/// The section; empty where no position is known.
pub(super) fn section(context: &Context<'_>) -> Option<Section> {
    let mut chart = Chart::new("", 640.0, 500.0).labels("east (m)", "north (m)").equal();
    let flight = context.flight;
    let fixes = fixes(context);
    let own: Vec<[f64; 2]> = flight.ownship.iter().map(|o| [o.east_m, o.north_m]).collect();
    if fixes.is_empty() && own.is_empty() && flight.targets.is_empty() {
        return None;
    }
    if !fixes.is_empty() {
        chart.named("GPS fixes", cloud(&fixes, 1.6), Ink::Grey);
    }
    if !own.is_empty() {
        chart.named("helicopter", path(&own), Ink::Violet);
    }
    if let Some(truth) = truth_path(context) {
        chart.named("true path", path(&truth), Ink::Black);
    }
    for (k, (name, track)) in flight.targets.iter().enumerate() {
        let ink = [Ink::Blue, Ink::Red, Ink::Grey][k % 3];
        let points = |states: &[wh::TargetState]| -> Vec<[f64; 2]> {
            states.iter().map(|s| if is_held(s) { [s.east_m, s.north_m] } else { [f64::NAN; 2] }).collect()
        };
        let paper = points(&track.paper);
        if !paper.is_empty() {
            chart.named(format!("{name}, paper"), cloud(&paper, 0.9), Ink::Orange);
        }
        let filtered = points(&track.filtered);
        if filtered.iter().any(|p| p[0].is_finite()) {
            chart.named(format!("{name}, real time"), path(&filtered), ink);
            mark_ellipses(&mut chart, &track.filtered, ink);
            mark_ends(&mut chart, &filtered, ink);
        }
        let smoothed = points(&track.smoothed);
        if smoothed.iter().any(|p| p[0].is_finite()) {
            chart.named(format!("{name}, smoothed"), path(&smoothed), Ink::Green);
        }
    }
    let body = format!(
        "<div class=\"wide\">{}</div><p class=\"soft\">Ellipses hold 95 % of the position as the filter \
         knew it, the receiver's own bias included.</p>\n",
        figure(&chart.render())
    );
    Some(Section { id: "map", title: "Map", body })
}

/// A path; unlike a curve over time, its points are thinned evenly.
fn path(points: &[[f64; 2]]) -> Mark {
    let step = points.len().div_ceil(900).max(1);
    let mut kept: Vec<[f64; 2]> = points.iter().step_by(step).copied().collect();
    kept.extend(points.last());
    if points.len() < 3 { line(points) } else { Mark::Line(kept) }
}

fn fixes(context: &Context<'_>) -> Vec<[f64; 2]> {
    let Some(frame) = context.frame() else { return Vec::new() };
    let epochs = context.flight.epochs.iter();
    let at = |e: &wh::GnssEpoch| {
        let height_m = e.alt_msl_m? + e.geoid_m.unwrap_or(0.0);
        let ned = frame.ned(Geodetic { lat_deg: e.lat_deg?, lon_deg: e.lon_deg?, height_m });
        Some([ned.y, ned.x])
    };
    epochs.filter_map(at).collect()
}

fn truth_path(context: &Context<'_>) -> Option<Vec<[f64; 2]>> {
    let (truth, frame) = (context.truth?, context.frame()?);
    let (_, track) = context.flight.targets.iter().next()?;
    let height_m = frame.datum().height_m;
    let at = |s: &wh::TargetState| {
        let row = truth.at(s.frame)?;
        let ned = frame.ned(Geodetic { lat_deg: row.lat_deg, lon_deg: row.lon_deg, height_m });
        Some([ned.y, ned.x])
    };
    Some(track.filtered.iter().filter_map(at).collect())
}

fn mark_ellipses(chart: &mut Chart, states: &[wh::TargetState], ink: Ink) {
    let held: Vec<&wh::TargetState> = states.iter().filter(|s| is_held(s)).collect();
    let step = held.len().div_ceil(ELLIPSES).max(1);
    for s in held.iter().step_by(step) {
        if let Some(p) = covariance(s) {
            let east_first = Matrix2::new(p[(1, 1)], p[(0, 1)], p[(0, 1)], p[(0, 0)]);
            let outline = ellipse([s.east_m, s.north_m], &east_first, SCALE_95);
            chart.mark(Mark::Dashed(outline), ink);
        }
    }
}

fn mark_ends(chart: &mut Chart, points: &[[f64; 2]], ink: Ink) {
    let finite = || points.iter().filter(|p| p[0].is_finite());
    for (words, point) in [("start", finite().next()), ("end", finite().next_back())] {
        if let Some(p) = point {
            chart.mark(Mark::Dots(vec![*p], 4.0), ink);
            chart.mark(Mark::Text(*p, format!("\u{a0}\u{a0}{words}")), ink);
        }
    }
}
