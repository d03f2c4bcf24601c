//! Drawings as SVG text: charts of data, equal-scale maps, images of error. Values in, strings out.
//!
//! A chart names its colours by class: [`standalone`] adds a style sheet that follows the reader's light or dark
//! setting, and a page that embeds charts contains the same sheet once.

mod chart;
mod geometry;
mod ink;
pub mod intrinsics;
mod mark;
pub mod montecarlo;
mod scale;
mod style;

pub use chart::Chart;
pub use geometry::{ellipse, thin};
pub use ink::Ink;
pub use mark::Mark;
pub use scale::Scale;
pub use style::{CHART_CSS, MADE_BY, PALETTE_CSS, standalone};
