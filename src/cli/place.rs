//! Output files of commands: an input is never overwritten, and another file that the command did not make only with
//! the user's consent.

use std::io::{BufRead as _, IsTerminal as _, Write as _};
use std::path::Path;

use super::{CliError, CliResult};
use crate::io::new_file::{self, Inputs, NewFile};
use crate::text;

/// Marks of drawings that `plot::standalone` makes.
pub(super) const DRAWING: [&str; 2] = ["<svg", crate::plot::MADE_BY];

/// Checks whether a command that reads `inputs` may write to `output`. Its own earlier output is recognised by the
/// `marks`.
///
/// # Errors
/// The reason why it may not; nothing was written.
pub(super) fn check(output: &Path, inputs: &Inputs, marks: &[&str]) -> CliResult {
    inputs.allow(output).map_err(CliError::usage)?;
    if new_file::is_free(output, marks) {
        return Ok(());
    }
    let name = output.display();
    match asked(&format!("{name} exists and was not made by this command; overwrite it?"))? {
        Some(true) => Ok(()),
        Some(false) => Err(CliError::failed(format!("{name}: left unchanged"))),
        None => Err(CliError::failed(format!(
            "{name} exists and was not made by this command; remove it first, or choose another file"
        ))),
    }
}

/// Writes a small file to a place that was checked.
///
/// # Errors
/// It cannot be written; an earlier file remains.
pub(super) fn write(output: &Path, content: &str) -> CliResult {
    NewFile::write(output, content.as_bytes())
        .map_err(|error| CliError::failed(format!("cannot write {}: {error}", output.display())))
}

/// Asks on the terminal; `None` where there is none.
///
/// # Errors
/// The terminal fails.
pub(super) fn asked(question: &str) -> Result<Option<bool>, CliError> {
    let (stdin, mut stderr) = (std::io::stdin(), std::io::stderr());
    if !(stdin.is_terminal() && stderr.is_terminal()) {
        return Ok(None);
    }
    stderr.write_all(format!("{} [y/N] ", text::one_line(question)).as_bytes())?;
    stderr.flush()?;
    let mut answer = String::new();
    stdin.lock().read_line(&mut answer)?;
    Ok(Some(matches!(answer.trim(), "y" | "Y" | "yes")))
}
