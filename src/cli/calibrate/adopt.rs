//! `windhover calibrate adopt`

use std::path::PathBuf;

use crate::cli::CliResult;
use crate::cli::out::note;
use crate::cli::refine::{print_adopted, refined};
use crate::cli::surveyed::SurveyedArgs;
use crate::text::one_line;

/// Print what flights show of their configuration, as TOML to paste.
///
/// The flights are refined (windhover refine), and nothing is written. Printed are the constants that the flights
/// determine to differ from the configuration by more than three sigmas, each with its sigma: mounting angles, lever
/// arms, delays, compass offsets, lens, markers. A section replaces the keys of the same names, a marker the whole
/// configured marker. Flights must have the pipeline's detections: replay a capture first.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover calibrate adopt flight.mcap
  windhover calibrate adopt monday.mcap tuesday.mcap        # constants that two flights have in common
  windhover calibrate adopt flight.mcap --positions base.pos")]
pub(super) struct Args {
    /// Flights of the same vehicles and configuration: .mcap files, or directories of segments
    #[arg(required = true, value_name = "FLIGHT")]
    flights: Vec<PathBuf>,
    /// External positions of the antenna, as for `windhover refine`
    #[arg(long, value_name = "FILE")]
    positions: Option<PathBuf>,
    #[command(flatten)]
    surveyed: SurveyedArgs,
}

pub(super) fn run(args: &Args) -> CliResult {
    let done = refined(&args.flights, args.positions.as_deref(), &args.surveyed)?;
    for warning in done.iter().flat_map(|done| done.flight.warnings.iter().chain(&done.remarks)) {
        note!("windhover: {}", one_line(warning));
    }
    // Constants are common to all flights.
    done.first().map_or(Ok(()), print_adopted)
}
