//! Errors as people see them, and exit codes.

use std::fmt::Display;
use std::process::ExitCode;

use super::out;
use crate::app::log::last_words;
use crate::text;

/// Success.
pub const DONE: u8 = 0;
/// Failure.
pub const FAILED: u8 = 1;
/// Wrong usage.
pub const WRONG_USAGE: u8 = 2;
/// Bad configuration (EX_CONFIG of sysexits.h).
pub const BAD_CONFIG: u8 = 78;

/// Result of a command.
pub type CliResult = Result<(), CliError>;

/// A message of one or two lines, and its exit code.
#[derive(Debug)]
pub struct CliError {
    /// Empty where there is no message.
    message: String,
    code: u8,
}

impl CliError {
    /// A failure.
    pub fn failed(message: impl Display) -> Self {
        Self { message: message.to_string(), code: FAILED }
    }

    /// Wrong usage.
    pub fn usage(message: impl Display) -> Self {
        Self { message: message.to_string(), code: WRONG_USAGE }
    }

    /// The reader of standard output has closed it: nothing failed, and no message can be shown.
    pub(super) fn unread() -> Self {
        Self { message: String::new(), code: DONE }
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

/// Prints the error, if any, and returns the exit code.
pub(super) fn exit_code(result: CliResult) -> ExitCode {
    match result.and_then(|()| out::flush()) {
        Ok(()) => ExitCode::from(DONE),
        Err(error) => {
            if !error.message.is_empty() {
                let message = text::without_numbers(&error.message);
                last_words(&format!("windhover: {}", text::printable(&message)));
            }
            ExitCode::from(error.code)
        }
    }
}
