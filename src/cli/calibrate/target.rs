//! What was photographed: a chessboard, one with tags in its squares, or a grid of tags, as arguments.

use std::str::FromStr;

use crate::cli::CliError;
use windhover_base::msg::TagFamily;
use windhover_calibrate::{CharucoBoard, TagGrid};

/// The calibration target.
#[derive(clap::Args, Clone, Copy, Debug)]
pub(super) struct TargetArgs {
    /// Inner corners of a chessboard, columns x rows (10x7 squares have 9x6); with --gap-m, tags
    #[arg(long, value_name = "CxR")]
    board: Board,
    /// A chessboard: edge of one square, metres
    #[arg(long, value_name = "METRES", value_parser = positive, required_unless_present = "tag_m")]
    square_m: Option<f64>,
    /// Edge of a tag's black square, metres: with --gap-m of a grid of tags numbered from 0 row by row, with --square-m of
    /// the tags in a chessboard's white squares (ChArUco, as OpenCV draws it)
    #[arg(long, value_name = "METRES", value_parser = positive)]
    tag_m: Option<f64>,
    /// White between one tag's black square and the next one's, metres
    #[arg(long, value_name = "METRES", value_parser = positive, requires = "tag_m", conflicts_with = "square_m")]
    gap_m: Option<f64>,
    /// Family of the tags
    #[arg(long, value_name = "FAMILY", default_value = "36h11", requires = "tag_m")]
    family: TagFamily,
}

/// The same, as one value.
#[derive(Clone, Copy, Debug)]
pub(super) enum Target {
    /// A chessboard.
    Chessboard {
        /// Its inner corners.
        board: Board,
        /// Edge of a square, metres.
        square_m: f64,
    },
    /// A chessboard with tags in its white squares.
    Charuco(CharucoBoard),
    /// A grid of tags.
    Tags(TagGrid),
}

impl TargetArgs {
    pub(super) fn target(&self) -> Result<Target, CliError> {
        let Board { columns, rows } = self.board;
        match (self.square_m, self.tag_m, self.gap_m) {
            (Some(square_m), None, _) => Ok(Target::Chessboard { board: self.board, square_m }),
            (None, Some(tag_m), Some(gap_m)) => {
                self.check_tags(columns * rows)?;
                Ok(Target::Tags(TagGrid { family: self.family, columns, rows, tag_m, gap_m }))
            }
            (Some(square_m), Some(tag_m), None) => {
                if tag_m >= square_m {
                    return Err(CliError::usage(
                        "--tag-m must be less than --square-m: tags lie inside squares",
                    ));
                }
                let board = CharucoBoard { family: self.family, columns, rows, square_m, tag_m };
                self.check_tags(board.tags())?;
                Ok(Target::Charuco(board))
            }
            _ => Err(CliError::usage(
                "give --square-m for a chessboard, with --tag-m for one with tags, or --tag-m and --gap-m for tags",
            )),
        }
    }

    fn check_tags(&self, wanted: usize) -> Result<(), CliError> {
        let (name, most) = (self.family.name(), self.family.codes());
        match wanted <= most {
            true => Ok(()),
            false => Err(CliError::usage(format!("the board has {wanted} tags, {name} has {most} only"))),
        }
    }
}

/// Columns and rows.
#[derive(Clone, Copy, Debug)]
pub(super) struct Board {
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl FromStr for Board {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let (columns, rows) = text.split_once(['x', 'X']).ok_or("write it as 9x6")?;
        let count = |t: &str| t.trim().parse().map_err(|_| format!("{t:?} is not a number; write it as 9x6"));
        let board = Self { columns: count(columns)?, rows: count(rows)? };
        let fits = |n: usize| (3..=200).contains(&n);
        if fits(board.columns) && fits(board.rows) {
            Ok(board)
        } else {
            Err("a board has 3 to 200 inner corners, or tags, each way".into())
        }
    }
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("{text:?} is not a number"))?;
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err("must be above zero".into()) }
}
