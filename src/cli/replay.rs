//! `windhover replay CAPTURE [--config FILE] [--out FLIGHT] [--realtime]`

use std::io::Write;
use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};

use super::{CliError, CliResult, place};
use crate::app::health::HealthLine;
use crate::app::replay::{self, ReplayError, ReplayStep};
use crate::app::{config_file, events, log};
use crate::cli::out::note;
use crate::io::clock::HostClock;
use crate::io::mcap_write::Maker;
use crate::io::new_file::Inputs;
use crate::text::{counted, one_line};
use windhover_base::msg::Output;

/// Run a recorded capture or flight through the pipeline: the same bytes and frames give the same estimates.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover replay capture.mcap --out flight.mcap      # with its attached configuration
  windhover replay capture.mcap --config other.toml --out flight.mcap
  windhover replay FLIGHTS/20261118T150405Z --log --realtime   # watch yesterday's flight again")]
pub(super) struct Args {
    /// Capture or flight: an .mcap file, or a directory of segments
    capture: PathBuf,
    /// Configuration [default: the one attached to the capture]
    #[arg(long)]
    config: Option<PathBuf>,
    /// Write the flight: all messages of the capture, and the outputs
    #[arg(long)]
    out: Option<PathBuf>,
    /// Replay at the recorded pace instead of as fast as possible
    #[arg(long)]
    realtime: bool,
    /// Print the operator's log on standard error
    #[arg(long)]
    log: bool,
}

pub(super) fn run(args: &Args) -> CliResult {
    let config = match &args.config {
        Some(file) => config_file::load(file).map_err(CliError::config)?,
        None => replay::config_of(&args.capture).map_err(|error| match error {
            ReplayError::BadConfig { .. } | ReplayError::NoConfig { .. } => CliError::config(error),
            other => CliError::failed(other),
        })?,
    };
    if let Some(out) = &args.out {
        let inputs = Inputs::of([Some(args.capture.as_path()), args.config.as_deref()].into_iter().flatten());
        place::check(out, &inputs, &Maker::Replay.marks())?;
    }
    let bar = progress_bar();
    let health_line = args.log.then(|| {
        log::start_direct(AboveBar(bar.clone()), HostClock::start());
        HealthLine::new(&config)
    });
    let summary =
        replay::replay(&args.capture, &config, args.out.as_deref(), args.realtime, &mut |step| match step {
            ReplayStep::Progress(done, total) => {
                bar.set_length(total);
                bar.set_position(done);
            }
            ReplayStep::Warning(words) => bar.suspend(|| note!("windhover: {}", one_line(words))),
            ReplayStep::Output(output) => {
                if let Some(health) = &health_line {
                    log_output(output, health);
                }
            }
        })?;
    bar.finish_and_clear();
    note!(
        "replayed {:.1} s and {} in {:.1} s: {:.1} times real time",
        summary.recorded.s(),
        counted(summary.frames as usize, "frame"),
        summary.took.s(),
        summary.recorded.s() / summary.took.s().max(1e-3)
    );
    if summary.frames == 0 {
        note!("no frame was received from the camera: only the helicopter's own state was estimated");
    }
    if let Some(out) = &args.out {
        note!("wrote {}", out.display());
    }
    Ok(())
}

/// The operator's log line, if the output makes one.
fn log_output(output: &Output, health_line: &HealthLine) {
    match output {
        Output::Notice(notice) => events::notice(notice),
        Output::Health(now) => health_line.emit(now, None),
        _ => {}
    }
}

/// Standard error, above the bar.
struct AboveBar(ProgressBar);

impl Write for AboveBar {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.suspend(|| std::io::stderr().write(bytes))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// A bar of bytes on a terminal; nothing where standard error is a file.
fn progress_bar() -> ProgressBar {
    let style = ProgressStyle::with_template("{wide_bar} {percent:>3} %  {elapsed} of about {duration}");
    let bar = ProgressBar::new(0);
    match style {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}
