//! The corners of a marker on its vehicle.

use nalgebra::Vector3;

use windhover_base::settings::MarkerConfig;

/// The corners of a marker in the vehicle frame, metres: top-left, top-right, bottom-right,
/// bottom-left of the tag as printed, seen from above; of a disc, of the square around it.
///
/// ```
/// use windhover_simulate::{Scenario, corners_in_vehicle};
///
/// let scenario = Scenario::named("hover10").expect("a named scenario");
/// let marker = &scenario.rig.target[0].marker[0];
/// let [top_left, top_right, ..] = corners_in_vehicle(marker);
/// assert!(((top_right - top_left).norm() - marker.size_m.expect("a tag")).abs() < 1e-9);
/// ```
pub fn corners_in_vehicle(marker: &MarkerConfig) -> [Vector3<f64>; 4] {
    let half = 0.5 * marker.size_m.or(marker.diameter_m).unwrap_or(0.0);
    let (s, c) = marker.yaw_deg.to_radians().sin_cos();
    let centre = Vector3::from(marker.position_m);
    // Along the tag's top (clockwise from vehicle forward by yaw) and along its right.
    let corner =
        |top: f64, right: f64| centre + Vector3::new(c * top - s * right, s * top + c * right, 0.0) * half;
    [corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0), corner(-1.0, -1.0)]
}
