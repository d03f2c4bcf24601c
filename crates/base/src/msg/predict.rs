//! What the filter expects of a frame before it is searched.

use nalgebra::Vector2;

use super::MarkerId;

/// Where a marker should be in a frame.
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

/// What the filter expects of a frame.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct FramePrediction {
    /// Markers that should be in view. A marker left out is not expected.
    pub markers: Vec<MarkerPrediction>,
    /// Whether some target is not held: the whole frame is to be searched at once.
    pub search: bool,
    /// Smallest and largest apparent tag edge to expect from the camera's height over the ground,
    /// pixels; `None` where the height is not known.
    pub size_range_px: Option<(f64, f64)>,
    /// Circles (centre, radius, pixels) that vehicles cover: no ground features there.
    pub occupied: Vec<(Vector2<f64>, f64)>,
    /// Tracks of ground features that are of no ground: something that moves.
    pub moving: Vec<u64>,
    /// Around each of them no other feature is looked for, pixels.
    pub moving_radius_px: f64,
}

impl FramePrediction {
    /// Expects nothing: the whole frame is to be searched. Keeps its room.
    pub fn clear(&mut self) {
        self.markers.clear();
        self.occupied.clear();
        self.moving.clear();
        self.search = true;
        self.size_range_px = None;
    }
}
