//! `windhover generate`: manual pages and shell completions from the command line's definition, the reference of the
//! configuration from its types.

mod reference;

use std::path::{Path, PathBuf};

use clap::CommandFactory;
use clap_complete::Shell;

use super::{Cli, CliError, CliResult};

/// Write manual pages, shell completions or the reference of the configuration, made from the program itself, into a directory.
#[derive(clap::Args, Debug)]
pub(super) struct Args {
    /// What to write
    #[arg(value_enum)]
    what: What,
    /// Directory, made if missing
    directory: PathBuf,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum What {
    /// Manual pages, one for each command
    Man,
    /// Completions for bash, zsh and fish
    Completions,
    /// The reference of the configuration, configuration.md
    Reference,
}

pub(super) fn run(args: &Args) -> CliResult {
    let failed = |error: std::io::Error| {
        CliError::failed(format!("cannot write into {}: {error}", args.directory.display()))
    };
    std::fs::create_dir_all(&args.directory).map_err(failed)?;
    match args.what {
        What::Man => man(&args.directory),
        What::Completions => completions(&args.directory),
        What::Reference => std::fs::write(args.directory.join("configuration.md"), reference::page()),
    }
    .map_err(failed)
}

fn man(directory: &Path) -> std::io::Result<()> {
    let mut command = Cli::command();
    command.build();
    man_of(&command, directory)
}

/// A page of the command and of each subcommand; not of `help`, whose pages would repeat the others.
fn man_of(command: &clap::Command, directory: &Path) -> std::io::Result<()> {
    let name = command.get_display_name().unwrap_or_else(|| command.get_name());
    let mut page = Vec::new();
    clap_mangen::Man::new(command.clone()).title(name.to_owned()).render(&mut page)?;
    std::fs::write(directory.join(format!("{name}.1")), page)?;
    let shown = |below: &&clap::Command| below.get_name() != "help" && !below.is_hide_set();
    command.get_subcommands().filter(shown).try_for_each(|below| man_of(below, directory))
}

fn completions(directory: &Path) -> std::io::Result<()> {
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        clap_complete::generate_to(shell, &mut Cli::command(), "windhover", directory)?;
    }
    Ok(())
}
