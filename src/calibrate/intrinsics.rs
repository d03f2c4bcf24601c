//! The camera's intrinsics from views of a plane: least squares over all pixels at once.

use nalgebra::{Matrix6, Rotation3, SMatrix, SVector, Vector2, Vector3};

use super::zhang::{PlanePose, PlaneView, homography, pose_of, starts};
use crate::geo::{CameraModel, skew as cross_matrix};

/// Parameters of the camera, in the order of [`Intrinsics::sigma`].
pub const PARAMETERS: [&str; COUNT] = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "skew"];
const COUNT: usize = 10;
const K3: usize = 8;
const SKEW: usize = 9;

const MOST_STEPS: usize = 100;
/// The search ends when the sum of squares falls by less than this share of itself.
const LEAST_GAIN: f64 = 1e-10;

/// Which of the optional parameters are estimated; the others stay zero.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Wanted {
    /// The third radial term.
    pub k3: bool,
    /// Bouguet's α.
    pub skew: bool,
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
        "the views do not tell the camera's parameters apart: tilt the board by 20 to 45 degrees, in several directions"
    )]
    Degenerate,
    /// A view's points lie on a line or are too few.
    #[error("view {0} has too few points, or points on a line")]
    BadView(usize),
}

/// How one view fits.
#[derive(Clone, PartialEq, Debug)]
pub struct ViewFit {
    /// Where the plane was.
    pub pose: PlanePose,
    /// Seen minus projected, pixels, in the order of the view's points.
    pub residuals_px: Vec<Vector2<f64>>,
    /// Root of the mean squared length of the residuals.
    pub rms_px: f64,
}

/// The camera found.
#[derive(Clone, PartialEq, Debug)]
pub struct Intrinsics {
    /// Its parameters.
    pub camera: CameraModel,
    /// One-sigma of each of [`PARAMETERS`], from the normal equations scaled by the residuals; 0 for
    /// those not estimated.
    pub sigma: [f64; COUNT],
    /// Root of the mean squared length of all residuals, as OpenCV reports it.
    pub rms_px: f64,
    /// One-sigma of a residual per axis, with the degrees of freedom taken off.
    pub noise_px: f64,
    /// How each view fits, in the order given.
    pub views: Vec<ViewFit>,
    /// Points used.
    pub points: usize,
}

/// Estimates the intrinsics from views of a plane in an image of this size.
///
/// Minimises the squared distance between seen and projected points over the camera and every
/// plane's pose by Levenberg–Marquardt; poses are eliminated view by view (Schur complement).
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
    let mut best: Option<Problem<'_>> = None;
    for camera in starts(&homographies, width, height) {
        let poses: Option<Vec<_>> = homographies.iter().map(|h| pose_of(h, &camera)).collect();
        let Some(poses) = poses else { continue };
        let mut problem = Problem { views, camera, poses, wanted };
        problem.solve();
        let better = best.as_ref().is_none_or(|b| problem.cost() < 0.999 * b.cost());
        if better && problem.cost().is_finite() {
            best = Some(problem);
        }
    }
    best.ok_or(IntrinsicsError::Degenerate)?.result()
}

/// A least-squares problem at its present guess.
#[derive(Clone)]
struct Problem<'a> {
    views: &'a [PlaneView],
    camera: CameraModel,
    poses: Vec<PlanePose>,
    wanted: Wanted,
}

type OfCamera = SMatrix<f64, COUNT, COUNT>;
type Mixed = SMatrix<f64, COUNT, 6>;

/// Normal equations in blocks: camera, each pose, and between.
struct Normal {
    camera: OfCamera,
    camera_right: SVector<f64, COUNT>,
    poses: Vec<(Matrix6<f64>, SVector<f64, 6>, Mixed)>,
}

impl Problem<'_> {
    fn residuals(&self, view: usize) -> impl Iterator<Item = Vector2<f64>> {
        let (data, pose) = (&self.views[view], self.poses[view]);
        data.plane_m.iter().zip(&data.px).map(move |(p, px)| {
            let at = pose.rotation * Vector3::new(p.x, p.y, 0.0) + pose.translation;
            px - self.camera.pixel_of(at.xy() / at.z).0
        })
    }

    fn cost(&self) -> f64 {
        (0..self.views.len()).map(|k| self.residuals(k).map(|r| r.norm_squared()).sum::<f64>()).sum()
    }

    fn solve(&mut self) {
        let mut damping = 1e-3;
        let mut cost = self.cost();
        for _ in 0..MOST_STEPS {
            let normal = self.normal();
            let Some(gain) = self.improve(&normal, cost, &mut damping) else { return };
            cost -= gain;
            if gain <= LEAST_GAIN * cost {
                return;
            }
        }
    }

    /// One accepted step and what it gained; `None` when no damping helps.
    fn improve(&mut self, normal: &Normal, cost: f64, damping: &mut f64) -> Option<f64> {
        while *damping < 1e12 {
            if let Some(next) = self.stepped(normal, *damping) {
                let next_cost = next.cost();
                if next_cost < cost {
                    (self.camera, self.poses) = (next.camera, next.poses);
                    *damping = (*damping / 10.0).max(1e-12);
                    return Some(cost - next_cost);
                }
            }
            *damping *= 10.0;
        }
        None
    }

    /// Normal equations `Jᵀ J`, `Jᵀ r` at the present guess.
    fn normal(&self) -> Normal {
        let mut camera = OfCamera::zeros();
        let mut camera_right = SVector::zeros();
        let mut poses = Vec::with_capacity(self.views.len());
        for (view, pose) in self.views.iter().zip(&self.poses) {
            let (mut own, mut own_right, mut mixed) = (Matrix6::zeros(), SVector::zeros(), Mixed::zeros());
            for (p, px) in view.plane_m.iter().zip(&view.px) {
                let (residual, of_camera, of_pose) = self.linearised(pose, p, px);
                camera += of_camera.transpose() * of_camera;
                camera_right += of_camera.transpose() * residual;
                own += of_pose.transpose() * of_pose;
                own_right += of_pose.transpose() * residual;
                mixed += of_camera.transpose() * of_pose;
            }
            poses.push((own, own_right, mixed));
        }
        Normal { camera, camera_right, poses }
    }

    /// Residual of a point and the derivatives of its projection by camera and pose. The pose moves
    /// by a small rotation ε on the left and a shift τ: `p = exp(ε) R x + t + τ`.
    fn linearised(
        &self,
        pose: &PlanePose,
        p: &Vector2<f64>,
        px: &Vector2<f64>,
    ) -> (Vector2<f64>, SMatrix<f64, 2, COUNT>, SMatrix<f64, 2, 6>) {
        let c = &self.camera;
        let turned = pose.rotation * Vector3::new(p.x, p.y, 0.0);
        let at = turned + pose.translation;
        let m = at.xy() / at.z;
        let (projected, d_m) = c.pixel_of(m);
        let iz = 1.0 / at.z;
        let d_point = d_m * SMatrix::<f64, 2, 3>::new(iz, 0.0, -m.x * iz, 0.0, iz, -m.y * iz);
        let mut of_pose = SMatrix::<f64, 2, 6>::zeros();
        of_pose.fixed_columns_mut::<3>(0).copy_from(&(d_point * -cross_matrix(&turned)));
        of_pose.fixed_columns_mut::<3>(3).copy_from(&d_point);

        let d = c.distort(m).0;
        let r2 = m.norm_squared();
        let radial = |power: f64| Vector2::new(c.fx * (m.x + c.skew * m.y), c.fy * m.y) * power;
        let tangent = |x: f64, y: f64| Vector2::new(c.fx * (x + c.skew * y), c.fy * y);
        let mut of_camera = SMatrix::<f64, 2, COUNT>::from_columns(&[
            Vector2::new(d.x + c.skew * d.y, 0.0),
            Vector2::new(0.0, d.y),
            Vector2::x(),
            Vector2::y(),
            radial(r2),
            radial(r2 * r2),
            tangent(2.0 * m.x * m.y, r2 + 2.0 * m.y * m.y),
            tangent(r2 + 2.0 * m.x * m.x, 2.0 * m.x * m.y),
            radial(r2 * r2 * r2),
            Vector2::new(c.fx * d.y, 0.0),
        ]);
        for (column, estimated) in [(K3, self.wanted.k3), (SKEW, self.wanted.skew)] {
            if !estimated {
                of_camera.column_mut(column).fill(0.0);
            }
        }
        (px - projected, of_camera, of_pose)
    }

    /// The camera's own normal equations with the poses eliminated: `A − Σ B C⁻¹ Bᵀ`. Parameters that
    /// are not estimated get a unit diagonal and stay where they are.
    fn reduced(&self, normal: &Normal, damping: f64) -> Option<(OfCamera, SVector<f64, COUNT>)> {
        let damp = 1.0 + damping;
        let mut left = normal.camera;
        let mut right = normal.camera_right;
        for k in 0..COUNT {
            left[(k, k)] *= damp;
        }
        for (own, own_right, mixed) in &normal.poses {
            let mut own = *own;
            for k in 0..6 {
                own[(k, k)] *= damp;
            }
            let chol = own.cholesky()?;
            left -= mixed * chol.solve(&mixed.transpose());
            right -= mixed * chol.solve(own_right);
        }
        for (k, estimated) in [(K3, self.wanted.k3), (SKEW, self.wanted.skew)] {
            if !estimated {
                left[(k, k)] = 1.0;
                right[k] = 0.0;
            }
        }
        Some((left, right))
    }

    fn stepped(&self, normal: &Normal, damping: f64) -> Option<Self> {
        let (left, right) = self.reduced(normal, damping)?;
        let step = scaled_cholesky(&left)?.solve(&right);
        let mut next = self.clone();
        let c = &mut next.camera;
        c.fx += step[0];
        c.fy += step[1];
        c.cx += step[2];
        c.cy += step[3];
        for k in 0..5 {
            c.distortion[k] += step[4 + k];
        }
        c.skew += step[SKEW];
        for (pose, (own, own_right, mixed)) in next.poses.iter_mut().zip(&normal.poses) {
            let mut own = *own;
            for k in 0..6 {
                own[(k, k)] *= 1.0 + damping;
            }
            let d = own.cholesky()?.solve(&(own_right - mixed.transpose() * step));
            pose.rotation = Rotation3::new(d.fixed_rows::<3>(0).into_owned()) * pose.rotation;
            pose.translation += d.fixed_rows::<3>(3);
        }
        (c_is_usable(&next.camera) && next.poses.iter().all(|p| p.translation.iter().all(|x| x.is_finite())))
            .then_some(next)
    }

    fn result(self) -> Result<Intrinsics, IntrinsicsError> {
        let normal = self.normal();
        let (left, _) = self.reduced(&normal, 0.0).ok_or(IntrinsicsError::Degenerate)?;
        let inverse = scaled_cholesky(&left).ok_or(IntrinsicsError::Degenerate)?.inverse();
        let points: usize = self.views.iter().map(|v| v.px.len()).sum();
        let estimated = COUNT - usize::from(!self.wanted.k3) - usize::from(!self.wanted.skew);
        let freedom = 2 * points as i64 - (estimated + 6 * self.views.len()) as i64;
        let cost = self.cost();
        let variance = if freedom > 0 { cost / freedom as f64 } else { f64::INFINITY };
        let mut sigma: [f64; COUNT] = std::array::from_fn(|k| (variance * inverse[(k, k)]).sqrt());
        if !self.wanted.k3 {
            sigma[K3] = 0.0;
        }
        if !self.wanted.skew {
            sigma[SKEW] = 0.0;
        }
        // A focal length known to no better than a fifth of itself is not known.
        if !(sigma[0] < 0.2 * self.camera.fx && sigma[1] < 0.2 * self.camera.fy) {
            return Err(IntrinsicsError::Degenerate);
        }
        let views = (0..self.views.len())
            .map(|k| {
                let residuals_px: Vec<_> = self.residuals(k).collect();
                let sum: f64 = residuals_px.iter().map(|r| r.norm_squared()).sum();
                let rms_px = (sum / residuals_px.len().max(1) as f64).sqrt();
                ViewFit { pose: self.poses[k], residuals_px, rms_px }
            })
            .collect();
        Ok(Intrinsics {
            camera: self.camera,
            sigma,
            rms_px: (cost / points as f64).sqrt(),
            noise_px: variance.sqrt(),
            views,
            points,
        })
    }
}

fn c_is_usable(camera: &CameraModel) -> bool {
    let figures = [camera.fx, camera.fy, camera.cx, camera.cy, camera.skew];
    camera.fx > 0.0 && camera.fy > 0.0 && figures.iter().chain(&camera.distortion).all(|x| x.is_finite())
}

/// Cholesky factors of a matrix whose rows differ by many orders (pixels beside distortion terms),
/// scaled to a unit diagonal first.
struct Scaled {
    factors: nalgebra::Cholesky<f64, nalgebra::Const<COUNT>>,
    scale: SVector<f64, COUNT>,
}

fn scaled_cholesky(matrix: &OfCamera) -> Option<Scaled> {
    let scale = matrix.diagonal().map(|d| if d > 0.0 { 1.0 / d.sqrt() } else { 1.0 });
    let d = OfCamera::from_diagonal(&scale);
    Some(Scaled { factors: (d * matrix * d).cholesky()?, scale })
}

impl Scaled {
    fn solve(&self, right: &SVector<f64, COUNT>) -> SVector<f64, COUNT> {
        self.factors.solve(&right.component_mul(&self.scale)).component_mul(&self.scale)
    }

    fn inverse(&self) -> OfCamera {
        let d = OfCamera::from_diagonal(&self.scale);
        d * self.factors.inverse() * d
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::calibrate::drawn_board::DrawnBoard;
    use crate::calibrate::find_corners;

    const SIZE: (usize, usize) = (640, 480);

    fn camera() -> CameraModel {
        CameraModel {
            fx: 536.0,
            fy: 541.0,
            cx: 342.0,
            cy: 235.0,
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

    fn parameters(c: &CameraModel) -> Vec<f64> {
        [c.fx, c.fy, c.cx, c.cy].into_iter().chain(c.distortion).chain([c.skew]).collect()
    }

    fn calibrated(views: &[PlaneView], wanted: Wanted) -> Result<Intrinsics, IntrinsicsError> {
        calibrate(views, SIZE.0 as f64, SIZE.1 as f64, wanted)
    }

    #[test]
    fn exact_corners_give_the_exact_camera() {
        let found = calibrated(&exact(&boards()), Wanted { k3: true, skew: true }).expect("tilted boards");
        for (got, want) in parameters(&found.camera).iter().zip(parameters(&camera())) {
            assert!((got - want).abs() < 1e-5 * want.abs().max(1.0), "{got} {want}");
        }
        assert!(found.rms_px < 1e-6);
    }

    #[test]
    fn noise_shows_in_the_sigmas_as_it_should() {
        // Normalised errors of all parameters over 30 noisy sets: mean square near one.
        let views = exact(&boards());
        let mut rng = ChaCha8Rng::seed_from_u64(42);
        let wanted = Wanted { k3: false, skew: false };
        let mut squares = Vec::new();
        for _ in 0..30 {
            let mut noisy = views.clone();
            for px in noisy.iter_mut().flat_map(|v| &mut v.px) {
                *px += 0.2 * Vector2::new(rng.sample(StandardNormal), rng.sample::<f64, _>(StandardNormal));
            }
            let found = calibrated(&noisy, wanted).expect("tilted boards");
            assert!((found.noise_px - 0.2).abs() < 0.02, "{}", found.noise_px);
            let errors = parameters(&found.camera).into_iter().zip(parameters(&camera()));
            squares.extend(errors.zip(found.sigma).take(8).map(|((g, w), s)| ((g - w) / s).powi(2)));
        }
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        assert!((0.7..1.4).contains(&mean), "{mean}");
    }

    #[test]
    fn drawn_photographs_give_the_camera_within_its_sigmas() {
        let boards = boards();
        let views: Vec<_> = boards
            .iter()
            .map(|b| {
                let found = find_corners(b.image(None).view(), 9, 6, 7.0).expect("in full view");
                let px: Vec<_> = found.into_iter().flatten().collect();
                assert_eq!(px.len(), 54);
                PlaneView { plane_m: b.plane_points(), px }
            })
            .collect();
        let found = calibrated(&views, Wanted { k3: false, skew: false }).expect("tilted boards");
        for (k, (got, want)) in
            parameters(&found.camera).iter().zip(parameters(&camera())).enumerate().take(8)
        {
            assert!(
                (got - want).abs() < 4.0 * found.sigma[k],
                "{}: {got} {want} {}",
                PARAMETERS[k],
                found.sigma[k]
            );
        }
        assert!(found.rms_px < 0.12, "{}", found.rms_px);
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
        let wanted = Wanted { k3: false, skew: false };
        assert_eq!(calibrated(&views, wanted).map(|_| ()), Err(IntrinsicsError::Degenerate));
        assert_eq!(calibrated(&views[..2], wanted).map(|_| ()), Err(IntrinsicsError::TooFewViews(2)));
    }
}
