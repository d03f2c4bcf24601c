//! The report of a flight: one self-contained HTML page.

mod accuracy;
mod daemon;
mod pictures;
mod refined;
mod fusion;
mod map;
mod page;
mod sensors;
mod states;
mod summary;
mod vision;

use std::path::Path;

use super::flight::Flight;
use super::truth::Truth;
use crate::io::mcap_read::ReadError;
use crate::plot::{Chart, Ink, Mark, thin};
use windhover_base::geo::{Geodetic, LocalFrame};

pub use accuracy::{Errors, error_text, errors_of};

/// Most points of a line.
const LINE_POINTS: usize = 600;
/// Most points of a cloud.
const CLOUD_POINTS: usize = 700;

/// The input of every section.
struct Context<'a> {
    flight: &'a Flight,
    truth: Option<&'a Truth>,
}

impl Context<'_> {
    /// The NED frame of the flight, or one at its first fix.
    fn frame(&self) -> Option<LocalFrame> {
        let first = || {
            let e = self.flight.epochs.iter().find(|e| e.lat_deg.is_some() && e.lon_deg.is_some())?;
            Some(Geodetic { lat_deg: e.lat_deg?, lon_deg: e.lon_deg?, height_m: 0.0 })
        };
        self.flight.datum.or_else(first).map(LocalFrame::new)
    }

    /// A chart over the flight's time.
    fn chart(&self, title: &str, unit: &str) -> Chart {
        let end = self.flight.duration_s().max(1e-3);
        Chart::new(title, 560.0, 250.0).labels("time (s)", unit).x_range(0.0, end)
    }
}

/// A line, thinned to the resolution of a chart.
fn line(points: &[[f64; 2]]) -> Mark {
    Mark::Line(thin(points, LINE_POINTS))
}

/// A cloud, thinned to the resolution of a chart; its extremes are kept.
fn cloud(points: &[[f64; 2]], radius: f64) -> Mark {
    Mark::Dots(thin(points, CLOUD_POINTS), radius)
}

/// A chart of one line; empty where there is nothing to draw.
fn single(context: &Context<'_>, title: &str, unit: &str, points: &[[f64; 2]], ink: Ink) -> String {
    if points.is_empty() {
        return String::new();
    }
    let mut chart = context.chart(title, unit);
    chart.mark(line(points), ink);
    page::figure(&chart.render())
}

/// The page of a flight, with errors where truth is given. Reads frames of the recording at `path` for the pictures.
pub fn render(path: &Path, flight: &Flight, truth: Option<&Truth>) -> Result<String, ReadError> {
    let context = Context { flight, truth };
    let pictures = pictures::read(path, flight)?;
    let sections = [
        summary::section(&context, &pictures),
        accuracy::section(&context),
        refined::section(&context),
        map::section(&context),
        states::section(&context),
        states::ownship_section(&context),
        fusion::section(&context),
        sensors::section(&context),
        vision::section(&context, &pictures),
        pictures::section(&pictures),
        daemon::section(&context),
        daemon::notices(&context),
        daemon::configuration(&context),
    ];
    Ok(page::page(&flight.name, sections.into_iter().flatten().collect()))
}
