//! The chart of a Monte Carlo analysis: scatter, circles, covariance ellipse, and the errors of a flight.

use nalgebra::Matrix2;

use windhover_calibrate::montecarlo::{Analysis, radii};

use super::{Chart, Ink, Mark, ellipse};

/// Most dots of one cloud; more would only blacken the chart.
const MOST_DOTS: usize = 3_000;
/// Mahalanobis distance that holds 95 % of a Gaussian in the plane: √(−2 ln 0.05).
const SCALE_95: f64 = 2.447_746_8;

/// Errors of a flight over a surveyed marker, drawn over the simulation.
#[derive(Clone, PartialEq, Debug)]
pub struct Overlay {
    /// Name in the legend.
    pub name: String,
    /// (north, east) errors, metres.
    pub errors_m: Vec<[f64; 2]>,
}

/// The scatter of errors as an SVG element, east to the right and north up: samples, the circles that contain 50 % and
/// 95 % of them, the 95 % ellipse of the closed form, and a flight's errors with their own 95 % circle.
pub fn scatter_svg(analysis: &Analysis, title: &str, overlay: Option<&Overlay>) -> String {
    let mut chart = Chart::new(title, 720.0, 700.0).labels("error east (m)", "error north (m)").equal();
    let reach = 1.05 * analysis.r95_m.max(overlay.map_or(0.0, |o| radii(&o.errors_m).1)) * 1.25;
    if reach > 0.0 {
        chart = chart.x_range(-reach, reach).y_range(-reach, reach);
    }
    let samples = format!("{} samples", analysis.errors_m.len());
    chart.named(samples, Mark::Dots(east_north(&analysis.errors_m), 1.2), Ink::Grey);
    chart.named(circle_name("50 %", analysis.r50_m), circle(analysis.r50_m), Ink::Blue);
    chart.named(circle_name("95 %", analysis.r95_m), circle(analysis.r95_m), Ink::Green);
    let closed = &analysis.closed_m2;
    let east_first = Matrix2::new(closed[(1, 1)], closed[(0, 1)], closed[(0, 1)], closed[(0, 0)]);
    let outline = ellipse([0.0, 0.0], &east_first, SCALE_95);
    chart.named("95 % ellipse, closed form", Mark::Dashed(outline), Ink::Violet);
    if let Some(flight) = overlay {
        let (_, r95, _) = radii(&flight.errors_m);
        let name = format!("{} ({} errors)", flight.name, flight.errors_m.len());
        chart.named(name, Mark::Dots(east_north(&flight.errors_m), 1.8), Ink::Orange);
        chart.named(circle_name("flight 95 %", r95), circle(r95), Ink::Red);
    }
    chart.render()
}

fn east_north(errors_m: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let step = errors_m.len().div_ceil(MOST_DOTS).max(1);
    errors_m.iter().step_by(step).map(|e| [e[1], e[0]]).collect()
}

fn circle(radius: f64) -> Mark {
    Mark::Line(ellipse([0.0, 0.0], &Matrix2::identity(), radius))
}

fn circle_name(what: &str, radius: f64) -> String {
    format!("{what} within {radius:.3} m")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use windhover_calibrate::montecarlo::Setup;

    #[test]
    fn picture_holds_circles_ellipse_and_flight() {
        let config = Config::parse(include_str!("../../config/windhover.toml")).expect("shipped file");
        let analysis = Setup::new(&config.montecarlo, &config.camera).run(5_000, 1).expect("below");
        let flight = Overlay { name: "hover".into(), errors_m: vec![[1.0, 0.5], [0.8, -0.2]] };
        let svg = scatter_svg(&analysis, "as flown", Some(&flight));
        for words in ["5000 samples", "50 % within 1.4", "95 % within 3.0", "closed form", "hover (2 errors)"]
        {
            assert!(svg.contains(words), "{words}");
        }
        assert!(!svg.contains("NaN") && svg.len() < 200_000);
    }
}
