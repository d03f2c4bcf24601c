//! Charts of a calibration: residuals, error of each image, and areas without corners.

use nalgebra::Vector2;

use windhover_calibrate::PlaneView;
use windhover_calibrate::intrinsics::Intrinsics;

use super::{Chart, Ink, Mark};

/// Cells of the coverage map, across and down.
const CELLS: (usize, usize) = (8, 6);
/// Tilts of the board below this hardly determine the focal length, radians.
const LITTLE_TILT: f64 = 0.26;

fn size_of(size: (usize, usize)) -> (f64, f64) {
    (size.0 as f64, size.1 as f64)
}

/// A chart in image coordinates.
fn image_chart(title: String, size: (usize, usize)) -> Chart {
    let (width, height) = size_of(size);
    Chart::new(title, 760.0, 90.0 + 690.0 * height / width)
        .labels("u (px)", "v (px)")
        .x_range(0.0, width)
        .y_range(0.0, height)
        .equal()
        .y_down()
}

/// Residuals as arrows over the image, enlarged by a round factor that is in the title.
pub fn residuals_svg(result: &Intrinsics, views: &[PlaneView], size: (usize, usize)) -> String {
    let factor = (0.03 * size_of(size).0 / result.rms_px.max(1e-6)).log2().floor().exp2().max(1.0);
    let title = format!("Residuals, {factor:.0} times as long, rms {:.3} px", result.rms_px);
    let mut chart = image_chart(title, size);
    let inks = [Ink::Blue, Ink::Orange, Ink::Green, Ink::Violet, Ink::Red, Ink::Grey];
    for (k, (view, fit)) in views.iter().zip(&result.views).enumerate() {
        let arrow = |(p, r): (&Vector2<f64>, &Vector2<f64>)| [p.x, p.y, factor * r.x, factor * r.y];
        let arrows = view.px.iter().zip(&fit.residuals_px).map(arrow).collect();
        chart.mark(Mark::Arrows(arrows), inks[k % inks.len()]);
    }
    chart.render()
}

/// Error of each image as a bar.
pub fn per_view_svg(result: &Intrinsics, names: &[&str]) -> String {
    let n = result.views.len();
    let mut chart = Chart::new("Error of each image", 760.0, 320.0)
        .labels("image, in the given order", "rms (px)")
        .x_range(0.3, n as f64 + 0.7);
    let bars = result.views.iter().enumerate().map(|(k, v)| [k as f64 + 1.0, v.rms_px]).collect();
    chart.mark(Mark::Bars(bars, 0.7), Ink::Blue);
    let all = vec![[0.3, result.rms_px], [n as f64 + 0.7, result.rms_px]];
    chart.named(format!("all images {:.3} px", result.rms_px), Mark::Dashed(all), Ink::Orange);
    let worst = result.views.iter().enumerate().max_by(|a, b| a.1.rms_px.total_cmp(&b.1.rms_px));
    if let Some((k, view)) = worst
        && let Some(name) = names.get(k)
    {
        let short = name.rsplit('/').next().unwrap_or(name);
        chart.named(
            format!("worst: {short} {:.3} px", view.rms_px),
            Mark::Bars(vec![[k as f64 + 1.0, view.rms_px]], 0.7),
            Ink::Red,
        );
    }
    chart.render()
}

/// Every detected corner, and the number of corners in each cell of the image.
pub fn coverage_svg(views: &[PlaneView], size: (usize, usize)) -> String {
    let counts = coverage(views, size);
    let missing = counts.iter().filter(|c| **c == 0).count();
    let title = format!("Coverage: {} of {} cells have corners", counts.len() - missing, counts.len());
    let mut chart = image_chart(title, size);
    let (width, height) = size_of(size);
    let (cell_w, cell_h) = (width / CELLS.0 as f64, height / CELLS.1 as f64);
    for (k, count) in counts.iter().enumerate() {
        let (left, top) = ((k % CELLS.0) as f64 * cell_w, (k / CELLS.0) as f64 * cell_h);
        let ink = if *count == 0 { Ink::Red } else { Ink::Green };
        let inset = 0.03 * cell_w;
        let (a, b) = (top + inset, top + cell_h - inset);
        chart.mark(Mark::Band(vec![[left + inset, a, b], [left + cell_w - inset, a, b]]), ink);
        chart.mark(Mark::Text([left + 0.08 * cell_w, top + 0.3 * cell_h], count.to_string()), ink);
    }
    let dots = views.iter().flat_map(|v| &v.px).map(|p| [p.x, p.y]).collect();
    chart.mark(Mark::Dots(dots, 1.3), Ink::Grey);
    chart.render()
}

/// Corners in each cell, row by row.
fn coverage(views: &[PlaneView], size: (usize, usize)) -> Vec<usize> {
    let (width, height) = size_of(size);
    let mut counts = vec![0; CELLS.0 * CELLS.1];
    for p in views.iter().flat_map(|v| &v.px) {
        let column = ((p.x + 0.5) / width * CELLS.0 as f64) as usize;
        let row = ((p.y + 0.5) / height * CELLS.1 as f64) as usize;
        counts[row.min(CELLS.1 - 1) * CELLS.0 + column.min(CELLS.0 - 1)] += 1;
    }
    counts
}

/// Advice on further photographs, as text; empty where the set is good.
pub fn coverage_advice(result: &Intrinsics, views: &[PlaneView], size: (usize, usize)) -> Vec<String> {
    let mut advice = Vec::new();
    let counts = coverage(views, size);
    let mostly_empty = |cells: &mut dyn Iterator<Item = usize>| {
        let (all, empty) = cells.fold((0, 0), |(a, e), k| (a + 1, e + usize::from(counts[k] == 0)));
        2 * empty > all
    };
    let (across, down) = CELLS;
    let mut missing = Vec::new();
    for (name, empty) in [
        ("left edge", mostly_empty(&mut (0..down).map(|r| r * across))),
        ("right edge", mostly_empty(&mut (0..down).map(|r| (r + 1) * across - 1))),
        ("top edge", mostly_empty(&mut (0..across))),
        ("bottom edge", mostly_empty(&mut ((down - 1) * across..down * across))),
    ] {
        if empty {
            missing.push(name);
        }
    }
    if !missing.is_empty() {
        advice.push(format!(
            "There are few corners along the {}: distortion there is extrapolated. Take photographs with the board there.",
            missing.join(", ")
        ));
    }
    let tilted =
        result.views.iter().filter(|v| (v.pose.rotation.matrix()[(2, 2)].abs().acos()) > LITTLE_TILT);
    let tilted = tilted.count();
    if tilted < 5.min(result.views.len()) {
        advice.push(format!(
            "The board is tilted by more than 15 degrees in {tilted} images only: tilt it more, to determine the focal length."
        ));
    }
    let median = {
        let mut all: Vec<f64> = result.views.iter().map(|v| v.rms_px).collect();
        all.sort_by(f64::total_cmp);
        all.get(all.len() / 2).copied().unwrap_or(0.0)
    };
    let bad: Vec<String> = result
        .views
        .iter()
        .enumerate()
        .filter(|(_, v)| v.rms_px > 3.0 * median)
        .map(|(k, _)| format!("{}", k + 1))
        .collect();
    if !bad.is_empty() {
        advice.push(format!(
            "Errors three times as large as in most images, image number {}: corners in wrong places (try a smaller --window), blur, or a bent board. Leave it out or take it again.",
            bad.join(", ")
        ));
    }
    advice
}
