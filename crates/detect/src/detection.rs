//! A tag that was found, and its accuracy.

use nalgebra::{Matrix2, Vector2};
use windhover_base::msg::{MarkerDetection, MarkerId, TagFamily};

/// A tag found in an image. Pixel (0, 0) is the centre of the image's top-left pixel, `x` is to the right and
/// `y` is down.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TagDetection {
    /// Family of the tag.
    pub family: TagFamily,
    /// Number of the tag in its family.
    pub id: u32,
    /// Wrong bits that were corrected.
    pub hamming: u8,
    /// Contrast between white and black cells at the weakest bit, grey levels.
    pub margin: f32,
    /// Intersection of the diagonals: the image of the tag's centre, pixels.
    pub center_px: Vector2<f64>,
    /// Covariance of the centre, px².
    pub center_cov_px2: Matrix2<f64>,
    /// Corners of the border: top-left, top-right, bottom-right, bottom-left of the tag as AprilRobotics
    /// prints it, pixels.
    pub corners_px: [Vector2<f64>; 4],
    /// Covariance of each corner, px².
    pub corner_cov_px2: [Matrix2<f64>; 4],
    /// Mean length of the border's edges, pixels.
    pub size_px: f64,
}

impl TagDetection {
    /// The same in an image of which the searched image is the part that begins at `origin`.
    pub(crate) fn moved(mut self, origin: Vector2<f64>) -> Self {
        self.center_px += origin;
        self.corners_px.iter_mut().for_each(|corner| *corner += origin);
        self
    }
}

impl From<&TagDetection> for MarkerDetection {
    fn from(tag: &TagDetection) -> Self {
        Self {
            marker: MarkerId::Tag { family: tag.family, id: tag.id },
            center_px: tag.center_px,
            center_cov_px2: tag.center_cov_px2,
            corners_px: Some(tag.corners_px),
            corner_cov_px2: tag.corner_cov_px2,
            hamming: tag.hamming,
            margin: tag.margin,
            size_px: tag.size_px,
        }
    }
}
