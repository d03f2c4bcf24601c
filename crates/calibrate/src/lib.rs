#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

pub mod boresight;
mod boresight_filter;
mod boresight_state;
mod charuco;
mod chessboard;
#[cfg(test)]
mod drawn_board;
mod grid;
pub mod intrinsics;
mod least_squares;
pub mod montecarlo;
#[cfg(test)]
mod photographed_sheet;
mod saddle;
mod spread;
mod subpixel;
mod tag_grid;
mod zhang;

pub use charuco::{CharucoBoard, CharucoError};
pub use chessboard::{BoardError, Corners, WINDOW_PX, find_corners};
pub use tag_grid::{TagGrid, TagGridError};
pub use zhang::{PlanePose, PlaneView};
