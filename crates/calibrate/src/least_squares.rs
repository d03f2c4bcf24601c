//! The least-squares problem of intrinsics: camera and the pose of every view, by Levenberg–Marquardt
//! with the poses eliminated view by view.

use nalgebra::{Matrix6, Rotation3, SMatrix, SVector, Vector2, Vector3};

use super::zhang::{PlanePose, PlaneView};
use windhover_base::geo::{CameraModel, LensModel, skew as cross_matrix};

/// Parameters of the camera: fx, fy, cx, cy, k1, k2, p1, p2, k3, skew; of a fisheye k1 to k4 and nothing in place of k3.
pub(super) const COUNT: usize = 10;
/// Where the third radial term stands among them.
pub(super) const K3: usize = 8;
/// Where the skew stands among them.
pub(super) const SKEW: usize = 9;

const MOST_STEPS: usize = 100;
/// The search ends when the sum of squares decreases by less than this share of itself.
const LEAST_GAIN: f64 = 1e-10;

/// Which lens, and which of its optional parameters are estimated; the others stay zero.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Wanted {
    /// How the lens departs from a pinhole.
    pub model: LensModel,
    /// The third radial term of Brown's model.
    pub k3: bool,
    /// Bouguet's α.
    pub skew: bool,
}

impl Wanted {
    /// Optional parameters, and whether they are estimated.
    fn optional(self) -> [(usize, bool); 2] {
        [(K3, self.k3 && self.model == LensModel::Brown), (SKEW, self.skew)]
    }

    /// Whether a parameter is estimated.
    pub(super) fn estimates(self, parameter: usize) -> bool {
        self.optional().into_iter().all(|(k, estimated)| k != parameter || estimated)
    }
}

/// A least-squares problem at its present guess.
#[derive(Clone)]
pub(super) struct Problem<'a> {
    pub(super) views: &'a [PlaneView],
    pub(super) camera: CameraModel,
    pub(super) poses: Vec<PlanePose>,
    pub(super) wanted: Wanted,
}

type OfCamera = SMatrix<f64, COUNT, COUNT>;
type Mixed = SMatrix<f64, COUNT, 6>;

/// Normal equations in blocks: camera, each pose, and cross terms.
pub(super) struct Normal {
    camera: OfCamera,
    camera_right: SVector<f64, COUNT>,
    poses: Vec<(Matrix6<f64>, SVector<f64, 6>, Mixed)>,
}

impl Problem<'_> {
    /// Seen minus projected points of a view, pixels.
    pub(super) fn residuals(&self, view: usize) -> impl Iterator<Item = Vector2<f64>> {
        let (data, pose) = (&self.views[view], self.poses[view]);
        data.plane_m.iter().zip(&data.px).map(move |(p, px)| {
            let at = pose.rotation * Vector3::new(p.x, p.y, 0.0) + pose.translation;
            px - self.camera.pixel_of(at.xy() / at.z).0
        })
    }

    /// Sum of squared residuals, px².
    pub(super) fn cost(&self) -> f64 {
        (0..self.views.len()).map(|k| self.residuals(k).map(|r| r.norm_squared()).sum::<f64>()).sum()
    }

    /// Iterates until nothing is gained.
    pub(super) fn solve(&mut self) {
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

    /// One accepted step and its gain; `None` when no damping helps.
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

    /// Normal equations `Jᵀ J`, `Jᵀ r` at the present values.
    pub(super) fn normal(&self) -> Normal {
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

    /// Residual of a point and the derivatives of its projection with respect to camera and pose. The pose changes by a
    /// small rotation ε on the left and a translation τ: `p = exp(ε) R x + t + τ`.
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
        let of_terms = terms(c.model, m).map(|t| Vector2::new(c.fx * (t.x + c.skew * t.y), c.fy * t.y));
        let mut of_camera = SMatrix::<f64, 2, COUNT>::from_columns(&[
            Vector2::new(d.x + c.skew * d.y, 0.0),
            Vector2::new(0.0, d.y),
            Vector2::x(),
            Vector2::y(),
            of_terms[0],
            of_terms[1],
            of_terms[2],
            of_terms[3],
            of_terms[4],
            Vector2::new(c.fx * d.y, 0.0),
        ]);
        for (column, _) in self.wanted.optional().into_iter().filter(|(_, estimated)| !estimated) {
            of_camera.column_mut(column).fill(0.0);
        }
        (px - projected, of_camera, of_pose)
    }

    /// The camera's own normal equations with the poses eliminated: `A − Σ B C⁻¹ Bᵀ`. Parameters that are not estimated
    /// get a unit diagonal and do not change.
    pub(super) fn reduced(&self, normal: &Normal, damping: f64) -> Option<(OfCamera, SVector<f64, COUNT>)> {
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
        for (k, _) in self.wanted.optional().into_iter().filter(|(_, estimated)| !estimated) {
            left[(k, k)] = 1.0;
            right[k] = 0.0;
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
}

/// By how much each distortion term moves the distorted coordinates of `m`, in the order of
/// [`CameraModel::distortion`].
fn terms(model: LensModel, m: Vector2<f64>) -> [Vector2<f64>; 5] {
    let r2 = m.norm_squared();
    match model {
        LensModel::Brown => [
            m * r2,
            m * r2 * r2,
            Vector2::new(2.0 * m.x * m.y, r2 + 2.0 * m.y * m.y),
            Vector2::new(r2 + 2.0 * m.x * m.x, 2.0 * m.x * m.y),
            m * r2 * r2 * r2,
        ],
        LensModel::Fisheye => {
            let r = r2.sqrt();
            // θ³, θ⁵, θ⁷ and θ⁹ along m.
            let (angle, unit) = (r.atan(), if r > 0.0 { m / r } else { Vector2::zeros() });
            let term = |power: i32| unit * angle.powi(power);
            [term(3), term(5), term(7), term(9), Vector2::zeros()]
        }
    }
}

fn c_is_usable(camera: &CameraModel) -> bool {
    let figures = [camera.fx, camera.fy, camera.cx, camera.cy, camera.skew];
    camera.fx > 0.0 && camera.fy > 0.0 && figures.iter().chain(&camera.distortion).all(|x| x.is_finite())
}

/// Cholesky factors of a matrix whose rows differ by many orders (pixels beside distortion terms),
/// scaled to a unit diagonal first.
pub(super) struct Scaled {
    factors: nalgebra::Cholesky<f64, nalgebra::Const<COUNT>>,
    scale: SVector<f64, COUNT>,
}

/// The factors; `None` where the matrix is not positive definite.
pub(super) fn scaled_cholesky(matrix: &OfCamera) -> Option<Scaled> {
    let scale = matrix.diagonal().map(|d| if d > 0.0 { 1.0 / d.sqrt() } else { 1.0 });
    let d = OfCamera::from_diagonal(&scale);
    Some(Scaled { factors: (d * matrix * d).cholesky()?, scale })
}

impl Scaled {
    fn solve(&self, right: &SVector<f64, COUNT>) -> SVector<f64, COUNT> {
        self.factors.solve(&right.component_mul(&self.scale)).component_mul(&self.scale)
    }

    pub(super) fn inverse(&self) -> OfCamera {
        let d = OfCamera::from_diagonal(&self.scale);
        d * self.factors.inverse() * d
    }
}
