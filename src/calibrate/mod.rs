//! Calibration, and what accuracy to expect of it: the camera's intrinsics from boards, mounting
//! angles from flights, the paper's Monte Carlo analysis.

pub mod boresight;
mod boresight_filter;
mod chessboard;
#[cfg(test)]
mod drawn_board;
mod grid;
pub mod intrinsics;
mod intrinsics_plot;
mod least_squares;
pub mod montecarlo;
mod montecarlo_plot;
mod saddle;
mod subpixel;
mod tag_grid;
mod zhang;

pub use chessboard::{BoardError, Corners, WINDOW_PX, find_corners};
pub use intrinsics_plot::{coverage_advice, coverage_svg, per_view_svg, residuals_svg};
pub use montecarlo_plot::{Overlay, scatter_svg};
pub use tag_grid::{TagGrid, TagGridError};
pub use zhang::{PlanePose, PlaneView};
