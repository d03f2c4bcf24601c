//! `windhover report`

use std::path::PathBuf;

use super::{CliError, CliResult};
use crate::app::flight::Flight;
use crate::app::report;
use crate::app::truth::Truth;

/// Write a page about a flight: map, states with their bands, measurements, sensors, frames; errors
/// where truth is given.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover report flight.mcap                              # report.html, one file, for any browser
  windhover report flight.mcap --truth flight.truth.csv --out flight.html
  windhover report FLIGHTS/20261118T150405Z                 # a flight on the card")]
pub(super) struct Args {
    /// Flight: a file, or a directory of segments
    flight: PathBuf,
    /// True positions: CSV with frame, lat_deg, lon_deg (heading_rad, speed_mps, yaw_rate_radps), or
    /// one row without frame for a surveyed point at rest
    #[arg(long, value_name = "TRUTH.csv")]
    truth: Option<PathBuf>,
    /// The page
    #[arg(long, value_name = "FILE.html", default_value = "report.html")]
    out: PathBuf,
}

pub(super) fn run(args: &Args) -> CliResult {
    let truth = args.truth.as_deref().map(Truth::read).transpose()?;
    let flight = Flight::read(&args.flight)?;
    let page = report::render(&args.flight, &flight, truth.as_ref())?;
    std::fs::write(&args.out, page)
        .map_err(|e| CliError::failed(format!("cannot write {}: {e}", args.out.display())))?;
    if let Some(table) = truth.as_ref().and_then(|truth| report::error_text(&flight, truth)) {
        print!("{table}");
    }
    println!("{}", args.out.display());
    Ok(())
}
