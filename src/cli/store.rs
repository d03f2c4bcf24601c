//! `windhover store …`: flights on the flash card.

mod check;
mod show;

use std::path::{Path, PathBuf};

use clap::{Args as ClapArgs, Subcommand};

use super::{CliError, CliResult, place};
use crate::app::config_file;
use crate::cli::out::outln;
use crate::io::store::flight::{self, FLIGHTS};
use crate::io::store::inspect;
use crate::io::store::volume::Volume;

/// The daemon's configuration.
const CONFIG: &str = "/etc/windhover/windhover.toml";

/// Show and manage the flights on the data card.
///
/// FLIGHT is a directory name as `store list` shows it, or a unique prefix of one. Everything except `rebuild` works
/// while the daemon records; the flight being recorded is never touched.
#[derive(ClapArgs, Debug)]
pub(super) struct Args {
    /// Configuration that names the store
    #[arg(long, global = true, value_name = "FILE", default_value = CONFIG)]
    config: PathBuf,
    /// Directory of the store, instead of the configuration's store.path
    #[arg(long, global = true, value_name = "DIR")]
    path: Option<PathBuf>,
    #[command(subcommand)]
    action: Action,
}

#[derive(Subcommand, Debug)]
enum Action {
    /// List all flights, oldest first
    List {
        /// One JSON object on each line
        #[arg(long)]
        json: bool,
    },
    /// Describe a flight: durations, sizes, gaps, dropouts, and its effect on the card's life
    Show {
        /// Flight
        flight: String,
        /// As JSON
        #[arg(long)]
        json: bool,
    },
    /// Read every byte of flights and compare them with the index; changes nothing
    Verify {
        /// Flights [default: all]
        flight: Vec<String>,
    },
    /// Seal segments that are cut or have gaps, keeping every complete chunk
    Repair {
        /// Flights [default: all]
        flight: Vec<String>,
    },
    /// Rebuild the index from the segments (the daemon must not run)
    Rebuild,
    /// Write the outputs of a flight for other tools
    Export(Export),
    /// Protect flights from deletion
    Keep {
        /// Flights
        #[arg(required = true)]
        flight: Vec<String>,
        /// Remove the protection again
        #[arg(long)]
        undo: bool,
    },
    /// Delete flights
    Delete {
        /// Flights
        #[arg(required = true)]
        flight: Vec<String>,
        /// Do not ask for confirmation
        #[arg(long, short)]
        yes: bool,
    },
}

#[derive(ClapArgs, Debug)]
struct Export {
    /// Flight
    flight: String,
    /// What to write
    #[arg(long, value_enum)]
    format: crate::app::export::Format,
    /// Directory to write into [default: named after the flight]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> CliResult {
    let root = match &args.path {
        Some(path) => path.clone(),
        None => PathBuf::from(config_file::load(&args.config).map_err(CliError::config)?.store.path),
    };
    if !root.is_dir() {
        let root = root.display();
        return Err(CliError::failed(format!("no store at {root}; is the data card mounted? (--path DIR)")));
    }
    let called = called(args);
    match &args.action {
        Action::List { json } => show::list(&root, *json),
        Action::Show { flight, json } => show::show(&root, &resolve(&root, flight, &called)?, *json),
        Action::Verify { flight } => {
            check::verify(&root, &resolve_all(&root, flight, &called)?, flight.is_empty(), &called)
        }
        Action::Repair { flight } => check::repair(&root, &resolve_all(&root, flight, &called)?),
        Action::Rebuild => check::rebuild(&root),
        Action::Export(export) => run_export(&root, export, &called),
        Action::Keep { flight, undo } => keep(&root, &resolve_all(&root, flight, &called)?, !undo),
        Action::Delete { flight, yes } => delete(&root, &resolve_all(&root, flight, &called)?, *yes, &called),
    }
}

/// The command line of `store`, for advice that can be typed as it is.
fn called(args: &Args) -> String {
    let quoted = |path: &Path| {
        let path = path.display().to_string();
        let plain = path.chars().all(|c| c.is_ascii_alphanumeric() || "/._-+,:@".contains(c));
        if plain { path } else { format!("'{}'", path.replace('\'', r"'\''")) }
    };
    match &args.path {
        Some(path) => format!("windhover store --path {}", quoted(path)),
        None if args.config != Path::new(CONFIG) => {
            format!("windhover store --config {}", quoted(&args.config))
        }
        None => "windhover store".into(),
    }
}

/// The flight of that name, or the only one whose name begins with it.
fn resolve(root: &Path, asked: &str, called: &str) -> Result<String, CliError> {
    // Shells complete to paths: only the last part is the name.
    let asked = asked.trim_end_matches('/').rsplit('/').next().unwrap_or(asked);
    let names = flight::flight_names(root)?;
    if names.iter().any(|name| name == asked) {
        return Ok(asked.to_owned());
    }
    let mut like: Vec<&String> = names.iter().filter(|name| name.starts_with(asked)).collect();
    like.sort_unstable();
    match like[..] {
        [one] => Ok(one.clone()),
        [] => Err(CliError::failed(format!(
            "there is no flight {asked:?} in {}; see `{called} list`",
            root.display()
        ))),
        _ => Err(CliError::failed(format!(
            "{asked:?} may be {} or {}; give more of the name",
            like[0], like[1]
        ))),
    }
}

/// The requested flights; all, oldest first, where none was given.
fn resolve_all(root: &Path, asked: &[String], called: &str) -> Result<Vec<String>, CliError> {
    if asked.is_empty() {
        return Ok(inspect::list(root)?.0.into_iter().map(|info| info.name).collect());
    }
    asked.iter().map(|name| resolve(root, name, called)).collect()
}

fn run_export(root: &Path, export: &Export, called: &str) -> CliResult {
    let name = resolve(root, &export.flight, called)?;
    let out = export.out.clone().unwrap_or_else(|| PathBuf::from(&name));
    super::export::write(&root.join(FLIGHTS).join(&name), export.format, &out)
}

fn keep(root: &Path, names: &[String], keep: bool) -> CliResult {
    let volume = Volume::new(root);
    for name in names {
        flight::set_keep(&volume, name, keep)?;
        outln!("{name}: {}", if keep { "kept" } else { "may be deleted to make room" })?;
    }
    Ok(())
}

fn delete(root: &Path, names: &[String], yes: bool, called: &str) -> CliResult {
    refuse_in_the_air(root, names)?;
    let volume = Volume::new(root);
    for name in names {
        let info = inspect::glance(root, name)?;
        if info.keep {
            return Err(CliError::failed(format!(
                "{name} is marked keep; `{called} keep --undo {name}` first"
            )));
        }
        let question = || place::asked(&format!("delete {name}, {}?", show::size(info.bytes)));
        let no_terminal = || CliError::usage("there is no terminal to ask on; give --yes");
        if !yes && !question()?.ok_or_else(no_terminal)? {
            outln!("{name}: left unchanged")?;
            continue;
        }
        flight::delete(&volume, name)?;
        outln!("{name}: deleted")?;
    }
    Ok(())
}

fn refuse_in_the_air(root: &Path, names: &[String]) -> CliResult {
    match inspect::in_the_air(root)? {
        Some(present) if names.contains(&present) => {
            Err(CliError::failed(format!("{present} is being recorded; stop the daemon first")))
        }
        _ => Ok(()),
    }
}
