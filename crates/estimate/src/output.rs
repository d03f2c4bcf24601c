//! From the state to estimates: reference point, covariance, geodetic position, expectation of a
//! frame.

use nalgebra::{Matrix2, SMatrix, UnitQuaternion, Vector2, Vector3};

use windhover_base::geo::wrap_angle;
use windhover_base::msg::{
    FramePrediction, MarkerPrediction, Ownship, TargetEstimate, TargetState, TrackStatus,
};
use windhover_base::time::MonoTime;

use super::aid::pixel::{PointView, target_point, view};
use super::blocks::{TARGET, TargetBlock, own};
use super::delayed::DelayedCopy;
use super::matrix::Grid;
use super::models::Models;
use super::state::State;

/// What moves and is no target may be as large as this about a feature that rides on it, m: a person with a shadow.
const MOVER_RADIUS_M: f64 = 0.8;
/// Farther than this from where it should be a vehicle out of sight is not kept clear of features, m.
const FARTHEST_GONE_M: f64 = 4.0;

/// State and covariance at the reference point, `reference_m` ahead of the rear axle.
pub(crate) fn target_state(
    models: &Models,
    target: usize,
    mean: &[f64],
    covariance: &SMatrix<f64, 5, 5>,
) -> TargetState {
    let ahead = models.targets[target].reference_m;
    let (s, c) = mean[2].sin_cos();
    let (north_m, east_m) = (mean[0] + ahead * c, mean[1] + ahead * s);
    let mut jacobian = SMatrix::<f64, 5, 5>::identity();
    jacobian[(0, 2)] = -ahead * s;
    jacobian[(1, 2)] = ahead * c;
    let down = models.ground.down_m(north_m, east_m);
    let place = models.frame.geodetic(&Vector3::new(north_m, east_m, down));
    TargetState {
        north_m,
        east_m,
        heading_rad: wrap_angle(mean[2]),
        speed_mps: mean[3],
        yaw_rate_radps: mean[4],
        lat_deg: place.lat_deg,
        lon_deg: place.lon_deg,
        height_m: place.height_m,
        covariance: Some(jacobian * covariance * jacobian.transpose()),
        relative_sigma_m: None,
    }
}

/// A target's own part of a covariance, made symmetric.
fn symmetric(cov: &Grid, at: TargetBlock) -> SMatrix<f64, TARGET, TARGET> {
    let block = cov.block(at.all(), at.all());
    SMatrix::from_fn(|i, j| 0.5 * (block[(i, j)] + block[(j, i)]))
}

impl State {
    /// The estimate of a target at a frame, from the present state.
    pub(crate) fn estimate(&self, models: &Models, target: usize, frame: u32, t: MonoTime) -> TargetEstimate {
        let track = &self.targets[target];
        let status = if self.alive { track.life.status() } else { TrackStatus::Lost };
        let covariance = || symmetric(&self.cov, self.layout().target(target));
        let state = (status != TrackStatus::Lost).then(|| TargetState {
            relative_sigma_m: Some(self.relative_sigma_m(models, target)),
            ..target_state(models, target, &track.mean, &covariance())
        });
        TargetEstimate { t_valid: t, frame, target, status, state }
    }

    /// One-sigma of the reference point's horizontal position relative to the helicopter, larger axis, metres:
    /// `√λ(H P Hᵀ)` with H = [I, a (−sin ψ, cos ψ)ᵀ, −I] over place, heading and the helicopter's own place.
    fn relative_sigma_m(&self, models: &Models, target: usize) -> f64 {
        let (pose, own) = (self.layout().target(target).pose(), own::POSITION);
        let columns = [pose.column(0), pose.column(1), pose.column(2), own.column(0), own.column(1)];
        let p = SMatrix::<f64, 5, 5>::from_fn(|i, j| self.cov.at(columns[i], columns[j]));
        let ahead = models.targets[target].reference_m;
        let (s, c) = self.targets[target].mean[2].sin_cos();
        let h = SMatrix::<f64, 2, 5>::new(1.0, 0.0, -ahead * s, -1.0, 0.0, 0.0, 1.0, ahead * c, 0.0, -1.0);
        larger_sigma(&(h * p * h.transpose()))
    }

    /// The helicopter, at a frame where it is one's.
    pub(crate) fn ownship(&self, models: &Models, frame: Option<u32>, t: MonoTime) -> Ownship {
        let own = &self.own;
        let place = models.frame.geodetic(&own.position);
        let blocks = [own::POSITION, own::VELOCITY, own::ATTITUDE];
        let column = |i: usize| blocks[i / 3].column(i % 3);
        // Where a source does not fit its configured accuracy, what it measures is less certain than in the model.
        let grown = self.misfit_factors().map(f64::sqrt);
        let cov = |i, j| self.cov.at(column(i), column(j)) * grown[i / 3] * grown[j / 3];
        Ownship {
            t_valid: t,
            frame,
            position_ned_m: own.position,
            velocity_ned_mps: own.velocity,
            ned_from_body: UnitQuaternion::from_rotation_matrix(&own.ned_from_body),
            lat_deg: place.lat_deg,
            lon_deg: place.lon_deg,
            height_m: place.height_m,
            covariance: SMatrix::from_fn(|i, j| 0.5 * (cov(i, j) + cov(j, i))),
        }
    }

    /// What a frame taken about now should show.
    pub(crate) fn expect(&self, models: &Models, expected: &mut FramePrediction) {
        let camera = self.own.position + self.own.ned_from_body * models.camera_at;
        let height = models.ground.down_m(camera.x, camera.y) - camera.z;
        let height_sigma = self.cov.sigma(own::POSITION, 2);
        expected.size_range_px = size_range(models, height, height_sigma);
        expected.search = self.targets.iter().any(|t| t.life.status() != TrackStatus::Tracking);
        expected.moving.extend(self.refused_tracks.iter());
        expected.moving_radius_px = MOVER_RADIUS_M * models.camera.fx / height.max(0.5);
        for (i, target) in self.targets.iter().enumerate().filter(|(_, t)| t.life.is_held()) {
            let model = &models.targets[i];
            let (middle, _) = target_point(&target.mean, models, &middle_of(model));
            let scale = models.camera.fx / (middle - camera).norm().max(0.5);
            if let Some(seen) = view(&self.own, models, &middle) {
                // With no tag read, features may ride on it wherever it has got to.
                let doubt_px = 2.0 * self.pixel_sigma(i, models, &middle, &seen);
                let radius_px = model.radius_m * scale + doubt_px.min(FARTHEST_GONE_M * scale);
                expected.occupied.push((seen.px, radius_px));
            }
            let markers = if target.life.status() == TrackStatus::Lost { &[][..] } else { &model.markers };
            for marker in markers {
                let (world, _) = target_point(&target.mean, models, &marker.center);
                let Some(seen) = view(&self.own, models, &world) else { continue };
                let sigma_px = self.pixel_sigma(i, models, &world, &seen);
                let size_px = marker.size_m * models.camera.fx / (world - camera).norm().max(0.5);
                let reach = 3.0 * sigma_px + size_px;
                let inside = seen.px.x > -reach
                    && seen.px.y > -reach
                    && seen.px.x < models.image_px.0 + reach
                    && seen.px.y < models.image_px.1 + reach;
                if inside {
                    expected.markers.push(MarkerPrediction {
                        marker: marker.id,
                        center_px: seen.px,
                        sigma_px,
                        size_px,
                    });
                }
            }
        }
    }

    /// One-sigma of a marker's pixel (larger axis): `√λ(H P Hᵀ)`.
    fn pixel_sigma(&self, target: usize, models: &Models, world: &Vector3<f64>, seen: &PointView) -> f64 {
        let pose = self.layout().target(target).pose();
        let blocks = [own::POSITION, own::ATTITUDE, pose];
        let column = |i: usize| blocks[i / 3].column(i % 3);
        let mean = &self.targets[target].mean;
        let lever = Vector3::new(mean[1] - world.y, world.x - mean[0], 0.0);
        let [slope_n, slope_e] = models.ground.slope(mean[0], mean[1]);
        let mut h = SMatrix::<f64, 2, 9>::zeros();
        h.fixed_columns_mut::<3>(0).copy_from(&-seen.d_point);
        h.fixed_columns_mut::<3>(3).copy_from(&seen.d_attitude);
        h.set_column(6, &(seen.d_point * Vector3::new(1.0, 0.0, slope_n)));
        h.set_column(7, &(seen.d_point * Vector3::new(0.0, 1.0, slope_e)));
        h.set_column(8, &(seen.d_point * lever));
        let p = SMatrix::<f64, 9, 9>::from_fn(|i, j| self.cov.at(column(i), column(j)));
        larger_sigma(&(h * p * h.transpose()))
    }
}

/// One-sigma along the larger axis of a covariance.
fn larger_sigma(p: &Matrix2<f64>) -> f64 {
    let (mean, half) = (0.5 * p.trace(), 0.5 * (p[(0, 0)] - p[(1, 1)]));
    (mean + half.hypot(p[(0, 1)])).max(0.0).sqrt()
}

impl DelayedCopy {
    /// The smoothed estimate of a target.
    pub(crate) fn estimate(&self, models: &Models, target: usize) -> TargetEstimate {
        let status = self.status[target];
        let at = TargetBlock::alone(target);
        let mean = &self.mean[at.all().range()];
        let state = (status != TrackStatus::Lost)
            .then(|| target_state(models, target, mean, &symmetric(&self.cov, at)));
        TargetEstimate { t_valid: self.t, frame: self.frame, target, status, state }
    }
}

fn middle_of(model: &super::models::TargetModels) -> Vector3<f64> {
    let sum: Vector3<f64> = model.markers.iter().map(|m| m.center).sum();
    sum / model.markers.len().max(1) as f64
}

/// Smallest and largest apparent tag edge from a height over the ground: straight below is largest;
/// toward the image's corner and tilted it shrinks.
fn size_range(models: &Models, height_m: f64, sigma_m: f64) -> Option<(f64, f64)> {
    let tags = || models.targets.iter().flat_map(|t| &t.markers).filter(|m| m.corners.is_some());
    let smallest = tags().map(|m| m.size_m).fold(f64::INFINITY, f64::min);
    let largest = tags().map(|m| m.size_m).fold(0.0, f64::max);
    let top = tags().map(|m| -m.center.z).fold(0.0, f64::max);
    if !(smallest.is_finite() && height_m > 0.5) {
        return None;
    }
    let half = Vector2::new(models.image_px.0, models.image_px.1) * 0.5;
    let corner = (half.norm() / models.camera.fx).atan();
    let shrink = corner.cos().powi(2) * 0.6;
    let near = (height_m - top - 3.0 * sigma_m).max(0.3);
    let far = height_m + 3.0 * sigma_m;
    Some((smallest * models.camera.fx / far * shrink, largest * models.camera.fx / near * 1.2))
}
