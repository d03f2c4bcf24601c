//! The camera's intrinsics from views of a plane: least squares over all pixels at once.

use nalgebra::Vector2;

pub use super::least_squares::Wanted;
use super::least_squares::{COUNT, Problem, scaled_cholesky};
use super::zhang::{PlanePose, PlaneView, fisheye_starts, homography, pose_of, pose_through, starts};
use windhover_base::geo::{CameraModel, LensModel};

/// Parameters of the camera, in the order of [`Intrinsics::sigma`]. A fisheye has no fifth term.
pub fn parameters(model: LensModel) -> [&'static str; COUNT] {
    match model {
        LensModel::Brown => ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "skew"],
        LensModel::Fisheye => ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "", "skew"],
    }
}

/// Why views gave no intrinsics.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum IntrinsicsError {
    /// Two views or fewer.
    #[error(
        "{0} usable views are too few: take at least 3, better 15, with the board tilted differently in each"
    )]
    TooFewViews(usize),
    /// The views do not determine the camera.
    #[error(
        "the views do not determine the camera's parameters: tilt the board by 20 to 45 degrees, in several directions"
    )]
    Degenerate,
    /// A view has too few points, or all on a line.
    #[error("view {0} has too few points, or points on a line")]
    BadView(usize),
}

/// Fit of one view.
#[derive(Clone, PartialEq, Debug)]
pub struct ViewFit {
    /// Pose of the plane.
    pub pose: PlanePose,
    /// Observed minus projected, pixels, in the order of the view's points.
    pub residuals_px: Vec<Vector2<f64>>,
    /// Root of the mean squared length of the residuals.
    pub rms_px: f64,
}

/// The estimated camera.
#[derive(Clone, PartialEq, Debug)]
pub struct Intrinsics {
    /// Its parameters.
    pub camera: CameraModel,
    /// One-sigma of each of [`parameters`], from the normal equations scaled by the residuals; 0 for
    /// those not estimated.
    pub sigma: [f64; COUNT],
    /// Root of the mean squared length of all residuals, as OpenCV reports it.
    pub rms_px: f64,
    /// One-sigma of a residual per axis, corrected for the degrees of freedom.
    pub noise_px: f64,
    /// Fit of each view, in the given order.
    pub views: Vec<ViewFit>,
    /// Points used.
    pub points: usize,
}

/// Estimates the intrinsics from views of a plane in an image of this size.
///
/// Minimises the squared distance between seen and projected points over the camera and every
/// plane's pose by Levenberg–Marquardt; poses are eliminated view by view (Schur complement).
///
/// ```
/// use nalgebra::{Rotation3, Vector2, Vector3};
/// use windhover_base::geo::{CameraModel, LensModel};
/// use windhover_calibrate::{PlaneView, intrinsics};
///
/// // What a camera sees of a plane from four sides.
/// let camera = CameraModel { fx: 900.0, fy: 905.0, cx: 642.0, cy: 510.0, ..CameraModel::UNIT };
/// let view = |about_x: f64, about_y: f64| {
///     let points = (0..48).map(|k| Vector2::new(f64::from(k % 8) * 0.05, f64::from(k / 8) * 0.05));
///     let turned = Rotation3::from_euler_angles(about_x, about_y, 0.1);
///     let pixel = |p: &Vector2<f64>| {
///         let seen = turned * Vector3::new(p.x - 0.175, p.y - 0.125, 0.0) + Vector3::new(0.0, 0.0, 0.5);
///         camera.project(&seen).expect("it is in front of the camera").px
///     };
///     PlaneView { plane_m: points.clone().collect(), px: points.map(|p| pixel(&p)).collect() }
/// };
/// let views = [view(0.4, 0.0), view(-0.4, 0.1), view(0.0, 0.5), view(0.1, -0.5)];
/// let wanted = intrinsics::Wanted { model: LensModel::Brown, k3: false, skew: false };
/// let found = intrinsics::calibrate(&views, 1280.0, 1024.0, wanted)
///     .expect("four tilted views determine a camera");
/// assert!((found.camera.fx - 900.0).abs() < 1e-3 && (found.camera.cy - 510.0).abs() < 1e-3);
/// ```
///
/// # Errors
/// With too few views, or where they do not determine the camera (for example all parallel to the image plane).
pub fn calibrate(
    views: &[PlaneView],
    width: f64,
    height: f64,
    wanted: Wanted,
) -> Result<Intrinsics, IntrinsicsError> {
    if views.len() < 3 {
        return Err(IntrinsicsError::TooFewViews(views.len()));
    }
    let mut homographies = Vec::with_capacity(views.len());
    for (k, view) in views.iter().enumerate() {
        homographies.push(homography(view).ok_or(IntrinsicsError::BadView(k))?);
    }
    let cameras = match wanted.model {
        LensModel::Brown => starts(&homographies, width, height),
        LensModel::Fisheye => fisheye_starts(width, height).to_vec(),
    };
    let mut best: Option<Problem<'_>> = None;
    for camera in cameras {
        let poses: Option<Vec<_>> = match wanted.model {
            LensModel::Brown => homographies.iter().map(|h| pose_of(h, &camera)).collect(),
            LensModel::Fisheye => views.iter().map(|view| pose_through(view, &camera)).collect(),
        };
        let Some(poses) = poses else { continue };
        let mut problem = Problem { views, camera, poses, wanted };
        problem.solve();
        let better = best.as_ref().is_none_or(|b| problem.cost() < 0.999 * b.cost());
        if better && problem.cost().is_finite() {
            best = Some(problem);
        }
    }
    result(best.ok_or(IntrinsicsError::Degenerate)?)
}

/// Parameters, their sigmas and how each view fits, of a solved problem.
fn result(problem: Problem<'_>) -> Result<Intrinsics, IntrinsicsError> {
    let normal = problem.normal();
    let (left, _) = problem.reduced(&normal, 0.0).ok_or(IntrinsicsError::Degenerate)?;
    let inverse = scaled_cholesky(&left).ok_or(IntrinsicsError::Degenerate)?.inverse();
    let points: usize = problem.views.iter().map(|v| v.px.len()).sum();
    let estimated = (0..COUNT).filter(|&k| problem.wanted.estimates(k)).count();
    let freedom = 2 * points as i64 - (estimated + 6 * problem.views.len()) as i64;
    let cost = problem.cost();
    let variance = if freedom > 0 { cost / freedom as f64 } else { f64::INFINITY };
    let sigma: [f64; COUNT] = std::array::from_fn(|k| {
        if problem.wanted.estimates(k) { (variance * inverse[(k, k)]).sqrt() } else { 0.0 }
    });
    // A focal length known to no better than a fifth of itself is not known.
    if !(sigma[0] < 0.2 * problem.camera.fx && sigma[1] < 0.2 * problem.camera.fy) {
        return Err(IntrinsicsError::Degenerate);
    }
    let views = (0..problem.views.len())
        .map(|k| {
            let residuals_px: Vec<_> = problem.residuals(k).collect();
            let sum: f64 = residuals_px.iter().map(|r| r.norm_squared()).sum();
            let rms_px = (sum / residuals_px.len().max(1) as f64).sqrt();
            ViewFit { pose: problem.poses[k], residuals_px, rms_px }
        })
        .collect();
    Ok(Intrinsics {
        camera: problem.camera,
        sigma,
        rms_px: (cost / points as f64).sqrt(),
        noise_px: variance.sqrt(),
        views,
        points,
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::drawn_board::DrawnBoard;
    use crate::{WINDOW_PX, find_corners};

    const SIZE: (usize, usize) = (640, 480);

    fn camera() -> CameraModel {
        CameraModel {
            fx: 536.0,
            fy: 541.0,
            cx: 342.0,
            cy: 235.0,
            model: LensModel::Brown,
            distortion: [-0.26, 0.09, 0.0015, -0.0006, 0.0],
            skew: 0.0,
        }
    }

    fn boards() -> Vec<DrawnBoard> {
        let tilts = [(0.5, 0.0), (-0.5, 0.1), (0.1, 0.5), (0.0, -0.5), (0.4, 0.4), (-0.4, -0.4), (0.3, -0.3)];
        let board = |(k, (pitch, roll)): (usize, (f64, f64))| {
            let mut b =
                DrawnBoard::new(camera(), SIZE, (9, 6), 0.025).posed(0.5 * k as f64, pitch, roll, 0.34);
            b.pose.translation += Vector3::new(0.05, 0.03, 0.0) * [1.0, -1.0, 0.0][k % 3];
            b
        };
        tilts.into_iter().enumerate().map(board).collect()
    }

    fn exact(boards: &[DrawnBoard]) -> Vec<PlaneView> {
        boards.iter().map(|b| PlaneView { plane_m: b.plane_points(), px: b.corners() }).collect()
    }

    fn figures(c: &CameraModel) -> Vec<f64> {
        [c.fx, c.fy, c.cx, c.cy].into_iter().chain(c.distortion).chain([c.skew]).collect()
    }

    fn calibrated(views: &[PlaneView], wanted: Wanted) -> Result<Intrinsics, IntrinsicsError> {
        calibrate(views, SIZE.0 as f64, SIZE.1 as f64, wanted)
    }

    #[test]
    fn exact_corners_give_the_exact_camera() {
        let found = calibrated(&exact(&boards()), Wanted { model: LensModel::Brown, k3: true, skew: true })
            .expect("tilted boards");
        for (got, want) in figures(&found.camera).iter().zip(figures(&camera())) {
            assert!((got - want).abs() < 1e-5 * want.abs().max(1.0), "{got} {want}");
        }
        assert!(found.rms_px < 1e-6);
    }

    /// A lens of 140° across the frame, and boards all over it.
    fn fisheye_boards() -> Vec<DrawnBoard> {
        let lens = CameraModel {
            fx: 255.0,
            fy: 257.0,
            model: LensModel::Fisheye,
            distortion: [-0.02, 0.006, -0.004, 0.0008, 0.0],
            ..camera()
        };
        let tilts = [(0.5, 0.0), (-0.5, 0.1), (0.1, 0.5), (0.0, -0.5), (0.4, 0.4), (-0.4, -0.4), (0.3, -0.3)];
        let board = |(k, (pitch, roll)): (usize, (f64, f64))| {
            let mut b = DrawnBoard::new(lens, SIZE, (9, 6), 0.025).posed(0.5 * k as f64, pitch, roll, 0.12);
            b.pose.translation += Vector3::new(0.08, 0.03, 0.0) * [1.0, -1.0, 0.0][k % 3];
            b
        };
        tilts.into_iter().enumerate().map(board).collect()
    }

    #[test]
    fn corners_in_a_fisheye_give_it_exactly_and_noisy_ones_within_their_sigmas() {
        let boards = fisheye_boards();
        let truth = figures(&boards[0].camera);
        let mut views = exact(&boards);
        let widest = views.iter().flat_map(|v| &v.px).map(|px| (px - Vector2::new(342.0, 235.0)).norm());
        assert!(widest.fold(0.0, f64::max) > 260.0, "the boards reach far off the axis");
        let wanted = Wanted { model: LensModel::Fisheye, k3: true, skew: false };
        let found = calibrated(&views, wanted).expect("tilted boards");
        for (got, want) in figures(&found.camera).iter().zip(&truth) {
            assert!((got - want).abs() < 1e-5 * want.abs().max(1.0), "{got} {want}");
        }
        let mut rng = ChaCha8Rng::seed_from_u64(43);
        for px in views.iter_mut().flat_map(|v| &mut v.px) {
            *px += 0.2 * Vector2::new(rng.sample(StandardNormal), rng.sample::<f64, _>(StandardNormal));
        }
        let found = calibrated(&views, wanted).expect("tilted boards");
        assert!((found.noise_px - 0.2).abs() < 0.02, "{}", found.noise_px);
        for (k, (got, want)) in figures(&found.camera).iter().zip(&truth).enumerate().take(8) {
            let name = parameters(LensModel::Fisheye)[k];
            assert!((got - want).abs() < 4.0 * found.sigma[k], "{name}: {got} {want}");
        }
        // The other model does not fit it.
        let brown = calibrated(&views, Wanted { model: LensModel::Brown, k3: true, skew: false });
        assert!(brown.is_err() || brown.is_ok_and(|b| b.noise_px > 0.3), "a fisheye passed for Brown's");
    }

    #[test]
    fn noise_shows_in_the_sigmas_as_it_should() {
        // Normalised errors of all parameters over 30 noisy sets: mean square near one.
        let views = exact(&boards());
        let mut rng = ChaCha8Rng::seed_from_u64(42);
        let wanted = Wanted { model: LensModel::Brown, k3: false, skew: false };
        let mut squares = Vec::new();
        for _ in 0..30 {
            let mut noisy = views.clone();
            for px in noisy.iter_mut().flat_map(|v| &mut v.px) {
                *px += 0.2 * Vector2::new(rng.sample(StandardNormal), rng.sample::<f64, _>(StandardNormal));
            }
            let found = calibrated(&noisy, wanted).expect("tilted boards");
            assert!((found.noise_px - 0.2).abs() < 0.02, "{}", found.noise_px);
            let errors = figures(&found.camera).into_iter().zip(figures(&camera()));
            squares.extend(errors.zip(found.sigma).take(8).map(|((g, w), s)| ((g - w) / s).powi(2)));
        }
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        assert!((0.7..1.4).contains(&mean), "{mean}");
    }

    /// The camera estimated from photographs of these boards, each corner located in a window of this width.
    fn photographed(boards: &[DrawnBoard], window_px: f64) -> Intrinsics {
        let view = |b: &DrawnBoard| {
            let found = find_corners(b.image(None).view(), 9, 6, window_px).expect("in full view");
            let px: Vec<_> = found.into_iter().flatten().collect();
            assert_eq!(px.len(), 54);
            PlaneView { plane_m: b.plane_points(), px }
        };
        let views: Vec<_> = boards.iter().map(view).collect();
        calibrated(&views, Wanted { model: LensModel::Brown, k3: false, skew: false }).expect("tilted boards")
    }

    fn is_the_camera(found: &Intrinsics) {
        for (k, (got, want)) in figures(&found.camera).iter().zip(figures(&camera())).enumerate().take(8) {
            let sigma = found.sigma[k];
            assert!(
                (got - want).abs() < 4.0 * sigma,
                "{}: {got} {want} {sigma}",
                parameters(LensModel::Brown)[k]
            );
        }
    }

    #[test]
    fn drawn_photographs_give_the_camera_within_its_sigmas() {
        let found = photographed(&boards(), 7.0);
        is_the_camera(&found);
        assert!(found.rms_px < 0.12, "{}", found.rms_px);
    }

    /// Tilted by 62°, squares are half as high as wide, and an 11 px window covers the next edges.
    #[test]
    fn steep_boards_are_placed_within_their_own_squares() {
        let steep = |k: usize| {
            let (sin, cos) = (0.9 * k as f64).sin_cos();
            DrawnBoard::new(camera(), SIZE, (9, 6), 0.025).posed(0.5 * k as f64, 1.08 * cos, 1.08 * sin, 0.34)
        };
        let boards: Vec<_> = (0..7).map(steep).collect();
        let found = photographed(&boards, WINDOW_PX);
        is_the_camera(&found);
        assert!((found.camera.fx - camera().fx).abs() < 1.5, "{}", found.camera.fx);
        assert!(found.rms_px < 0.15, "{}", found.rms_px);
    }

    #[test]
    fn boards_that_tell_nothing_are_refused() {
        let flat: Vec<_> = (0..5)
            .map(|k| DrawnBoard::new(camera(), SIZE, (9, 6), 0.025).posed(0.3 * f64::from(k), 0.0, 0.0, 0.4))
            .collect();
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut views = exact(&flat);
        for px in views.iter_mut().flat_map(|v| &mut v.px) {
            *px += 0.2 * Vector2::new(rng.sample(StandardNormal), rng.sample::<f64, _>(StandardNormal));
        }
        let wanted = Wanted { model: LensModel::Brown, k3: false, skew: false };
        assert_eq!(calibrated(&views, wanted).map(|_| ()), Err(IntrinsicsError::Degenerate));
        assert_eq!(calibrated(&views[..2], wanted).map(|_| ()), Err(IntrinsicsError::TooFewViews(2)));
    }
}
