//! `windhover calibrate board`

use std::fmt::Write as _;
use std::path::PathBuf;

use super::intrinsics::{Board, positive};
use crate::cli::{CliError, CliResult};

/// Draw a chessboard to print, as SVG in real size.
#[derive(clap::Args, Debug)]
pub(super) struct Args {
    /// Inner corners: columns x rows (9x6 is a board of 10x7 squares)
    #[arg(long, value_name = "CxR")]
    board: Board,
    /// Edge of one square, metres
    #[arg(long, value_name = "METRES", value_parser = positive)]
    square_m: f64,
    /// The drawing
    #[arg(long, value_name = "FILE.svg", default_value = "board.svg")]
    out: PathBuf,
}

pub(super) fn run(args: &Args) -> CliResult {
    std::fs::write(&args.out, draw(args.board, args.square_m))
        .map_err(|e| CliError::failed(format!("cannot write {}: {e}", args.out.display())))?;
    println!("{}", args.out.display());
    Ok(())
}

/// The board with a white margin of one square, in millimetres.
fn draw(board: Board, square_m: f64) -> String {
    let (columns, rows) = (board.columns + 1, board.rows + 1);
    let edge = square_m * 1e3;
    let (width, height) = ((columns + 2) as f64 * edge, (rows + 2) as f64 * edge);
    let mut squares = String::new();
    for k in (0..columns * rows).filter(|k| (k % columns + k / columns).is_multiple_of(2)) {
        let (x, y) = ((k % columns + 1) as f64 * edge, (k / columns + 1) as f64 * edge);
        let _ = write!(squares, "M{x} {y}h{edge}v{edge}h-{edge}z");
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" viewBox=\"0 0 {width} {height}\">\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/><path fill=\"#000\" d=\"{squares}\"/>\
         <text x=\"{edge}\" y=\"{}\" font-family=\"sans-serif\" font-size=\"4\">{}x{} inner corners, squares of {edge} mm: print at 100 %</text></svg>\n",
        height - 0.4 * edge,
        board.columns,
        board.rows
    )
}
