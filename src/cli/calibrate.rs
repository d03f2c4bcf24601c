//! `windhover calibrate`

mod board;
mod boresight;
mod intrinsics;

use super::CliResult;

/// Calibrate the camera and how it is mounted.
#[derive(clap::Args, Debug)]
pub(super) struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand, Debug)]
enum What {
    /// Draw a chessboard to print
    Board(board::Args),
    /// The lens, from photographs of a printed board
    Intrinsics(intrinsics::Args),
    /// How camera and compass are mounted and timed, from flights over markers at rest
    Boresight(boresight::Args),
}

pub(super) fn run(args: &Args) -> CliResult {
    match &args.what {
        What::Board(args) => board::run(args),
        What::Intrinsics(args) => intrinsics::run(args),
        What::Boresight(args) => boresight::run(args),
    }
}
