//! Output of commands: results on standard output, remarks on standard error. Control sequences in foreign text are
//! escaped. A reader that closes its end ends the command without a message; a full disk is an error.

use std::fmt::Arguments;
use std::io::{self, ErrorKind, Write as _};

use super::CliError;
use crate::text;

/// Prints a line on standard output, as `println!` does.
macro_rules! outln {
    () => { $crate::cli::out::print(format_args!("\n")) };
    ($($words:tt)*) => { $crate::cli::out::print(format_args!("{}\n", format_args!($($words)*))) };
}

/// Prints on standard output, as `print!` does.
macro_rules! out {
    ($($words:tt)*) => { $crate::cli::out::print(format_args!($($words)*)) };
}

/// Prints a remark on standard error, as `eprintln!` does. It is lost where nothing reads it.
macro_rules! note {
    ($($words:tt)*) => { $crate::cli::out::remark(format_args!($($words)*)) };
}

pub(super) use {note, out, outln};

/// Prints text of one or more lines on standard output.
///
/// # Errors
/// Its reader has closed it ([`CliError::unread`]), or it cannot be written.
pub(super) fn print(words: Arguments<'_>) -> Result<(), CliError> {
    written(io::stdout().write_all(text::printable(&words.to_string()).as_bytes()))
}

/// The result of writing to standard output.
///
/// # Errors
/// As [`print()`].
pub(super) fn written<T>(outcome: io::Result<T>) -> Result<T, CliError> {
    outcome.map_err(|error| match error.kind() {
        ErrorKind::BrokenPipe => CliError::unread(),
        _ => CliError::failed(format!("cannot write to standard output: {error}")),
    })
}

/// Flushes standard output.
///
/// # Errors
/// As [`print()`].
pub(super) fn flush() -> Result<(), CliError> {
    written(io::stdout().flush())
}

/// Prints a remark of one or more lines on standard error.
pub(super) fn remark(words: Arguments<'_>) {
    let words = words.to_string();
    let line = format!("{}\n", text::printable(&text::without_numbers(&words)));
    // There may be no reader; the command continues.
    let _ = io::stderr().write_all(line.as_bytes());
}
