//! `windhover calibrate board`

use std::fmt::Write as _;
use std::path::PathBuf;

use super::target::{Board, Target, TargetArgs};
use crate::cli::out::outln;
use crate::cli::{CliError, CliResult, place};
use crate::io::new_file::Inputs;
use crate::plot::MADE_BY;
use windhover_calibrate::{CharucoBoard, TagGrid};
use windhover_detect::tag_pattern;

/// Draw a calibration target to print, as SVG in real size: a chessboard, one with tags in its white squares, or a grid of tags.
///
/// Print it at 100 %, measure it with a ruler, and glue the sheet to something flat and stiff.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover calibrate board --board 9x6 --square-m 0.025
  windhover calibrate board --board 6x4 --tag-m 0.035 --gap-m 0.01 --out tags.svg
  windhover calibrate board --board 9x6 --square-m 0.03 --tag-m 0.022 --family aruco_4x4_50 --out charuco.svg")]
pub(super) struct Args {
    #[command(flatten)]
    target: TargetArgs,
    /// The drawing
    #[arg(long, value_name = "FILE.svg", default_value = "board.svg")]
    out: PathBuf,
}

pub(super) fn run(args: &Args) -> CliResult {
    place::check(&args.out, &Inputs::default(), &place::DRAWING)?;
    let drawing = match args.target.target()? {
        Target::Chessboard { board, square_m } => chessboard(board, square_m),
        Target::Charuco(board) => charuco(&board),
        Target::Tags(grid) => tags(&grid)?,
    };
    place::write(&args.out, &drawing)?;
    outln!("{}", args.out.display())?;
    Ok(())
}

/// The board with a white margin of one square, in millimetres.
fn chessboard(board: Board, square_m: f64) -> String {
    let (columns, rows) = (board.columns + 1, board.rows + 1);
    let edge = square_m * 1e3;
    let mut squares = String::new();
    for k in (0..columns * rows).filter(|k| (k % columns + k / columns).is_multiple_of(2)) {
        let (x, y) = ((k % columns + 1) as f64 * edge, (k / columns + 1) as f64 * edge);
        let _ = write!(squares, "M{x} {y}h{edge}v{edge}h-{edge}z");
    }
    let words =
        format!("{}x{} inner corners, squares of {edge} mm: print at 100 %", board.columns, board.rows);
    sheet(((columns + 2) as f64 * edge, (rows + 2) as f64 * edge), edge, &squares, &words)
}

/// The chessboard with tags, its margin one square, in millimetres.
fn charuco(board: &CharucoBoard) -> String {
    let (edge, tag) = (board.square_m * 1e3, board.tag_m * 1e3);
    let mut cells = String::new();
    for (x, y) in board.squares(true) {
        let _ = write!(cells, "M{} {}h{edge}v{edge}h-{edge}z", (x + 1) as f64 * edge, (y + 1) as f64 * edge);
    }
    for (number, (x, y)) in board.squares(false).enumerate() {
        let pattern = tag_pattern(board.family, number as u32);
        let cell = tag / pattern.border as f64;
        let ring = (pattern.side() - pattern.border) / 2;
        let corner = |n: usize| (n + 1) as f64 * edge + 0.5 * (edge - tag);
        for k in 0..pattern.border * pattern.border {
            let (column, row) = (k % pattern.border, k / pattern.border);
            if !pattern.white(column + ring, row + ring) {
                let (left, top) = (corner(x) + column as f64 * cell, corner(y) + row as f64 * cell);
                let _ = write!(cells, "M{left:.4} {top:.4}h{cell:.4}v{cell:.4}h-{cell:.4}z");
            }
        }
    }
    let words = format!(
        "{}x{} inner corners, squares of {edge} mm, tags of {}, {tag} mm: print at 100 %",
        board.columns,
        board.rows,
        board.family.name()
    );
    let span = |corners: usize| (corners + 3) as f64 * edge;
    sheet((span(board.columns), span(board.rows)), edge, &cells, &words)
}

/// The grid with a white margin of half a tag, in millimetres.
fn tags(grid: &TagGrid) -> Result<String, CliError> {
    let (edge, gap) = (grid.tag_m * 1e3, grid.gap_m * 1e3);
    let first = tag_pattern(grid.family, 0);
    let cell = edge / first.border as f64;
    let ring = (first.side() - first.border) as f64 / 2.0 * cell;
    if gap < 2.0 * ring {
        return Err(CliError::usage(format!(
            "tags of {} need {:.1} mm between them, so that each keeps its own edge: give --gap-m {:.4} or more",
            grid.family.name(),
            2.0 * ring,
            2e-3 * ring
        )));
    }
    let margin = edge / 2.0 + ring;
    let mut cells = String::new();
    for number in 0..grid.columns * grid.rows {
        let pattern = tag_pattern(grid.family, number as u32);
        let corner = |n: usize| margin + n as f64 * (edge + gap) - ring;
        let (left, top) = (corner(number % grid.columns), corner(number / grid.columns));
        let side = pattern.side();
        for k in (0..side * side).filter(|k| !pattern.white(k % side, k / side)) {
            let (x, y) = (left + (k % side) as f64 * cell, top + (k / side) as f64 * cell);
            let _ = write!(cells, "M{x:.4} {y:.4}h{cell:.4}v{cell:.4}h-{cell:.4}z");
        }
    }
    let span = |n: usize| 2.0 * margin + n as f64 * (edge + gap) - gap;
    let words = format!(
        "{}x{} tags of {}, edge {edge} mm, gap {gap} mm: print at 100 %",
        grid.columns,
        grid.rows,
        grid.family.name()
    );
    Ok(sheet((span(grid.columns), span(grid.rows)), margin, &cells, &words))
}

/// A sheet of this size in millimetres with black squares and a line of text in its lower margin.
fn sheet((width, height): (f64, f64), margin: f64, squares: &str, words: &str) -> String {
    format!(
        "<!-- {MADE_BY} -->\n<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" viewBox=\"0 0 {width} {height}\">\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\
         <path fill=\"#000\" shape-rendering=\"crispEdges\" d=\"{squares}\"/>\
         <text x=\"{margin}\" y=\"{}\" font-family=\"sans-serif\" font-size=\"4\">{words}</text></svg>\n",
        height - 0.4 * margin
    )
}
