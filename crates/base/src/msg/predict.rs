//! The filter's prediction of a frame before detection.

use nalgebra::Vector2;

use super::MarkerId;

/// The predicted place of a marker in a frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct MarkerPrediction {
    /// Which marker.
    pub marker: MarkerId,
    /// Its centre, pixels.
    pub center_px: Vector2<f64>,
    /// One-sigma of the centre, pixels (the larger axis).
    pub sigma_px: f64,
    /// Apparent size: a tag's mean edge, a disc's mean diameter, pixels.
    pub size_px: f64,
}

/// The filter's prediction of a frame.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct FramePrediction {
    /// Markers that should be in view. A marker that is not listed is not expected.
    pub markers: Vec<MarkerPrediction>,
    /// Whether some target has no track: then the whole frame is searched at once.
    pub search: bool,
    /// Smallest and largest expected apparent edge of a tag, from the camera's height over the ground, pixels; `None`
    /// where the height is not known.
    pub size_range_px: Option<(f64, f64)>,
    /// Circles (centre, radius, pixels) that vehicles cover: no ground features are used there.
    pub occupied: Vec<(Vector2<f64>, f64)>,
    /// Tracks of ground features that are not on the ground: they move.
    pub moving: Vec<u64>,
    /// No other feature is searched for within this distance of them, pixels.
    pub moving_radius_px: f64,
}

impl FramePrediction {
    /// Predicts nothing: the whole frame is to be searched. Keeps its allocated memory.
    pub fn clear(&mut self) {
        self.markers.clear();
        self.occupied.clear();
        self.moving.clear();
        self.search = true;
        self.size_range_px = None;
    }
}
