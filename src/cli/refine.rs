//! `windhover refine FLIGHT… [--out FILE] [--adopt] [--redetect] [--positions FILE] [--surveyed ID:PLACE] [--truth TRUTH.csv]`

use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressStyle};

use super::surveyed::SurveyedArgs;
use super::{CliError, CliResult, place};
use crate::app::flight::Flight;
use crate::app::refine::{
    RefineFlightError, RefinedFlight, adopted, beside, constant_words, refine_flights, source_name, too_many,
};
use crate::app::replay::{self, ReplayError};
use crate::app::report;
use crate::app::truth::Truth;
use crate::cli::out::{note, out, outln};
use crate::io::mcap_write::Maker;
use crate::io::new_file::Inputs;
use crate::text::one_line;

/// Estimate a whole flight at once, afterwards: the paths of helicopter and vehicles, and constants of the
/// configuration.
///
/// The flight must have the pipeline's detections: replay a capture first. The output has the flight without its
/// pictures, and the refined estimates beside the real-time ones: `windhover report` and `windhover export` show both.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover refine flight.mcap                              # flight.refined.mcap
  windhover refine flight.mcap --adopt                      # and the determined constants as TOML
  windhover refine flight.mcap --truth flight.truth.csv --out refined.mcap
  windhover refine flight.mcap --redetect                   # from its pictures, with this version's detector
  windhover refine monday.mcap tuesday.mcap                 # two flights over the same markers, with constants in common
  windhover refine flight.mcap --positions base.pos         # with a base station's solution (RTKLIB, GPX, CSV)
  windhover refine survey.mcap --surveyed 7:30.069604785,-85.575391587,6.0
  windhover export refined.mcap --format csv                # refined.csv among the tables")]
pub(super) struct Args {
    /// Flights: .mcap files, or directories of segments; several are of the same vehicles and configuration
    #[arg(required = true, value_name = "FLIGHT")]
    flights: Vec<PathBuf>,
    /// Output file, for one flight [default: FLIGHT.refined.mcap beside each flight]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print the constants that the flight determines (beyond three sigmas) as TOML for the configuration
    #[arg(long)]
    adopt: bool,
    /// Detect markers and ground features in the pictures again, with this version's detector, and refine that
    #[arg(long)]
    redetect: bool,
    /// External positions of the antenna: RTKLIB's .pos, a .gpx track, or .csv with time_ns or utc, lat_deg, lon_deg,
    /// height_m (above the ellipsoid), sigma_m
    #[arg(long, value_name = "FILE")]
    positions: Option<PathBuf>,
    #[command(flatten)]
    surveyed: SurveyedArgs,
    /// Compare the first flight with true positions: CSV as `windhover report` takes it
    #[arg(long, value_name = "TRUTH.csv")]
    truth: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> CliResult {
    if args.out.is_some() && args.flights.len() > 1 {
        return Err(CliError::usage(
            "--out names one file: with several flights each result is written beside its flight",
        ));
    }
    let outs: Vec<PathBuf> = match &args.out {
        Some(out) => vec![out.clone()],
        None => args.flights.iter().map(|flight| beside(flight)).collect(),
    };
    let read = args.flights.iter().chain(&args.truth).chain(&args.positions);
    let inputs = Inputs::of(read.map(PathBuf::as_path));
    outs.iter().try_for_each(|out| place::check(out, &inputs, &Maker::Refine.marks()))?;
    let truth = args.truth.as_deref().map(Truth::read).transpose()?;
    let anew = if args.redetect { redetected(&args.flights, &outs)? } else { Vec::new() };
    let flights: Vec<PathBuf> = match args.redetect {
        true => anew.iter().map(|anew| anew.0.clone()).collect(),
        false => args.flights.clone(),
    };
    let done = refined(&flights, args.positions.as_deref(), &args.surveyed)?;
    for ((done, from), to) in done.iter().zip(&flights).zip(&outs) {
        done.write(from, to)?;
        for warning in done.flight.warnings.iter().chain(&done.remarks) {
            note!("windhover: {}", one_line(warning));
        }
    }
    // Constants are common to all flights.
    if let Some(first) = done.first() {
        if args.adopt { print_adopted(first)? } else { print_found(first)? }
    }
    if let (Some(truth), Some(first)) = (&truth, outs.first()) {
        let table = report::error_text(&Flight::read(first)?, truth);
        out!("\n{}", table.unwrap_or_else(|| "there is nothing to compare with the truth\n".to_owned()))?;
    }
    outs.iter().for_each(|to| note!("wrote {}", to.display()));
    Ok(())
}

/// A flight as the pipeline makes it of a recording, while it is needed.
struct Redetected(PathBuf);

impl Drop for Redetected {
    fn drop(&mut self) {
        // Nothing is lost where it stays.
        let _ = std::fs::remove_file(&self.0);
    }
}

/// Replays flights, each beside its result.
fn redetected(flights: &[PathBuf], outs: &[PathBuf]) -> Result<Vec<Redetected>, CliError> {
    let one = |(flight, out): (&PathBuf, &PathBuf)| {
        let config = replay::config_of(flight).map_err(|error| match error {
            ReplayError::BadConfig { .. } | ReplayError::NoConfig { .. } => CliError::config(error),
            other => CliError::failed(other),
        })?;
        let anew = Redetected(out.with_extension("redetected.mcap"));
        replay::replay(flight, &config, Some(&anew.0), false, &mut |_| {})?;
        Ok(anew)
    };
    flights.iter().zip(outs).map(one).collect()
}

/// Refines flights, with a progress bar.
pub(super) fn refined(
    flights: &[PathBuf],
    positions: Option<&Path>,
    surveyed: &SurveyedArgs,
) -> Result<Vec<RefinedFlight>, CliError> {
    let bar = progress_bar();
    let done = refine_flights(flights, positions, &surveyed.tags(), &mut |share| {
        bar.set_position((share * STEPS as f64) as u64);
        true
    });
    bar.finish_and_clear();
    done.map_err(|error| match error {
        RefineFlightError::Config(wrong @ (ReplayError::NoConfig { .. } | ReplayError::BadConfig { .. })) => {
            CliError::config(wrong)
        }
        other => CliError::failed(other),
    })
}

/// Prints the constants that a flight determines to differ from its configuration, as TOML.
pub(super) fn print_adopted(done: &RefinedFlight) -> CliResult {
    let wrong = too_many(&done.refined, &done.config);
    if !wrong.is_empty() {
        note!(
            "nothing is adopted: the flight shows {} to be wrong at once, and one flight does not tell their effects apart. \
             Measure some of them, correct the configuration, replay and refine again",
            one_line(&wrong.join(", "))
        );
        return Ok(());
    }
    let toml = adopted(&done.refined, &done.config);
    if toml.is_empty() {
        note!("the flight determines no constant that differs from the configuration");
    }
    out!("{toml}")
}

fn print_found(done: &RefinedFlight) -> CliResult {
    let targets = &done.config.target[..];
    let estimated = || done.refined.constants.iter().filter(|constant| constant.prior_sigma > 0.0);
    outln!("constants of the configuration                  value  one sigma  expected")?;
    for constant in estimated().filter(|constant| constant.is_determined()) {
        let words = constant_words(constant.kind, targets);
        let [value, sigma, prior, prior_sigma] =
            [constant.value, constant.sigma, constant.prior, constant.prior_sigma].map(|x| x / words.scale);
        let mark = if constant.is_settled() { "  settled" } else { "" };
        outln!(
            "{:<42} {value:>10.3} {sigma:>10.3}  {prior:.3} ± {prior_sigma:.3} {}{mark}",
            words.name,
            words.unit
        )?;
    }
    let silent: Vec<String> = estimated()
        .filter(|constant| !constant.is_determined())
        .map(|constant| constant_words(constant.kind, targets).name)
        .collect();
    if !silent.is_empty() {
        outln!("\nnot determined by this flight, at the expected value: {}", silent.join(", "))?;
    }
    for tally in done.refined.tallies.iter().filter(|tally| tally.outliers > 0) {
        let name = source_name(tally.source, targets);
        outln!("{name}: {} of {} measurements are outside the gate", tally.outliers, tally.taken)?;
    }
    Ok(())
}

/// Steps of the bar.
const STEPS: u64 = 1000;

/// A bar on a terminal; nothing where standard error is a file.
fn progress_bar() -> ProgressBar {
    let style = ProgressStyle::with_template("{wide_bar} {percent:>3} %  {elapsed}");
    let bar = ProgressBar::new(STEPS);
    match style {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}
