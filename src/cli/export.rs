//! `windhover export FLIGHT --format csv|geojson|kml [--out DIR]`

use std::path::{Path, PathBuf};

use super::CliResult;
use crate::app::export::{self, Format};

/// Write the outputs of a flight for other tools: tables, GIS, Google Earth.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover export flight.mcap --format csv             # estimates.csv and more, into ./flight/
  windhover export FLIGHTS/20261118T150405Z --format kml --out /tmp/earth")]
pub(super) struct Args {
    /// Flight: an .mcap file, or the directory of its segments
    flight: PathBuf,
    /// What to write
    #[arg(long, value_enum)]
    format: Format,
    /// Directory to write into [default: named after the flight]
    #[arg(long)]
    out: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> CliResult {
    let out = args.out.clone().unwrap_or_else(|| named_after(&args.flight));
    let exported = export::export(&args.flight, args.format, &out)?;
    for warning in &exported.warnings {
        eprintln!("windhover: {warning}");
    }
    for file in &exported.files {
        eprintln!("wrote {}", file.display());
    }
    Ok(())
}

/// `flight.mcap` and `FLIGHTS/flight/` both give `flight` in the working directory; a directory of
/// segments of that very name gets `flight-export`, so that a flight is never written into.
fn named_after(flight: &Path) -> PathBuf {
    let stem = flight.file_stem().unwrap_or(flight.as_os_str());
    let out = PathBuf::from(stem);
    if out.join("000000.mcap").exists() || out == flight {
        let mut name = stem.to_owned();
        name.push("-export");
        return PathBuf::from(name);
    }
    out
}
