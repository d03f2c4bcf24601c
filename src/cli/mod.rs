//! The command line: parse arguments, call the library, turn results into exit codes.

mod calibrate;
mod check_config;
mod decode;
mod detect;
mod error;
mod export;
mod generate;
mod ground;
mod import;
mod keys;
mod live;
mod montecarlo;
mod out;
mod place;
mod refine;
mod replay;
mod report;
mod run;
mod simulate;
mod store;
mod surveyed;

pub use error::{CliError, CliResult};

use std::process::ExitCode;

use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};

use crate::app::run::prepare;

/// Watches a ground vehicle from a small helicopter: its position, heading and motion.
#[derive(Parser, Debug)]
#[command(
    name = "windhover",
    version,
    max_term_width = 100,
    propagate_version = true,
    after_help = "Start without hardware:
  windhover simulate flight.mcap --duration 20            a simulated flight, and its truth
  windhover replay flight.mcap --out result.mcap          runs the pipeline on it
  windhover report result.mcap --truth flight.truth.csv   writes a page: report.html

`windhover COMMAND --help` describes each command, with examples. Exit codes: 0 done, 1 failed,
2 wrong usage, 78 bad configuration."
)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    Calibrate(calibrate::Args),
    Replay(replay::Args),
    Import(import::Args),
    Export(export::Args),
    /// Write manual pages and shell completions
    #[command(hide = true)]
    Generate(generate::Args),
    Run(run::Args),
    CheckConfig(check_config::Args),
    Decode(decode::Args),
    Ground(Box<ground::Args>),
    Keys(keys::Args),
    Montecarlo(montecarlo::Args),
    Refine(refine::Args),
    Report(report::Args),
    Store(store::Args),
    Detect(detect::Args),
    Simulate(simulate::Args),
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    // The daemon takes over its signals before anything else: parsing the command line takes milliseconds.
    let prepared = std::env::args_os().nth(1).is_some_and(|first| first == "run").then(prepare);
    let matches = with_negative_numbers(Cli::command()).try_get_matches();
    let cli = match matches.and_then(|matches| Cli::from_arg_matches(&matches)) {
        Ok(cli) => cli,
        // Help and version.
        Err(asked) if !asked.use_stderr() => return error::exit_code(out::written(asked.print())),
        Err(wrong) => {
            // Where even the message cannot be written, nothing can be done.
            let _ = wrong.print();
            return ExitCode::from(error::WRONG_USAGE);
        }
    };
    let result = match cli.command {
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Import(args) => import::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Generate(args) => generate::run(&args),
        Command::Run(args) => run::run(&args, prepared.unwrap_or_else(prepare)),
        Command::CheckConfig(args) => check_config::run(&args),
        Command::Decode(args) => decode::run(&args),
        Command::Ground(args) => ground::run(&args),
        Command::Keys(args) => keys::run(&args),
        Command::Montecarlo(args) => montecarlo::run(&args),
        Command::Refine(args) => refine::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Store(args) => store::run(&args),
        Command::Detect(args) => detect::run(&args),
        Command::Simulate(args) => simulate::run(&args),
    };
    error::exit_code(result)
}

/// The command and all its subcommands, with options that take `-5` as a value and not as another option.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    let command = command.mut_args(|arg| match arg.get_action().takes_values() {
        true => arg.allow_negative_numbers(true),
        false => arg,
    });
    command.mut_subcommands(with_negative_numbers)
}
