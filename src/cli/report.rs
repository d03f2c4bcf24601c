//! `windhover report`

use std::path::PathBuf;

use super::{CliResult, place};
use crate::app::flight::Flight;
use crate::app::report;
use crate::app::truth::Truth;
use crate::cli::out::{note, out, outln};
use crate::io::new_file::Inputs;
use crate::plot::MADE_BY;

/// Write a page about a flight: map, states with their one-sigma bands, measurements, sensors, frames; errors where
/// truth is given.
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
    /// Output file
    #[arg(long, value_name = "FILE.html", default_value = "report.html")]
    out: PathBuf,
}

/// The marks of a report near its start.
const REPORT: [&str; 2] = ["<meta name=\"generator\" content=\"report ", MADE_BY];

pub(super) fn run(args: &Args) -> CliResult {
    let inputs = Inputs::of([Some(args.flight.as_path()), args.truth.as_deref()].into_iter().flatten());
    place::check(&args.out, &inputs, &REPORT)?;
    let replaced = args.out.exists();
    let truth = args.truth.as_deref().map(Truth::read).transpose()?;
    let flight = Flight::read(&args.flight)?;
    let page = report::render(&args.flight, &flight, truth.as_ref())?;
    place::write(&args.out, &page)?;
    if replaced {
        note!("the earlier report is replaced");
    }
    if let Some(table) = truth.as_ref().and_then(|truth| report::error_text(&flight, truth)) {
        out!("{table}")?;
    }
    outln!("{}", args.out.display())?;
    Ok(())
}
