//! What several tests make up alike.

use windhover_base::settings::{Brightness, MarkerConfig, MarkerKind};

/// A disc half a metre above the ground and `ahead_m` before the rear axle: light, dark, or where neither is said,
/// red.
pub fn disc(diameter_m: f64, brightness: Option<Brightness>, ahead_m: f64) -> MarkerConfig {
    MarkerConfig {
        kind: MarkerKind::Disc,
        family: None,
        id: None,
        size_m: None,
        diameter_m: Some(diameter_m),
        brightness,
        color: brightness.is_none().then(|| "#d02020".to_owned()),
        position_m: [ahead_m, 0.0, -0.5],
        yaw_deg: 0.0,
    }
}
