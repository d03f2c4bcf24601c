//! Pose of a tag from its four corners: both solutions, and how far apart they are.
//!
//! Seen from afar a square looks the same tilted one way or the other. From the homography comes one pose;
//! the other is its mirror image across the plane square to the line of sight. Both are refined by
//! Gauss–Newton on the pixels of the corners, and the better is distinguished from the worse by its residual
//! (Schweighofer and Pinz 2006; Collins and Bartoli 2014).

use nalgebra::{Isometry3, Matrix2, Matrix3, Matrix6, Rotation3, SMatrix, Translation3, UnitQuaternion};
use nalgebra::{Vector2, Vector3, Vector6};

use super::homography::Homography;
use windhover_base::geo::CameraModel;

/// One pose of a tag.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TagPose {
    /// Takes tag coordinates (x right, y down, z into the print, origin at its centre, metres) to the camera
    /// frame.
    pub camera_from_tag: Isometry3<f64>,
    /// Covariance of a small rotation (camera axes, radians), then of the translation (metres).
    pub covariance: Matrix6<f64>,
    /// Sum of the squared corner errors, each by its covariance: about 2 (8 numbers less 6) where the
    /// corners' covariance is right.
    pub error: f64,
}

/// The poses that explain four corners.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TagPoses {
    /// The better one.
    pub best: TagPose,
    /// The other, where there is another minimum.
    pub other: Option<TagPose>,
    /// Error of the best over that of the other: near 1 the two cannot be distinguished; 0 without another.
    pub ambiguity: f64,
}

/// Poses of a tag of edge `size_m` whose corners (top-left, top-right, bottom-right, bottom-left) are seen at
/// `corners_px` with covariance `cov_px2`. `None` where the corners are no image of a square in front of
/// the camera.
pub fn tag_poses(
    corners_px: &[Vector2<f64>; 4],
    cov_px2: &[Matrix2<f64>; 4],
    size_m: f64,
    camera: &CameraModel,
) -> Option<TagPoses> {
    let mut weights = [Matrix2::zeros(); 4];
    let mut seen = [[0.0; 2]; 4];
    for i in 0..4 {
        weights[i] = cov_px2[i].try_inverse()?;
        let m = camera.normalised(corners_px[i])?;
        seen[i] = [m.x, m.y];
    }
    let problem = Problem { corners_px, weights: &weights, tag: tag_corners(size_m), camera };
    let first = problem.refine(pose_of_homography(&seen, size_m)?);
    let mirror = |pose: &TagPose| problem.refine(mirrored(&pose.camera_from_tag));
    let (best, other) = match first {
        Some(first) => match mirror(&first).filter(|other| differ(&first, other)) {
            Some(other) if other.error < first.error => (other, Some(first)),
            other => (first, other),
        },
        None => return None,
    };
    let ambiguity = other.map_or(0.0, |o| best.error.max(1e-12) / o.error.max(1e-12));
    Some(TagPoses { best, other, ambiguity })
}

/// Corners of a tag in its own frame.
fn tag_corners(size_m: f64) -> [Vector3<f64>; 4] {
    let h = size_m / 2.0;
    [(-h, -h), (h, -h), (h, h), (-h, h)].map(|(x, y)| Vector3::new(x, y, 0.0))
}

/// `H ~ [r₁ r₂ t]` with the columns made a rotation.
fn pose_of_homography(seen: &[[f64; 2]; 4], size_m: f64) -> Option<Isometry3<f64>> {
    let h = Matrix3::from_row_slice(&Homography::of_square(size_m, seen)?.0);
    let scale = 2.0 / (h.column(0).norm() + h.column(1).norm());
    let (r1, r2) = (h.column(0) * scale, h.column(1) * scale);
    let rotation = Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]);
    let svd = rotation.svd(true, true);
    let rotation = Rotation3::from_matrix_unchecked(svd.u? * svd.v_t?);
    // The homography's origin is the first corner, the tag's its centre.
    let middle = Vector3::new(size_m / 2.0, size_m / 2.0, 1.0);
    let center = h * middle / middle.z * scale;
    (rotation.matrix().determinant() > 0.5 && center.z > 0.0).then(|| {
        Isometry3::from_parts(Translation3::from(center), UnitQuaternion::from_rotation_matrix(&rotation))
    })
}

/// The pose whose image is the same but for perspective: mirrored across the plane square to the line of
/// sight, and across the tag's own plane to stay a rotation.
fn mirrored(pose: &Isometry3<f64>) -> Isometry3<f64> {
    let sight = pose.translation.vector.normalize();
    let across = Matrix3::identity() - sight * sight.transpose() * 2.0;
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
    let rotation = across * pose.rotation.to_rotation_matrix().matrix() * flip;
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Isometry3::from_parts(pose.translation, rotation)
}

fn differ(a: &TagPose, b: &TagPose) -> bool {
    let (a, b) = (&a.camera_from_tag, &b.camera_from_tag);
    a.rotation.angle_to(&b.rotation) > 1e-3
}

struct Problem<'a> {
    corners_px: &'a [Vector2<f64>; 4],
    weights: &'a [Matrix2<f64>; 4],
    tag: [Vector3<f64>; 4],
    camera: &'a CameraModel,
}

impl Problem<'_> {
    /// Gauss–Newton with a damping that only grows where a step does not help.
    fn refine(&self, start: Isometry3<f64>) -> Option<TagPose> {
        let mut pose = start;
        let (mut error, mut information, mut gradient) = self.linearise(&pose)?;
        let mut damping = 1e-6;
        for _ in 0..30 {
            let mut damped = information;
            (0..6).for_each(|k| damped[(k, k)] *= 1.0 + damping);
            let step = damped.cholesky()?.solve(&gradient);
            let moved = apply(&pose, &step);
            match self.linearise(&moved) {
                Some(next) if next.0 <= error => {
                    let gain = error - next.0;
                    pose = moved;
                    (error, information, gradient) = next;
                    damping = (damping * 0.1).max(1e-9);
                    if gain < 1e-9 * (1.0 + error) {
                        break;
                    }
                }
                _ => damping *= 10.0,
            }
            if damping > 1e6 {
                break;
            }
        }
        let covariance = information.cholesky()?.inverse();
        Some(TagPose { camera_from_tag: pose, covariance, error })
    }

    /// Error, information and gradient at a pose.
    fn linearise(&self, pose: &Isometry3<f64>) -> Option<(f64, Matrix6<f64>, Vector6<f64>)> {
        let (mut error, mut information, mut gradient) = (0.0, Matrix6::zeros(), Vector6::zeros());
        for i in 0..4 {
            let arm = pose.rotation * self.tag[i];
            let projection = self.camera.project(&(arm + pose.translation.vector))?;
            let residual = self.corners_px[i] - projection.px;
            // A small rotation δ about camera axes moves the point by δ × arm.
            let mut d_pose = SMatrix::<f64, 3, 6>::zeros();
            d_pose.fixed_view_mut::<3, 3>(0, 0).copy_from(&(-arm.cross_matrix()));
            d_pose.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
            let jacobian = projection.d_point * d_pose;
            let weighted = jacobian.transpose() * self.weights[i];
            error += (residual.transpose() * self.weights[i] * residual)[0];
            information += weighted * jacobian;
            gradient += weighted * residual;
        }
        Some((error, information, gradient))
    }
}

fn apply(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(step.fixed_rows::<3>(0).into_owned());
    let moved = pose.translation.vector + step.fixed_rows::<3>(3);
    Isometry3::from_parts(Translation3::from(moved), turn * pose.rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::geo::LensModel;

    fn camera() -> CameraModel {
        CameraModel {
            fx: 1019.5,
            fy: 1022.1,
            cx: 645.7,
            cy: 527.7,
            model: LensModel::Brown,
            distortion: [-0.179, 0.139, -0.001, 0.006, 0.0],
            skew: 0.0,
        }
    }

    fn corners(pose: &Isometry3<f64>, size: f64) -> [Vector2<f64>; 4] {
        tag_corners(size)
            .map(|c| camera().project(&(pose.rotation * c + pose.translation.vector)).expect("in front").px)
    }

    #[test]
    fn a_tilted_tag_near_by_is_found_and_nothing_else_explains_it() {
        for (roll, pitch, yaw) in [(0.5, 0.1, 0.3), (-0.4, 0.6, 2.0), (0.1, -0.7, -3.0)] {
            let rotation = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
            let truth = Isometry3::from_parts(Translation3::new(0.3, -0.2, 2.0), rotation);
            let poses = tag_poses(&corners(&truth, 0.48), &[Matrix2::identity() * 0.01; 4], 0.48, &camera())
                .expect("a pose");
            let found = poses.best.camera_from_tag;
            assert!(found.rotation.angle_to(&truth.rotation) < 1e-6);
            assert!((found.translation.vector - truth.translation.vector).norm() < 1e-6);
            assert!(poses.ambiguity < 0.01 && poses.other.is_none_or(|o| o.error > 10.0));
        }
    }

    #[test]
    fn the_farther_away_the_less_the_two_poses_differ() {
        let mut last = -1.0;
        for distance in [4.0, 14.0, 50.0] {
            let rotation = UnitQuaternion::from_euler_angles(0.4, 0.0, 0.4);
            let truth = Isometry3::from_parts(Translation3::new(0.5, 0.3, distance), rotation);
            let mut seen = corners(&truth, 0.48);
            seen[0].x += 0.02;
            seen[2].y -= 0.02;
            let poses = tag_poses(&seen, &[Matrix2::identity() * 0.01; 4], 0.48, &camera()).expect("a pose");
            assert!(poses.ambiguity > last && poses.ambiguity <= 1.0, "{} at {distance} m", poses.ambiguity);
            last = poses.ambiguity;
            let angle = |p: TagPose| p.camera_from_tag.rotation.angle_to(&truth.rotation);
            let nearest = poses.other.map_or(f64::MAX, angle).min(angle(poses.best));
            assert!(nearest < 0.2, "{nearest} at {distance} m");
        }
    }

    #[test]
    fn what_is_no_square_has_no_pose() {
        let line = [0.0, 1.0, 2.0, 3.0].map(|k| Vector2::new(100.0 + k, 100.0 + k));
        assert_eq!(tag_poses(&line, &[Matrix2::identity(); 4], 0.5, &camera()), None);
    }
}
