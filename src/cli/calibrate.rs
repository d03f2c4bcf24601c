//! `windhover calibrate`

mod adopt;
mod board;
mod boresight;
mod intrinsics;
mod target;

use super::CliResult;

/// Calibrate the camera and its mounting.
///
/// First the lens, from photographs of a printed board; then, from a flight over a tag at rest, the mounting angles of
/// camera and compass and the latency of each sensor. Any later flight shows what of its configuration is wrong.
#[derive(clap::Args, Debug)]
pub(super) struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand, Debug)]
enum What {
    Board(board::Args),
    Intrinsics(intrinsics::Args),
    Boresight(boresight::Args),
    Adopt(adopt::Args),
}

pub(super) fn run(args: &Args) -> CliResult {
    match &args.what {
        What::Board(args) => board::run(args),
        What::Intrinsics(args) => intrinsics::run(args),
        What::Boresight(args) => boresight::run(args),
        What::Adopt(args) => adopt::run(args),
    }
}
