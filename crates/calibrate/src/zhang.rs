//! Zhang's initial values: homographies of a plane, and the camera matrix on which they agree.

use nalgebra::{DMatrix, Matrix3, Rotation3, SMatrix, SVector, Vector2, Vector3};

use windhover_base::geo::{CameraModel, LensModel};

/// Points of a plane (its own coordinates, metres) and their observations in an image (pixels).
#[derive(Clone, PartialEq, Debug)]
pub struct PlaneView {
    /// In the plane, metres.
    pub plane_m: Vec<Vector2<f64>>,
    /// In the image, pixels, in the same order.
    pub px: Vec<Vector2<f64>>,
}

/// Pose of the plane: `p_camera = rotation · (x, y, 0) + translation`.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct PlanePose {
    /// `camera_from_plane`.
    pub rotation: Rotation3<f64>,
    /// Origin of the plane in the camera frame, metres.
    pub translation: Vector3<f64>,
}

/// The homography that maps plane points to pixels, `λ [u v 1]ᵀ = H [x y 1]ᵀ`: the direct linear transform over points
/// normalised to zero mean and unit spread (Hartley 1997). `None` for fewer than four points or points on a line.
pub fn homography(view: &PlaneView) -> Option<Matrix3<f64>> {
    if view.plane_m.len() < 4 || view.plane_m.len() != view.px.len() {
        return None;
    }
    let (to_plane, plane) = normalised(&view.plane_m)?;
    let (to_image, image) = normalised(&view.px)?;
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (p, q) in plane.iter().zip(&image) {
        let row_u = SVector::<f64, 9>::from([p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y, -q.x]);
        let row_v = SVector::<f64, 9>::from([0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y, -q.y]);
        normal += row_u * row_u.transpose() + row_v * row_v.transpose();
    }
    let eigen = normal.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let h = Matrix3::from_row_slice(eigen.eigenvectors.column(least).as_slice());
    let whole = to_image.try_inverse()? * h * to_plane;
    (whole.determinant().abs() > 1e-300 && whole[(2, 2)] != 0.0).then(|| whole / whole[(2, 2)])
}

/// The similarity that normalises points to zero mean and mean square radius 2, and the normalised points.
fn normalised(points: &[Vector2<f64>]) -> Option<(Matrix3<f64>, Vec<Vector2<f64>>)> {
    let n = points.len() as f64;
    let mean = points.iter().sum::<Vector2<f64>>() / n;
    let spread = points.iter().map(|p| (p - mean).norm_squared()).sum::<f64>() / n;
    let scale = (2.0 / spread).sqrt();
    let matrix = Matrix3::new(scale, 0.0, -scale * mean.x, 0.0, scale, -scale * mean.y, 0.0, 0.0, 1.0);
    (spread > 0.0 && scale.is_finite()).then(|| (matrix, points.iter().map(|p| (p - mean) * scale).collect()))
}

/// Initial cameras, most reliable first: Zhang's closed form without skew (Zhang 2000, section 3.1), the same with the
/// principal point fixed in the middle of the image, and a plain guess.
pub fn starts(homographies: &[Matrix3<f64>], width: f64, height: f64) -> Vec<CameraModel> {
    let middle = Vector2::new((width - 1.0) / 2.0, (height - 1.0) / 2.0);
    let scale = width.max(height);
    let guess = CameraModel {
        fx: scale,
        fy: scale,
        cx: middle.x,
        cy: middle.y,
        model: LensModel::Brown,
        distortion: [0.0; 5],
        skew: 0.0,
    };
    let mut found: Vec<CameraModel> = [false, true]
        .into_iter()
        .filter_map(|held| closed_form(homographies, middle, scale, held))
        .filter(|c| {
            let likely = |f: f64| (0.1 * scale..50.0 * scale).contains(&f);
            likely(c.fx)
                && likely(c.fy)
                && (c.cx - middle.x).abs() < width
                && (c.cy - middle.y).abs() < height
        })
        .collect();
    found.push(guess);
    found
}

/// Fisheye cameras to start from: a circle of 100 to 220 degrees that fills the image's longer side, distortion zero.
pub(super) fn fisheye_starts(width: f64, height: f64) -> [CameraModel; 4] {
    [100.0f64, 130.0, 170.0, 220.0].map(|across_deg| {
        let focal = width.max(height) / across_deg.to_radians();
        let (cx, cy) = ((width - 1.0) / 2.0, (height - 1.0) / 2.0);
        let model = LensModel::Fisheye;
        CameraModel { fx: focal, fy: focal, cx, cy, model, distortion: [0.0; 5], skew: 0.0 }
    })
}

/// Farthest off the axis that a point may be for a first pose, as a tangent: homographies weigh such by its square.
const FARTHEST: f64 = 4.0;

/// The plane's pose by the rays of the points seen.
pub(super) fn pose_through(view: &PlaneView, camera: &CameraModel) -> Option<PlanePose> {
    let rays = view.plane_m.iter().zip(&view.px).filter_map(|(p, px)| {
        let ray = camera.normalised(*px).filter(|m| m.norm() < FARTHEST)?;
        Some((*p, ray))
    });
    let (plane_m, px) = rays.unzip();
    pose_of(&homography(&PlaneView { plane_m, px })?, &CameraModel::UNIT)
}

/// Solves `h1ᵀ B h2 = 0` and `h1ᵀ B h1 = h2ᵀ B h2` for `B = K⁻ᵀ K⁻¹` in pixels centred on `middle` and
/// divided by `scale`; with `held` the principal point is `middle`.
fn closed_form(
    homographies: &[Matrix3<f64>],
    middle: Vector2<f64>,
    scale: f64,
    held: bool,
) -> Option<CameraModel> {
    let centre =
        Matrix3::new(1.0 / scale, 0.0, -middle.x / scale, 0.0, 1.0 / scale, -middle.y / scale, 0.0, 0.0, 1.0);
    let unknowns = if held { 3 } else { 5 };
    let mut rows = DMatrix::<f64>::zeros(2 * homographies.len(), unknowns);
    for (k, h) in homographies.iter().enumerate() {
        let h = centre * h;
        let h = h / h.norm();
        let v = |i: usize, j: usize| {
            let (a, b) = (h.column(i), h.column(j));
            let cross = [a[2] * b[0] + a[0] * b[2], a[2] * b[1] + a[1] * b[2]];
            [a[0] * b[0], a[1] * b[1], a[2] * b[2], cross[0], cross[1]]
        };
        let (same, first, second) = (v(0, 1), v(0, 0), v(1, 1));
        for c in 0..unknowns {
            rows[(2 * k, c)] = same[c];
            rows[(2 * k + 1, c)] = first[c] - second[c];
        }
    }
    let eigen = (rows.transpose() * &rows).symmetric_eigen();
    let b = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    let (b11, b22, b33) = (b[0], b[1], b[2]);
    let (b13, b23) = if held { (0.0, 0.0) } else { (b[3], b[4]) };
    let lambda = b33 - b13 * b13 / b11 - b23 * b23 / b22;
    let (fx2, fy2) = (lambda / b11, lambda / b22);
    (fx2 > 0.0 && fy2 > 0.0 && fx2.is_finite() && fy2.is_finite()).then(|| CameraModel {
        fx: scale * fx2.sqrt(),
        fy: scale * fy2.sqrt(),
        cx: middle.x - scale * b13 / b11,
        cy: middle.y - scale * b23 / b22,
        model: LensModel::Brown,
        distortion: [0.0; 5],
        skew: 0.0,
    })
}

/// The plane's pose from its homography, in front of the camera; distortion is ignored.
pub fn pose_of(homography: &Matrix3<f64>, camera: &CameraModel) -> Option<PlanePose> {
    let k = Matrix3::new(camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0);
    let m = k.try_inverse()? * homography;
    let scale = 2.0 / (m.column(0).norm() + m.column(1).norm());
    let m = if m[(2, 2)] < 0.0 { m * -scale } else { m * scale };
    let (x, y) = (m.column(0).into_owned(), m.column(1).into_owned());
    let svd = Matrix3::from_columns(&[x, y, x.cross(&y)]).svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    (rotation.determinant() > 0.0).then(|| PlanePose {
        rotation: Rotation3::from_matrix_unchecked(rotation),
        translation: m.column(2).into_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::geo::ned_from_body_321;

    fn view(camera: &CameraModel, pose: &PlanePose) -> PlaneView {
        let plane_m: Vec<_> =
            (0..54).map(|k| Vector2::new(f64::from(k % 9), f64::from(k / 9)) * 0.025).collect();
        let px = plane_m
            .iter()
            .map(|p| {
                let at = pose.rotation * Vector3::new(p.x, p.y, 0.0) + pose.translation;
                camera.project(&at).expect("in front").px
            })
            .collect();
        PlaneView { plane_m, px }
    }

    #[test]
    fn perfect_views_give_the_camera_back() {
        let camera = CameraModel {
            fx: 800.0,
            fy: 820.0,
            cx: 350.0,
            cy: 220.0,
            model: LensModel::Brown,
            distortion: [0.0; 5],
            skew: 0.0,
        };
        let poses = [(0.3, 0.2, 0.1), (-0.4, 0.5, 0.2), (0.1, -0.5, 0.4)].map(|(a, b, c)| PlanePose {
            rotation: ned_from_body_321(a, b, c),
            translation: Vector3::new(-0.1, -0.05, 0.5),
        });
        let homographies: Vec<_> =
            poses.iter().map(|p| homography(&view(&camera, p)).expect("enough points")).collect();
        let found = starts(&homographies, 640.0, 480.0)[0];
        for (a, b) in [(found.fx, 800.0), (found.fy, 820.0), (found.cx, 350.0), (found.cy, 220.0)] {
            assert!((a - b).abs() < 1e-3, "{found:?}");
        }
        let pose = pose_of(&homographies[1], &camera).expect("a pose");
        assert!(pose.rotation.angle_to(&poses[1].rotation) < 1e-6);
        assert!((pose.translation - poses[1].translation).norm() < 1e-6);
    }

    #[test]
    fn points_on_a_line_have_no_homography() {
        let line: Vec<_> = (0..5).map(|k| Vector2::new(f64::from(k), 0.0)).collect();
        let same = PlaneView { plane_m: vec![Vector2::zeros(); 5], px: line.clone() };
        assert!(homography(&same).is_none());
        assert!(homography(&PlaneView { plane_m: line[..3].to_vec(), px: line[..3].to_vec() }).is_none());
    }
}
