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
mod montecarlo;
mod replay;
mod report;
mod run;
mod simulate;
mod store;

pub use error::{CliError, CliResult};

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Watches a ground vehicle from a small helicopter: where it is, where it points, how it moves.
#[derive(Parser, Debug)]
#[command(name = "windhover", version, max_term_width = 100, propagate_version = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Calibrate the camera and how it is mounted
    Calibrate(calibrate::Args),
    /// Run a recorded capture or flight through the pipeline that flies
    Replay(replay::Args),
    /// Make a capture of recordings you already have
    Import(import::Args),
    /// Write the outputs of a flight for other tools
    Export(export::Args),
    /// Write manual pages and shell completions
    #[command(hide = true)]
    Generate(generate::Args),
    /// Run the daemon: read the sensors, estimate, record, send
    Run(run::Args),
    /// Say what is wrong with a configuration, or print the effective one
    CheckConfig(check_config::Args),
    /// Decode a raw serial log of a GPS receiver or a compass
    Decode(decode::Args),
    /// Receive from payloads: keep their flights, show them on a web page, feed other programs
    Ground(ground::Args),
    /// Make the certificates with which payloads and ground stations know each other
    Keys(keys::Args),
    /// Predict how well the ground is located from here: the paper's error analysis
    Montecarlo(montecarlo::Args),
    /// Write a page about a flight
    Report(report::Args),
    /// See and tend the flights on the data card
    Store(store::Args),
    /// Find markers in images
    Detect(detect::Args),
    /// Make a capture of a simulated flight, with the truth beside it
    Simulate(simulate::Args),
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            let code = if error.use_stderr() { error::WRONG_USAGE } else { error::DONE };
            // Nothing can be done where even the message cannot be written.
            let _ = error.print();
            return ExitCode::from(code);
        }
    };
    let result = match cli.command {
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Import(args) => import::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Generate(args) => generate::run(&args),
        Command::Run(args) => run::run(&args),
        Command::CheckConfig(args) => check_config::run(&args),
        Command::Decode(args) => decode::run(&args),
        Command::Ground(args) => ground::run(&args),
        Command::Keys(args) => keys::run(&args),
        Command::Montecarlo(args) => montecarlo::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Store(args) => store::run(&args),
        Command::Detect(args) => detect::run(&args),
        Command::Simulate(args) => simulate::run(&args),
    };
    error::exit_code(result)
}
