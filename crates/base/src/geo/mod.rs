//! Frames, the Earth, the camera, and geo-positioning.
//!
//! Frames: `ned` is the local tangent plane (north, east, down) at the datum; `body` is the aircraft (forward, right,
//! down); `camera` is image right, image down, optical axis; `vehicle` is the ground vehicle (forward, right, down)
//! with its origin on the ground under the middle of the rear axle. A rotation or pose is named `a_from_b`: it takes
//! coordinates in `b` to coordinates in `a`. Angles are radians.

mod camera;
mod declination;
mod ground;
mod locate;
mod rotations;
mod terrain;
mod wgs84;

pub use camera::{CameraModel, LensModel, Projection};
pub use declination::{DeclinationError, declination};
pub use ground::Ground;
pub use locate::{GroundPoint, LocateError, PoseSigmas, locate, locate_with_covariance};
pub use rotations::{
    ImageTop, Tilt, TiltConvention, body_from_camera, euler_312, euler_321, ned_from_body_312,
    ned_from_body_321, rot_x, rot_y, rot_z, skew, tilt_from_down, wrap_angle,
};
pub use terrain::{Terrain, TerrainError, Tile};
pub use wgs84::{Geodetic, LocalFrame};
