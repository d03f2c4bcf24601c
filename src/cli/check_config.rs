//! `windhover check-config FILE`

use std::path::PathBuf;

use super::{CliError, CliResult};
use crate::app::config_file;
use crate::cli::out::out;

/// Check a configuration, and print the effective one with every default filled in.
#[derive(clap::Args, Debug)]
#[command(after_help = "Example:
  windhover check-config /etc/windhover/windhover.toml && echo ok

Errors name the line or the key; the exit code is then 78.")]
pub(super) struct Args {
    /// Configuration file
    file: PathBuf,
}

pub(super) fn run(args: &Args) -> CliResult {
    let config = config_file::load(&args.file).map_err(CliError::config)?;
    out!("{}", config.to_toml().map_err(CliError::config)?)?;
    Ok(())
}
