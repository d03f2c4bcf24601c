//! What several tests make up alike.

use windhover_base::msg::TagFamily;
use windhover_base::settings::{Brightness, MarkerConfig, MarkerKind, TargetConfig, TargetModel};
use windhover_detect::{CameraModel, LensModel};

/// A disc half a metre above the ground and `ahead_m` before the rear axle: light, dark, or where neither is said,
/// red.
pub fn disc(diameter_m: f64, brightness: Option<Brightness>, ahead_m: f64) -> MarkerConfig {
    MarkerConfig {
        kind: MarkerKind::Disc,
        family: None,
        id: None,
        border: 1,
        mirrored: false,
        inverted: false,
        size_m: None,
        diameter_m: Some(diameter_m),
        brightness,
        color: brightness.is_none().then(|| "#d02020".to_owned()),
        position_m: [ahead_m, 0.0, -0.5],
        yaw_deg: 0.0,
    }
}

/// A tag of family 36h11.
pub fn tag(id: u32) -> MarkerConfig {
    MarkerConfig {
        kind: MarkerKind::Apriltag,
        family: Some(TagFamily::Tag36h11),
        id: Some(id),
        border: 1,
        mirrored: false,
        inverted: false,
        size_m: Some(0.48),
        diameter_m: None,
        brightness: None,
        color: None,
        position_m: [0.0, 0.0, -0.5],
        yaw_deg: 0.0,
    }
}

/// A vehicle with these markers.
pub fn target(marker: Vec<MarkerConfig>) -> TargetConfig {
    let (name, model) = ("ugv".to_owned(), TargetModel::Unicycle);
    TargetConfig { name, model, wheelbase_m: None, reference_m: 0.0, marker }
}

/// A lens without distortion.
pub fn lens(focal: f64, (cx, cy): (f64, f64)) -> CameraModel {
    CameraModel { fx: focal, fy: focal, cx, cy, model: LensModel::Brown, distortion: [0.0; 5], skew: 0.0 }
}
