//! Regions of interest.

use nalgebra::Vector2;
use windhover_base::msg::ImageView;

/// A region of interest: the part of an image that is searched, pixels.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Roi {
    /// Leftmost column.
    pub u: usize,
    /// Topmost row.
    pub v: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Roi {
    /// The part of an image within `radius` of a point; `None` where nothing of it is inside.
    pub fn around(image: ImageView<'_>, center: Vector2<f64>, radius: f64) -> Option<Self> {
        let span = |c: f64, size: usize| {
            let low = (c - radius).floor().max(0.0);
            let high = (c + radius).ceil().min(size as f64 - 1.0);
            (low <= high).then(|| (low as usize, (high - low) as usize + 1))
        };
        let (u, width) = span(center.x, image.width)?;
        let (v, height) = span(center.y, image.height)?;
        Some(Self { u, v, width, height })
    }
}
