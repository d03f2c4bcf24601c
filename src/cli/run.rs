//! `windhover run`

use std::path::PathBuf;

use super::{CliError, CliResult};
use crate::app::run::{self, Prepared, RunError};

/// Run the daemon: read the sensors, estimate, record, send, until SIGTERM. SIGHUP reloads the configuration.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover check-config windhover.toml && windhover run --config windhover.toml
  systemctl start windhover                    # as the package installs it")]
pub(super) struct Args {
    /// Configuration file
    #[arg(long, value_name = "FILE", default_value = "/etc/windhover/windhover.toml")]
    config: PathBuf,
}

pub(super) fn run(args: &Args, prepared: std::io::Result<Prepared>) -> CliResult {
    let prepared = prepared.map_err(|error| CliError::failed(RunError::Start(error)))?;
    run::run(prepared, &args.config).map_err(|error| match error {
        RunError::Config(error) => CliError::config(error),
        error => CliError::failed(error),
    })
}
