//! `windhover export FLIGHT --format csv|geojson|kml|rosbag2|klv-ts [--out DIR]`

use std::path::{Path, PathBuf};

use super::{CliResult, place};
use crate::app::export::{self, Format};
use crate::cli::out::note;
use crate::io::new_file::Inputs;
use crate::text::one_line;

/// Write the outputs of a flight for other tools: tables, GIS, Google Earth, ROS 2, video with its metadata.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover export flight.mcap --format csv             # estimates.csv and more, into ./flight/
  windhover export FLIGHTS/20261118T150405Z --format kml --out /tmp/earth
  windhover export flight.mcap --format rosbag2 --out bag  # ros2 bag play bag")]
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
    write(&args.flight, args.format, &out)
}

/// Writes the outputs of a flight into a directory, and prints what was written.
pub(super) fn write(flight: &Path, format: Format, out: &Path) -> CliResult {
    let inputs = Inputs::of([flight]);
    format.files().iter().try_for_each(|(file, mark)| place::check(&out.join(file), &inputs, &[*mark]))?;
    let exported = export::export(flight, format, out)?;
    for warning in &exported.warnings {
        note!("windhover: {}", one_line(warning));
    }
    for file in &exported.files {
        note!("wrote {}", file.display());
    }
    Ok(())
}

/// `flight.mcap` and `FLIGHTS/flight/` both give `flight` in the working directory; a directory of segments of the same
/// name gets `flight-export`, so that nothing is written into a flight.
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
