//! Errors as people see them, and exit codes.

use std::fmt::Display;
use std::process::ExitCode;

use crate::app::log::last_words;

/// Done.
pub const DONE: u8 = 0;
/// Tried and failed.
pub const FAILED: u8 = 1;
/// Wrong usage.
pub const WRONG_USAGE: u8 = 2;
/// Bad configuration (EX_CONFIG of sysexits.h).
pub const BAD_CONFIG: u8 = 78;

/// Result of a command.
pub type CliResult = Result<(), CliError>;

/// A message for people and the exit code that goes with it.
#[derive(Debug)]
pub struct CliError {
    message: String,
    code: u8,
}

impl CliError {
    /// Tried and failed.
    pub fn failed(message: impl Display) -> Self {
        Self { message: message.to_string(), code: FAILED }
    }

    /// Wrong usage.
    pub fn usage(message: impl Display) -> Self {
        Self { message: message.to_string(), code: WRONG_USAGE }
    }

    /// Bad configuration.
    pub fn config(message: impl Display) -> Self {
        Self { message: message.to_string(), code: BAD_CONFIG }
    }
}

impl<E: std::error::Error> From<E> for CliError {
    fn from(error: E) -> Self {
        Self::failed(error)
    }
}

/// Prints the error, if any, and gives the exit code.
pub(super) fn exit_code(result: CliResult) -> ExitCode {
    match result {
        Ok(()) => ExitCode::from(DONE),
        Err(error) => {
            last_words(&format!("windhover: {}", error.message));
            ExitCode::from(error.code)
        }
    }
}
