//! Calibration, and what accuracy to expect of it: the camera's intrinsics from boards, mounting
//! angles from flights, the paper's Monte Carlo analysis.

pub mod montecarlo;
mod montecarlo_plot;

pub use montecarlo_plot::{Overlay, scatter_svg};
