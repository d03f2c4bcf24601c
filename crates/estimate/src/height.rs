//! Height over the ground by the size of tags, before anything of them is fused.
//!
//! A tag's size knows its range to a third of a percent, the receiver and the configured ground the height to some
//! metres. A first linear step from a height that is far off (12 m taken for 2 m) never recovers, so before a track
//! starts its tags are compared with what they should measure. Where they differ by more than a fifth, in three frames
//! that agree, the tags place the height; the receiver's bias takes the rest, and what is more than a bias is taken for
//! the ground, which lies elsewhere than configured.

use nalgebra::{Rotation3, Vector2};

use windhover_base::msg::MarkerDetection;
use windhover_base::time::MonoTime;

use super::blocks::{Block, own};
use super::core::Core;
use super::models::Marker;
use super::track::Life;

/// By what factor a depth may differ from that expected: a linear step from there holds.
const MOST_APART: f64 = 1.2;
/// Frames in a row that must agree before height is placed, and by what factor they may differ.
const FRAMES_TO_PLACE: u32 = 3;
const AGREEMENT: f64 = 1.1;
/// How well a tag's size is known before anything else says so, as a share.
const SIZE_SIGMA: f64 = 0.02;
/// Sigmas of the receiver's vertical bias within which a difference is taken for one.
const BIAS_SIGMAS: f64 = 3.0;
/// Flattest ray that shows a depth: its share along the vertical.
const FLATTEST: f64 = 0.1;

/// What the frames before a track's start have shown of height.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct HeightCheck {
    /// Frames in a row that contradict the height, and by what the last one placed it elsewhere, m.
    frames: u32,
    depth_m: f64,
    /// When height was last placed by tags: then, height over the ground and by how much it rose, m.
    pub(crate) placed: Option<(MonoTime, f64, f64)>,
}

impl Core {
    /// Whether the tags of a target about to start agree with the height, or have just placed it. Where they do not,
    /// nothing of them may be fused yet.
    pub(crate) fn height_agrees(&mut self, index: usize, markers: &[MarkerDetection]) -> bool {
        if self.at_truth || self.sees_another(index) {
            return true;
        }
        let Some((depth_m, expected_m)) = self.depth_of_tags(index, markers) else { return true };
        let check = &mut self.state.height;
        if expected_m > 0.0 && apart(depth_m, expected_m) < MOST_APART {
            check.frames = 0;
            return true;
        }
        let again = check.frames > 0 && apart(depth_m, check.depth_m) < AGREEMENT;
        check.frames = if again { check.frames + 1 } else { 1 };
        check.depth_m = depth_m;
        if check.frames < FRAMES_TO_PLACE {
            return false;
        }
        check.frames = 0;
        self.place_height(depth_m, depth_m - expected_m);
        true
    }

    /// Whether height is seen by the tags of another target.
    fn sees_another(&self, index: usize) -> bool {
        let seen = |life: Life| matches!(life, Life::Tracking(_) | Life::Acquiring { missing: false, .. });
        self.state.targets.iter().enumerate().any(|(i, target)| i != index && seen(target.life))
    }

    /// How far below the camera the tags of a target lie by their size, and by the filter; the median of its tags.
    fn depth_of_tags(&self, index: usize, markers: &[MarkerDetection]) -> Option<(f64, f64)> {
        let own = &self.state.own;
        let camera = own.position + own.ned_from_body * self.models.camera_at;
        let ground = self.models.ground.down_m(camera.x, camera.y);
        let depths = || {
            markers.iter().filter_map(|seen| {
                let (target, marker) = self.models.find(seen.marker)?;
                let marker = &self.models.targets[target].markers[marker];
                let depth_m = self.depth_by_size(marker, seen.corners_px.as_ref()?)?;
                (target == index).then_some((depth_m, ground + marker.center.z - camera.z))
            })
        };
        let n = depths().count();
        // The one that as many others lie above as below.
        let rank = |a: f64| depths().filter(|(depth_m, _)| *depth_m < a).count().abs_diff(n / 2);
        depths().min_by_key(|(depth_m, _)| rank(*depth_m))
    }

    /// Depth at which a level square of the marker's size has edges as they are seen.
    fn depth_by_size(&self, marker: &Marker, corners_px: &[Vector2<f64>; 4]) -> Option<f64> {
        let own = &self.state.own;
        let to_ned =
            own.ned_from_body * Rotation3::from_matrix_unchecked(self.models.camera_from_body.transpose());
        let mut at_one_metre = [Vector2::zeros(); 4];
        for (at, px) in at_one_metre.iter_mut().zip(corners_px) {
            let ray = to_ned * self.models.lens(&self.state.own).normalised(*px)?.push(1.0);
            if ray.z < FLATTEST * ray.norm() {
                return None;
            }
            *at = ray.xy() / ray.z;
        }
        let edges = (0..4).map(|k| (at_one_metre[k] - at_one_metre[(k + 1) % 4]).norm());
        let depth_m = 4.0 * marker.size_m / edges.sum::<f64>();
        (depth_m.is_finite() && depth_m > 0.0).then_some(depth_m)
    }

    /// The helicopter is higher by `rise_m` than was thought.
    fn place_height(&mut self, depth_m: f64, rise_m: f64) {
        let (position, bias): (Block<1>, Block<1>) = (own::POSITION.part(2), own::GPS_BIAS.part(2));
        let bias_var = self.models.gps_bias_var[2];
        let state = &mut self.state;
        state.own.position.z -= rise_m;
        if (rise_m + state.own.gps_bias.z).abs() <= BIAS_SIGMAS * bias_var.sqrt() {
            state.own.gps_bias.z += rise_m;
        } else {
            state.ground_lower_m += rise_m + state.own.gps_bias.z;
            state.own.gps_bias.z = 0.0;
        }
        state.renew(position, &[(SIZE_SIGMA * depth_m).powi(2)]);
        state.renew(bias, &[bias_var]);
        let place = state.own.position;
        let height_m = self.models.ground.down_m(place.x, place.y) - place.z;
        state.height.placed = Some((state.t, height_m, rise_m));
        // Where they lie was read off the height that has just been given up.
        (0..self.state.features.len()).for_each(|slot| self.drop_feature(slot));
    }
}

/// By what factor two depths differ, at least one.
fn apart(a: f64, b: f64) -> f64 {
    (a / b).max(b / a)
}
