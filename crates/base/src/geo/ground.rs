//! The ground on which the vehicle drives, as a surface in the NED frame.

use std::sync::Arc;

use nalgebra::Vector3;

use super::Terrain;

/// A ground surface.
///
/// ```
/// use windhover_base::geo::Ground;
/// use nalgebra::Vector3;
///
/// let ground = Ground::Flat { down_m: 2.0 };
/// let (from, direction) = (Vector3::new(0.0, 0.0, -8.0), Vector3::new(0.0, 1.0, 1.0));
/// assert_eq!(ground.intersect(&from, &direction, 0.0), Some(10.0));
/// // The roof of something 0.5 m high is met earlier; a ray that rises meets nothing.
/// assert_eq!(ground.intersect(&from, &direction, 0.5), Some(9.5));
/// assert_eq!(ground.intersect(&from, &-Vector3::z(), 0.0), None);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub enum Ground {
    /// A level plane at this down coordinate, metres.
    Flat {
        /// Down coordinate of the plane, metres.
        down_m: f64,
    },
    /// Heights of a terrain tile.
    Terrain(Arc<Terrain>),
}

impl Ground {
    /// Down coordinate of the surface under a point, metres.
    pub fn down_m(&self, north_m: f64, east_m: f64) -> f64 {
        match self {
            Self::Flat { down_m } => *down_m,
            Self::Terrain(terrain) => terrain.down_m(north_m, east_m),
        }
    }

    /// Distance along a ray (in lengths of `direction`) to the surface raised by `above_m`; `None` where the ray does
    /// not meet it from above (paper eq. 11 and 23, corrected).
    pub fn intersect(&self, origin: &Vector3<f64>, direction: &Vector3<f64>, above_m: f64) -> Option<f64> {
        match self {
            Self::Flat { down_m } => {
                let range = (down_m - above_m - origin.z) / direction.z;
                (direction.z > 0.0 && range > 0.0 && range.is_finite()).then_some(range)
            }
            Self::Terrain(terrain) => terrain.intersect(origin, direction, above_m),
        }
    }

    /// Slope ∂down/∂(north, east) under a point.
    pub fn slope(&self, north_m: f64, east_m: f64) -> [f64; 2] {
        match self {
            Self::Flat { .. } => [0.0, 0.0],
            Self::Terrain(terrain) => terrain.slope(north_m, east_m),
        }
    }
}
